"""Radiation readings from a counter on the node itself: bytes of the device in, dose rates with their age out."""

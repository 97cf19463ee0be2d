"""Radiation readings from a counter connected to the node: the device's bytes in, dose rates with their time out."""

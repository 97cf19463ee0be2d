"""Bytes in and out: UDP, and an in-process loopback. A link knows datagrams and addresses, nothing of MAVLink."""

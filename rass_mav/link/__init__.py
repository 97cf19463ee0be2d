"""Bytes in and out: UDP and serial ports. A link knows datagrams and addresses, nothing of MAVLink."""

"""Bytes in and out: UDP, TCP and serial ports. A link handles datagrams and addresses, and does not know MAVLink."""

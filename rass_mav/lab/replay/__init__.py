"""Recorded logs played through the nodes in virtual time: real positions and readings, the mock swarm's radio."""

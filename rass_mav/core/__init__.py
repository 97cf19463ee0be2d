"""The algorithm of RASS, pure: no clock, socket, file, thread, environment or global randomness.

Time is an argument (seconds on any timeline that does not jump). A random generator is passed in, and outgoing messages
are returned. Standard library only.
"""

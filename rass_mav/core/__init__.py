"""The algorithm of RASS, pure: no clock, socket, file, thread, environment or global randomness.

Time is an argument (seconds on any timeline that does not jump), a random generator is passed in, and what goes
out is returned. Standard library only.
"""

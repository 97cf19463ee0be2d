"""Swarms of real processes on this machine: mock ones, ones that fly in simulation, and the one of `rass-mav try`."""

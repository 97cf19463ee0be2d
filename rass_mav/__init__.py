"""Risk-Aware Swarm Storage (RASS, arXiv 2201.01349) for MAVLink drones."""

__version__ = "0.1.0"

"""Risk-Aware Swarm Storage (RASS, arXiv 2201.01349) for MAVLink drones."""

__version__ = "0.1.0"
#: The version of the interface for other programs (docs/integrate.md).
INTERFACE = 1

"""The mock swarm: virtual time, radio, mobility, radiation, mock flight controllers, and the same agents that fly."""

"""The mock swarm: virtual time, radio, mobility, radiation, mock flight controllers, and the very same agents."""

"""Vehicles with real flight control firmware (SITL) or mock ones, each with a node, over a simulated radio."""

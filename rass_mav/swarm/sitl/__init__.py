"""Vehicles with real flight control firmware (SITL) or mock ones, with a node each, over a simulated radio."""

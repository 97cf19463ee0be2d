"""What a node says to its autopilot and to ground stations, and what it hears from them."""

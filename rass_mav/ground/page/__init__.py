"""The page of the ground station: a map and the state of a mission, in a browser (docs/how-to/page.md)."""

"""Lists and exports of a mission's data."""

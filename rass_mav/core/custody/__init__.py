"""The responsibility for data: what is held, hand-overs, what leaves in a step."""

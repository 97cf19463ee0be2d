"""The duty to keep data: what is held, hand-overs, what leaves in a step."""

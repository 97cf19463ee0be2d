"""A node's keys, and all that is done with them. A node without keys loads none of it."""

"""`rass-mav doctor`: is everything there that a node needs? Each check is one small function
(docs/how-to/troubleshooting.md)."""

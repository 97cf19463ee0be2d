"""What needs attention: one list, wherever it is shown (docs/how-to/attention.md)."""

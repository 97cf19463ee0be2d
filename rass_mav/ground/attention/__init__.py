"""What needs attention: one list, wherever it is shown (docs/attention.md)."""

"""What a mission has brought: stores read without a node, lists, exports (docs/how-to/data.md)."""

"""A disk under the product's own store that loses what was not synced, and fails on demand:
docs/contribute/testing.md."""

from .disk import Disk

__all__ = ["Disk"]

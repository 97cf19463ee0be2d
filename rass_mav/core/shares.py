"""Fair shares of what is bounded: nobody can fill a table or a store alone.

The rule is max-min. While there is space, everybody may use it. When there is none, the one that has most gives way, or
gets no more; so each can have as much as all others that want it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

K = TypeVar("K")


def greediest(counts: Mapping[K, int]) -> K:
    """Who has most; among equals the first one."""
    return max(counts, key=lambda key: counts[key])

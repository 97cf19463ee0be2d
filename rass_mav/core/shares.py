"""Fair shares of what is bounded: nobody can fill a table or a store alone.

The rule is max-min. While there is space, everybody may use it. When there is little or none, the one that has most
gives way, or gets no more. So each can have as much as all others that want it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

K = TypeVar("K")

#: The last part of a store, one place in this many, is for those that have less than their share.
LAST_PART = 8


def greediest(counts: Mapping[K, int]) -> K:
    """Who has most; among equals the first one."""
    return max(counts, key=lambda key: counts[key])


def is_fair(has: int, places: int, sharing: int) -> bool:
    """Whether one of `sharing` that has so many has less than an equal share of the places."""
    return has * sharing < places


def is_last_part(used: int, places: int) -> bool:
    """Whether so little is left that it is kept for those that have less than their share."""
    return used >= places - places // LAST_PART

"""What can be set of a store."""

from __future__ import annotations

from typing import Literal

from rass_mav.config.bounds import Count, Fraction
from rass_mav.config.sections import Section


class StoreSettings(Section):
    """What a node can hold and send."""

    path: str | None = None
    """The database file; null: `rass-NODEID.db` in the current directory."""
    capacity_items: Count | None = 50
    """Data a drone holds at most (a base has no bound of items); null: no bound."""
    capacity_bytes: Count | None = None
    """Bytes of payload a drone holds at most; null: no bound."""
    own_share: Fraction | None = None
    """Part of that which others' data leave free for the node's own measurements, 0..1; null: the policy's own."""
    overflow: Literal["refuse", "drop-oldest"] = "refuse"
    """What a full node does with one more. drop-oldest: the least recently used one is lost (without custody only)."""
    bandwidth_items: Count = 10
    """Data sent in a step at most, retransmissions included."""
    quota_bytes: Count | None = None
    """Bytes the store may hold in all; null: what the disk has."""
    scrub_items: Count | None = None
    """Checksums verified in a step, going round; null: all."""

"""The settings of a store."""

from __future__ import annotations

from typing import Literal

from rass_mav.config.bounds import Count, Fraction
from rass_mav.config.sections import Section

#: The memory that the records of what a drone holds may take, bytes: what a Raspberry Pi Zero can spare, also for the
#: moment in which a new node takes over the store, and they are there twice.
MEMORY_BYTES = 32 << 20
#: What the record of a datum takes, custody or spare, bytes (`python -m benchmarks.held`).
RECORD_BYTES = 570


class StoreSettings(Section):
    """What a node can hold and send."""

    path: str | None = None
    """The database file; null: `rass-NODEID.db` in the current directory."""
    capacity_items: Count | None = None
    """Most data that a drone holds (a base has no bound of items); null: as many as `MEMORY_BYTES` have space for."""
    capacity_bytes: Count | None = None
    """Most bytes of payload that a drone holds; null: no bound but that of the disk."""
    own_share: Fraction | None = None
    """Part of that which others' data leave free for the node's own measurements, 0..1; null: the policy's own."""
    overflow: Literal["refuse", "drop-oldest"] = "refuse"
    """What a full node does with a new datum. drop-oldest: the least recently used one is lost (without custody
    only)."""
    bandwidth_items: Count = 10
    """Data sent in a step at most, retransmissions included."""
    quota_bytes: Count | None = None
    """Bytes the store may hold in all; null: as many as the disk has, less a reserve."""
    scrub_items: Count | None = None
    """Checksums verified in a step, in rotation; null: all."""

    @property
    def most_items(self) -> int:
        """Data that a drone can hold."""
        return MEMORY_BYTES // RECORD_BYTES if self.capacity_items is None else self.capacity_items

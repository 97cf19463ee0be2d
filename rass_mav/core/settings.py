"""How a node behaves: what configurations come down to."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class NodeSettings:
    """How a node behaves. Times are in steps of `step_s` seconds where they say so."""

    node_id: int
    """0..65534."""
    base: bool = False
    """A sink: hop count 0, never evicts."""
    step_s: float = 1.0
    """Length of a step, seconds."""
    capacity_items: int | None = 50
    """Items a drone can hold; None: no bound. A base has no bound of items (but under a replicating policy)."""
    capacity_bytes: int | None = None
    """Bytes of payload a drone can hold; None: no bound."""
    own_share: float = 0.0
    """0..1: others' data leave this part of the capacity free, for the node's own measurements."""
    drop_oldest: bool = False
    """A full node drops its least recently used datum for a new one; False: it refuses the new one."""
    bandwidth_items: int = 10
    """Items sent in a step at most, retransmissions included."""
    acknowledged: bool = True
    """Custody (`custody.mode: acknowledged`); False: what is sent is deleted at once."""
    mirror: bool = False
    """Spare copies are kept (`core.mirrors`); only with `acknowledged`."""
    mirror_until_receipt: bool = True
    """A spare is kept, while there is room, until a base says that the datum has arrived; False: only until it has been
    passed on once more."""
    copies_auto: bool = False
    """As many spare copies as the risk asks for (`core.spares`); only with `mirror`."""
    immediate: bool = False
    """The driver calls `Node.forward` (`node.forward: immediate`)."""
    receipts: bool = True
    """A base says what has arrived; others tell it on, and drop what has. Lost data are told to the base."""
    receipt_steps: int = 6
    """A node sends one receipt frame in so many steps at most."""
    retry_steps: int = 1
    """A hand-over without an answer is sent again after so many steps."""
    max_tries: int = 8
    """After so many sendings without an answer another neighbour may be chosen."""
    neighbour_steps: int = 3
    """A neighbour not heard for so many steps is gone (the k of the design)."""
    max_neighbours: int = 128
    max_hops: int = 250
    """1..254."""
    seq_period: int = 30
    """A base raises its announcement number every so many steps, and on request."""
    lifetime_s: float | None = None
    """Data older than this expire; None: never."""
    scrub_items: int | None = None
    """Checksums verified in a step, going round; None: all."""
    inline_bytes: int = 97
    """Payload that fits one frame whole; larger data go in chunks."""
    chunk_bytes: int = 123
    """Payload of a chunk."""

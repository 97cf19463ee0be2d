"""How a node behaves: the sections of a configuration that the core reads, and `NodeSettings`, which has them all."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cached_property
from typing import Annotated, Literal, NamedTuple

from rass_mav.config.sections import Count, Fraction, Meta, Positive, Section
from rass_mav.core.policy import Policy
from rass_mav.core.risk import RiskEstimator

Forward = Literal["step", "immediate"]
#: What the lab can leave out. Every node that flies has all of it. docs/evaluation/simulation.md explains each.
Mechanism = Literal[
    "receipts", "lasting-replicas", "distant-replicas", "overhearing", "measured-retries", "contacts",
    "queue-toll", "delivery-scores", "passive-acknowledgement",
]  # fmt: skip
#: The memory that the records of what a drone holds may take, bytes: what a Raspberry Pi Zero can spare, also for the
#: moment in which a new node takes over the store, and they are there twice.
MEMORY_BYTES = 32 << 20
#: What the record of a datum takes, in custody or replica, bytes (`python -m benchmarks.held`).
RECORD_BYTES = 620


class Capacity(NamedTuple):
    """What a node can hold; None: no bound of that kind."""

    items: int | None = None
    bytes: int | None = None
    """Of payload."""
    own_share: float = 0.0
    """0..1: others' data leave this part of it free for the node's own measurements."""


class RiskSettings(Section):
    """How readings become risk (docs/how-to/sensors.md)."""

    gain: Annotated[float, Meta(gt=0, le=1)] | None = None
    """Gain of the moving average over readings; 1: no averaging; null: 0.1 under `survival`, otherwise 1."""
    scale: Literal["linear", "logarithmic"] = "linear"
    """linear, or logarithmic: each doubling of the reading adds the same risk; `low` must be above 0 then."""
    background: float = 0.0
    """Reading where there is no danger, in the sensor's unit. It is subtracted from every reading."""
    low: float = 0.0
    """Reading above background that means risk 0, in the sensor's unit."""
    high: float = 1.0
    """Reading above background that means risk 1, in the sensor's unit; above `low`."""
    unit: Literal["usvh", "cpm", "cps", "counts"] | None = None
    """Unit of the autopilot's readings, which measurements carry. usvh: microsievert per hour; cpm, cps: counts per
    minute, per second; counts: counts of no stated time; null: unknown. A sensor of the node's own has
    `sensor.unit`."""
    stale_s: Positive = 10.0
    """Age from which a reading no longer counts: the risk is then unknown."""
    worst: Fraction = 1.0
    """Risk to assume when it is unknown."""

    def mistakes(self) -> Iterator[str]:
        """`high` must be above `low`, and for a logarithm both above 0."""
        if self.scale == "logarithmic" and self.low <= 0.0:
            yield f"risk.low: expected a number > 0 with risk.scale logarithmic, got {self.low:g}"
        if self.high <= self.low:
            yield f"risk.high: expected a number above risk.low ({self.low:g}), got {self.high:g}"

    def normalised(self, reading: float) -> float:
        """A reading on the scale where `low` above background is 0 and `high` above background is 1; unclipped.

        Below `low` the logarithmic scale continues as a straight line with the slope it has there: a reading at or
        below background has no logarithm, but noise must average out.
        """
        reading -= self.background
        low, high = self.low, self.high
        if self.scale == "linear":
            return (reading - low) / (high - low)
        if reading < low:
            return (reading / low - 1.0) / math.log(high / low)
        return math.log(reading / low) / math.log(high / low)

    def estimator(self, policy: Policy) -> RiskEstimator:
        """A new estimator with these settings."""
        gain = policy.risk_gain if self.gain is None else self.gain
        return RiskEstimator(gain=gain, stale_s=self.stale_s, worst=self.worst)


class RoutingSettings(Section):
    """Routes to the bases. All nodes of a swarm should have the same values."""

    seq_period: Annotated[int, Meta(ge=0)] | None = None
    """Steps between two announcement numbers of a base; 0: on request only; null: 2 under `survival`, otherwise 30.
    Fewer: routes change sooner after a base has moved; more: fewer beacons."""
    neighbour_steps: Annotated[int, Meta(ge=0)] = 3
    """Steps of silence after which a neighbour is gone. Raise it where many beacons in a row get lost. 0 is for mock
    swarms with `radio.latency_steps`: a neighbour is who was heard at the beginning of the step."""
    max_neighbours: Count = 128
    """Size of the neighbour table."""


class CustodySettings(Section):
    """Custody and replicas. All nodes of a swarm should have the same values."""

    mode: Literal["acknowledged", "none"] = "acknowledged"
    """acknowledged: a node keeps a datum until the receiver has it on disk; none: it deletes a datum as soon as it is
    sent, as in the paper, and nothing is guaranteed (docs/explanation/guarantees.md)."""
    replicas: bool | None = None
    """Whether a second copy of each datum is kept: the sender keeps its copy until a base reports the arrival, and
    data that do not move get one. null: true with mode acknowledged. No effect under `stigmergy`."""
    receipt_steps: Count = 3
    """Steps in which a node sends at most one receipt frame. Fewer: arrivals are known sooner; more: less airtime."""

    def mistakes(self) -> Iterator[str]:
        """Checks across several keys, as lines."""
        if self.replicas and self.mode != "acknowledged":
            yield f"custody.replicas: expected false with custody.mode {self.mode}, got true"


class StoreSettings(Section):
    """What a node holds and sends (docs/reference/store.md)."""

    path: str | None = None
    """Path of the database; null: `rass-NODEID.db` beside the configuration."""
    capacity_items: Count | None = None
    """Most data that a drone holds; null: what 32 MiB of memory have space for. A base has no such bound."""
    capacity_bytes: Count | None = None
    """Most bytes of payload that a drone holds; null: no bound but the disk."""
    own_share: Fraction | None = None
    """Share of the store that is reserved for the node's own measurements; null: 0.4 under `survival`, otherwise 0."""
    overflow: Literal["refuse", "drop-oldest"] = "refuse"
    """What a full node does with a new datum. refuse; or drop-oldest: the least recently used one is lost, only with
    `custody.mode` none."""
    bandwidth_items: Count = 20
    """Most data sent in a step, retransmissions included."""
    quota_bytes: Count | None = None
    """Most bytes of the whole store; null: what the disk has, less a reserve."""
    scrub_items: Count | None = None
    """Data whose checksums are verified in a step, in rotation; null: all."""

    @property
    def most_items(self) -> int:
        """Data that a drone can hold."""
        return MEMORY_BYTES // RECORD_BYTES if self.capacity_items is None else self.capacity_items


class LifetimeSettings(Section):
    """How long data matter."""

    lifetime_s: Positive | None = None
    """Age at which the data that this node holds expire, unless their own lifetime is shorter; null: only these."""


class NodeSettings(Section):
    """How a node behaves: those sections of its configuration that the core reads. Times are in steps of `step_s` where
    they say so."""

    node_id: int
    """0..65534."""
    base: bool = False
    """A sink: hop count 0, never evicts."""
    step_s: float = 1.0
    """Length of a step, seconds."""
    forward: Forward = "immediate"
    """immediate: the driver calls `Node.forward` whenever something came in."""
    routing: RoutingSettings = RoutingSettings()
    custody: CustodySettings = CustodySettings()
    store: StoreSettings = StoreSettings()
    data: LifetimeSettings = LifetimeSettings()
    without: tuple[Mechanism, ...] = ()
    """What the lab leaves out, to measure what it is worth."""

    # -- what follows from these ---------------------------------------------------------------------------------------

    def has(self, mechanism: Mechanism) -> bool:
        """Whether the lab has not left a mechanism out."""
        return mechanism not in self.without

    @cached_property
    def acknowledged(self) -> bool:
        """Whether there is custody; False: a datum is deleted as soon as it is sent."""
        return self.custody.mode == "acknowledged"

    @cached_property
    def immediate(self) -> bool:
        """Whether data move on at once."""
        return self.forward == "immediate"

    @cached_property
    def receipts(self) -> bool:
        """Whether bases report what has arrived. Other nodes relay that, and losses to the bases."""
        return self.has("receipts")

    @cached_property
    def _replicated(self) -> bool:
        return self.acknowledged and self.custody.replicas is not False

    @cached_property
    def replicas(self) -> bool:
        """Whether this node keeps replicas (`core.replicas`)."""
        return self._replicated and not self.base

    @cached_property
    def lasting(self) -> bool:
        """Whether a replica is kept, while there is space, until a base reports that its datum has arrived; False: only
        until the receiver has passed the datum on."""
        return self.receipts and self.has("lasting-replicas")

    @cached_property
    def overhears(self) -> bool:
        """Whether data that neighbours hand over to others are taken by a base, and kept in memory by a drone."""
        useful = self.acknowledged if self.base else self._replicated and self.lasting
        return useful and self.has("overhearing")

    @cached_property
    def measured(self) -> bool:
        """Whether an unanswered hand-over is sent again no sooner than answers usually take; False: every step."""
        return self.has("measured-retries")

    @cached_property
    def passive(self) -> bool:
        """Whether a receiver that is heard handing a datum on has answered (passive acknowledgement)."""
        return self._replicated and self.measured and self.has("passive-acknowledgement")

    def capacity(self, own_share: float, *, bounded: bool = True) -> Capacity:
        """What the node can hold. `own_share`: what its policy reserves for own data. `bounded`: not a base."""
        store = self.store
        share = own_share if store.own_share is None else store.own_share
        return Capacity(store.most_items, store.capacity_bytes, share) if bounded else Capacity(own_share=share)

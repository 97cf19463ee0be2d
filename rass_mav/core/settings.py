"""How a node behaves: its settings, and the `NodeSettings` that a configuration results in."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Literal

from rass_mav.config.bounds import Count, Fraction, Positive
from rass_mav.config.sections import Meta, Section
from rass_mav.core.policy import Policy
from rass_mav.core.risk import RiskEstimator

Forward = Literal["step", "immediate"]


class RiskSettings(Section):
    """From readings to risk (docs/sensors.md)."""

    gain: Annotated[float, Meta(gt=0, le=1)] | None = None
    """Gain of the moving average over readings; 1: no averaging; null: the policy's own."""
    scale: Literal["linear", "logarithmic"] = "linear"
    """logarithmic: each time the reading doubles, the risk grows by the same amount."""
    background: float = 0.0
    """The reading where there is no danger, in the sensor's unit; subtracted from every reading."""
    low: float = 0.0
    """Reading above background that means risk 0, in the sensor's unit."""
    high: float = 1.0
    """Reading above background that means risk 1, in the sensor's unit; above `low`."""
    unit: Literal["usvh", "cpm", "cps", "counts"] | None = None
    """Unit of the autopilot's readings. usvh: microsievert per hour; cpm, cps: counts per minute, per second; counts:
    counts of no stated time; null: unknown. An own sensor has `sensor.unit`."""
    stale_s: Positive = 10.0
    """A reading older than this is unknown, seconds."""
    worst: Fraction = 1.0
    """What an unknown risk counts as."""

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
    """The routing table."""

    seq_period: Annotated[int, Meta(ge=0)] | None = None
    """Steps after which a base raises its announcement number (0: on request only); null: the policy's own."""
    neighbour_steps: Annotated[int, Meta(ge=0)] = 3
    """Steps of silence after which a neighbour is gone. 0 is for mock swarms with `radio.latency_steps`: only a node
    that is heard at the beginning of a step is a neighbour in it."""
    max_neighbours: Count = 128
    max_hops: Annotated[int, Meta(ge=1, le=254)] = 250
    queue_toll: bool = True
    """Data avoid nodes where data wait: with q data in custody, a hop from a node costs 1 + q / `store.bandwidth_items`
    times as much. Only under a policy whose costs add up (survival)."""
    contacts: bool = True
    """A neighbour that has flown out of range, by its velocity and the node's own, is given no data if another is fit.
    Nodes that move report their places and velocities in their beacons."""


class CustodySettings(Section):
    """The responsibility for data."""

    mode: Literal["acknowledged", "none"] = "acknowledged"
    """acknowledged: a node keeps a datum until the receiver has it on disk; none: it deletes a datum as soon as it is
    sent."""
    receipts: bool = True
    """Bases report what has arrived; other nodes relay that, and drop their spares of it. Losses are reported to the
    bases."""
    digest: bool = True
    """Bases also report what has arrived lately in a few bits a datum, which travels sooner than receipts and ends
    spares only. Only with `receipts` and with spare copies until a receipt."""
    receipt_steps: Count = 6
    """A node sends at most one receipt frame in this many steps, and a drone at most one digest."""
    retry_steps: Count = 1
    """Steps after which an unanswered hand-over is sent again."""
    retries: Literal["measured", "fixed"] = "measured"
    """measured: an unanswered hand-over is sent again no sooner than answers usually take, later each time, and answers
    are repeated in the next beacon; fixed: every `retry_steps`."""
    max_tries: Count = 8
    """Unanswered transmissions after which another neighbour may be chosen."""
    mirror: bool | None = None
    """Spare copies: the giver of a datum keeps its copy for a while, and data that rest get one. Only with mode
    acknowledged, where null means true; no effect under a policy that replicates."""
    mirror_until: Literal["passed-on", "receipt"] = "receipt"
    """How long the giver keeps its copy: passed-on: until the receiver has passed the datum on; receipt: while there is
    space, until a base reports that it has arrived. Without `receipts`, receipt means the same as passed-on."""
    copies: Literal[1, "auto"] = "auto"
    """How many spare copies a datum gets besides that of the giver. 1: one, if it rests; auto: as many as its risk
    requires, also while it is handed over to a neighbour that may have gone. Only with spare copies."""
    overhear: bool = True
    """A drone keeps, in free memory, data that it hears neighbours hand over to each other; a base takes them all. Only
    with mode acknowledged; for drones only with spare copies until a receipt."""
    distant: bool = True
    """Whether a datum that rests where no base can be reached has another copy out of its holder's radio range. Only
    with spare copies until a receipt."""

    def mistakes(self) -> Iterator[str]:
        """Checks across several keys, as lines."""
        if self.mirror and self.mode != "acknowledged":
            yield f"custody.mirror: expected false with custody.mode {self.mode}, got true"


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
    """Items a drone can hold; None: no bound. A base has no bound of items (except under a replicating policy)."""
    capacity_bytes: int | None = None
    """Bytes of payload a drone can hold; None: no bound."""
    own_share: float = 0.0
    """0..1: others' data leave this part of the capacity free for the node's own measurements."""
    drop_oldest: bool = False
    """A full node drops its least recently used datum for a new one; False: it refuses the new one."""
    bandwidth_items: int = 10
    """Items sent in a step at most, retransmissions included."""
    acknowledged: bool = True
    """Custody (`custody.mode: acknowledged`); False: a datum is deleted as soon as it is sent."""
    mirror: bool = False
    """Spare copies are kept (`core.spares`); only with `acknowledged`, and neither at a base nor under a policy that
    replicates."""
    mirror_until_receipt: bool = True
    """A spare is kept, while there is space, until a base reports that the datum has arrived; False: only until the
    receiver has passed it on."""
    copies_auto: bool = False
    """As many spare copies as the risk requires (`core.spares`); only with `mirror`."""
    overhear: bool = False
    """Data that neighbours hand over to others are taken by a base, and kept in memory by a drone; a drone only with
    `mirror` and receipts."""
    distant: bool = False
    """Data that rest get a distant spare (`core.spares`); only with `mirror` and `mirror_until_receipt`."""
    immediate: bool = False
    """The driver calls `Node.forward` (`node.forward: immediate`)."""
    receipts: bool = True
    """Bases report what has arrived; other nodes relay that, and drop their spares of it. Losses are reported to the
    bases."""
    digest: bool = False
    """Bases also report what has arrived lately in a few bits a datum; only where spares wait for receipts."""
    receipt_steps: int = 6
    """A node sends at most one receipt frame in this many steps, and a drone at most one digest."""
    vouched: bool = False
    """Statements of bases come here only if the ground has vouched for them, so origins deny nothing."""
    retry_steps: int = 1
    """Steps after which an unanswered hand-over is sent again."""
    measured: bool = True
    """`custody.retries`."""
    max_tries: int = 8
    """Unanswered transmissions after which another neighbour may be chosen."""
    neighbour_steps: int = 3
    """Steps of silence after which a neighbour is gone (the k of the design)."""
    max_neighbours: int = 128
    max_hops: int = 250
    """1..254."""
    contacts: bool = False
    """Neighbours that are expected to be out of range are chosen only if no other is fit; see `RoutingSettings`."""
    queue_toll: bool = False
    """Where costs add up, the data that wait here raise the cost of a route by this node."""
    seq_period: int = 30
    """Steps after which a base raises its announcement number; it also does so on request."""
    lifetime_s: float | None = None
    """Data older than this expire; None: never."""
    scrub_items: int | None = None
    """Checksums verified in a step, in rotation; None: all."""
    inline_bytes: int = 97
    """Payload that fits one frame whole; larger data go in chunks."""
    chunk_bytes: int = 123
    """Payload of a chunk."""

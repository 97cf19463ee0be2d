"""What can be set of a node, typed and bounded: the sections that `run` configurations and scenarios share."""

from __future__ import annotations

import math
from typing import Annotated, Literal, Protocol

from rass_mav.config.sections import Meta
from rass_mav.config.sections import Section as Section  # the mock swarm takes it from here
from rass_mav.core.policy import Policy
from rass_mav.core.risk import RiskEstimator
from rass_mav.core.settings import NodeSettings
from rass_mav.errors import ConfigError
from rass_mav.policy import Weights, make_policy
from rass_mav.wire import INLINE_BYTES
from rass_mav.wire.measurement import MEASUREMENT_BYTES

Positive = Annotated[float, Meta(gt=0)]
NonNegative = Annotated[float, Meta(ge=0)]
Fraction = Annotated[float, Meta(ge=0, le=1)]
Count = Annotated[int, Meta(ge=1)]
Forward = Literal["step", "immediate"]
PolicyName = Literal["rass", "rass-literal", "hop-count", "stigmergy", "survival"]


class PolicySettings(Section):
    """Who is fit, and what goes to whom."""

    name: PolicyName = "survival"
    alpha: NonNegative | None = None
    """Weight of hops in Eq. 3; null: the policy's own (rass 1, rass-literal 10)."""
    beta: NonNegative | None = None
    """Weight of risk in Eq. 3; null: the policy's own (rass 10, rass-literal 1)."""
    threshold: NonNegative | None = None
    """T of Eq. 4; null: 1."""
    hop_cost: Positive | None = None
    """What a hop costs under survival, beside -log(1 - risk); null: 0.05."""
    unknown_hops: Annotated[int, Meta(ge=1, le=255)] | None = None
    """Hop count of a node that knows no way to a base; null: 255, more than any real one."""
    rules: Literal["paper", "authors"] = "paper"
    """authors: ties and eviction as in the authors' code; all nodes of a swarm must agree."""

    def make(self) -> Policy:
        """The policy. Raises `ConfigError`."""
        return make_policy(
            self.name, Weights(self.alpha, self.beta, self.threshold, self.unknown_hops, self.hop_cost, self.rules)
        )


class RiskSettings(Section):
    """From readings to risk (docs/sensors.md)."""

    gain: Annotated[float, Meta(gt=0, le=1)] | None = None
    """Gain of the moving average over readings, 1: no memory; null: 0.1 under survival, else 1."""
    scale: Literal["linear", "logarithmic"] = "linear"
    """logarithmic: each time the reading doubles, the risk grows by the same amount."""
    background: float = 0.0
    """What the sensor says where there is no danger, in its unit; subtracted from every reading."""
    low: float = 0.0
    """Reading above background that means risk 0, in the sensor's unit."""
    high: float = 1.0
    """Reading above background that means risk 1, in the sensor's unit; above `low`."""
    stale_s: Positive = 10.0
    """A reading older than this is unknown, seconds."""
    worst: Fraction = 1.0
    """What an unknown risk counts as."""

    def __post_init__(self) -> None:
        """`high` must be above `low`, and for a logarithm both above 0."""
        if self.scale == "logarithmic" and self.low <= 0.0:
            raise ValueError(f"risk.low: expected a number > 0 with risk.scale logarithmic, got {self.low:g}")
        if self.high <= self.low:
            raise ValueError(f"risk.high: expected a number above risk.low ({self.low:g}), got {self.high:g}")

    def normalised(self, reading: float) -> float:
        """A reading on the scale where `low` above background is 0 and `high` above background is 1; unclipped.

        Below `low` the logarithmic scale goes on as a straight line with the slope it has there: a reading at or below
        background has no logarithm, but noise must average out.
        """
        reading -= self.background
        low, high = self.low, self.high
        if self.scale == "linear":
            return (reading - low) / (high - low)
        if reading < low:
            return (reading / low - 1.0) / math.log(high / low)
        return math.log(reading / low) / math.log(high / low)

    def estimator(self, policy: PolicySettings) -> RiskEstimator:
        """A new estimator with these settings."""
        gain = policy.make().risk_gain if self.gain is None else self.gain
        return RiskEstimator(gain=gain, stale_s=self.stale_s, worst=self.worst)


class RoutingSettings(Section):
    """The routing table."""

    seq_period: Annotated[int, Meta(ge=0)] | None = None
    """A base raises its announcement number every so many steps (0: on request only); null: 2 under survival, whose
    costs change all the time, else 30."""
    neighbour_steps: Annotated[int, Meta(ge=0)] = 3
    """A neighbour not heard for so many steps is gone. 0 is for mock swarms with `radio.latency_steps`: only who is
    heard at the beginning of a step is a neighbour in it."""
    max_neighbours: Count = 128
    max_hops: Annotated[int, Meta(ge=1, le=254)] = 250


class CustodySettings(Section):
    """The duty to keep data."""

    mode: Literal["acknowledged", "none"] = "acknowledged"
    """acknowledged: a datum is kept until the receiver has it on disk; none: what is sent is deleted at once."""
    receipts: bool = True
    """Bases say what has arrived; others tell it on, and drop their copies of it. What is lost is told to the bases."""
    receipt_steps: Count = 6
    """A node sends one receipt frame in so many steps at most."""
    retry_steps: Count = 1
    """A hand-over without an answer is sent again after so many steps."""
    max_tries: Count = 8
    """After so many sendings without an answer another neighbour may be chosen."""
    mirror: bool | None = None
    """Spare copies: the giver of a datum keeps its copy for a while, and data that rest get one. Only with mode
    acknowledged, there null means true; no effect under stigmergy."""
    mirror_until: Literal["passed-on", "receipt"] = "receipt"
    """How long the giver keeps its copy: until the receiver has passed the datum on in its turn, or, while there is
    room, until a base says that it has arrived. Without `receipts` no base does: then it is the former."""
    copies: Literal[1, "auto"] = "auto"
    """How many spare copies a datum gets beside that of the giver. 1: one, if it rests; auto: as many as its risk asks
    for, also while it is handed over to a neighbour that may have gone. Only with spare copies."""

    def __post_init__(self) -> None:
        """What no single key can say, and what this version cannot do yet."""
        if self.mirror and self.mode != "acknowledged":
            raise ValueError(f"custody.mirror: expected false with custody.mode {self.mode}, got true")

    @property
    def mirrored(self) -> bool:
        """Whether there are spare copies."""
        return self.mode == "acknowledged" if self.mirror is None else self.mirror


class StoreSettings(Section):
    """What a node can hold and send."""

    path: str | None = None
    """The database file; null: `rass-NODEID.db` in the current directory."""
    capacity_items: Count | None = 50
    """Data a drone holds at most (a base has no bound of items); null: no bound."""
    capacity_bytes: Count | None = None
    """Bytes of payload a drone holds at most; null: no bound."""
    own_share: Fraction | None = None
    """Part of that which others' data leave free for the node's own measurements, 0..1; null: 0.4 under survival, else
    0."""
    overflow: Literal["refuse", "drop-oldest"] = "refuse"
    """What a full node does with one more. drop-oldest: the least recently used one is lost (without custody only)."""
    bandwidth_items: Count = 10
    """Data sent in a step at most, retransmissions included."""
    quota_bytes: Count | None = None
    """Bytes the store may hold in all; null: what the disk has."""
    scrub_items: Count | None = None
    """Checksums verified in a step, going round; null: all."""


class DataSettings(Section):
    """What a node creates by itself."""

    interval_steps: Annotated[int, Meta(ge=0)] = 10
    """A measurement every so many steps; 0: none. `due` says in which."""
    due: Literal["step-id", "step+id", "together"] = "step-id"
    """Which number must be a multiple: (step - node id), (step + node id), or the step alone (all nodes at once)."""
    until_step: Annotated[int, Meta(ge=0)] | None = None
    """No more measurements from this step on."""
    bytes: Annotated[int, Meta(ge=MEASUREMENT_BYTES, le=1 << 20)] = MEASUREMENT_BYTES
    """Size of a measurement; what exceeds the measurement proper is filled with random bytes."""
    lifetime_s: Positive | None = None
    """Data older than this expire; null: never."""


class MavlinkSettings(Section):
    """Identity and framing."""

    system_id: Annotated[int, Meta(ge=1, le=255)] | None = None
    """MAVLink system id; null: the autopilot's once heard, until then from the node id."""
    component_id: Annotated[int, Meta(ge=2, le=250)] = 191
    """MAVLink component id of the node; 1 belongs to the autopilot."""
    payload_type: Annotated[int, Meta(ge=0, le=65535)] = 33200
    """payload_type of our TUNNEL frames; above 32767 is for local use."""
    autopilot_id: Annotated[int, Meta(ge=0, le=255)] = 0
    """System id of the autopilot that readings and positions are taken from; 0: the first one heard."""
    reading_name: Annotated[str, Meta(min_length=1, max_length=10)] = "RAD"
    """Name of the NAMED_VALUE_FLOAT that carries the reading."""


class GroundSettings(Section):
    """What a ground station is told, and may set."""

    may_set: bool = True
    """Whether parameters can be set from the ground; they can be read in any case."""
    values_s: NonNegative = 10.0
    """Seconds between two NAMED_VALUE_FLOATs of a kind: fitness, hops, risk, fill; 0: never."""
    computer_s: NonNegative = 30.0
    """Seconds between two ONBOARD_COMPUTER_STATUS; 0: never."""


class Sections(Protocol):
    """What a `run` configuration, a scenario and a replay have in common."""

    @property
    def policy(self) -> PolicySettings: ...
    @property
    def risk(self) -> RiskSettings: ...
    @property
    def routing(self) -> RoutingSettings: ...
    @property
    def custody(self) -> CustodySettings: ...
    @property
    def store(self) -> StoreSettings: ...
    @property
    def data(self) -> DataSettings: ...
    @property
    def mavlink(self) -> MavlinkSettings: ...


class AgentSettings(Section):
    """All of one node."""

    node_id: int
    base: bool
    step_s: float
    policy: PolicySettings
    risk: RiskSettings
    routing: RoutingSettings
    custody: CustodySettings
    store: StoreSettings
    data: DataSettings
    mavlink: MavlinkSettings
    forward: Forward = "immediate"
    ground: GroundSettings | None = None
    """None: no ground station is answered (the mock swarm has none)."""
    own_sensor: bool = False
    """Readings come by `Agent.reading`; those of the autopilot are not believed."""

    @classmethod
    def of(
        cls,
        sections: Sections,
        *,
        node_id: int,
        base: bool,
        step_s: float,
        forward: Forward = "immediate",
        data: DataSettings | None = None,
        mavlink: MavlinkSettings | None = None,
        ground: GroundSettings | None = None,
        own_sensor: bool = False,
    ) -> AgentSettings:
        """One node's share of a configuration; `data` and `mavlink` instead of its own sections, if given."""
        return cls(
            node_id=node_id,
            base=base,
            step_s=step_s,
            forward=forward,
            policy=sections.policy,
            risk=sections.risk,
            routing=sections.routing,
            custody=sections.custody,
            store=sections.store,
            data=data or sections.data,
            mavlink=mavlink or sections.mavlink,
            ground=ground,
            own_sensor=own_sensor,
        )

    def node_settings(self) -> NodeSettings:
        """What core needs of it."""
        policy = self.policy.make()
        if policy.replicates and self.data.bytes > INLINE_BYTES:
            raise ConfigError(
                f"data.bytes: expected at most {INLINE_BYTES} with policy stigmergy, got {self.data.bytes}"
            )
        drop_oldest = self.store.overflow == "drop-oldest"
        if drop_oldest and self.custody.mode != "none":
            raise ConfigError("store.overflow: drop-oldest breaks custody, expected custody.mode none with it")
        bounded = not self.base or policy.replicates
        return NodeSettings(
            node_id=self.node_id,
            base=self.base,
            step_s=self.step_s,
            capacity_items=self.store.capacity_items if bounded else None,
            capacity_bytes=self.store.capacity_bytes if bounded else None,
            own_share=policy.own_share if self.store.own_share is None else self.store.own_share,
            drop_oldest=drop_oldest,
            bandwidth_items=self.store.bandwidth_items,
            acknowledged=self.custody.mode == "acknowledged",
            mirror=self.custody.mirrored,
            mirror_until_receipt=self.custody.mirror_until == "receipt" and self.custody.receipts,
            copies_auto=self.custody.copies == "auto",
            immediate=self.forward == "immediate",
            receipts=self.custody.receipts,
            receipt_steps=self.custody.receipt_steps,
            retry_steps=self.custody.retry_steps,
            max_tries=self.custody.max_tries,
            neighbour_steps=self.routing.neighbour_steps,
            max_neighbours=self.routing.max_neighbours,
            max_hops=self.routing.max_hops,
            seq_period=policy.seq_period if self.routing.seq_period is None else self.routing.seq_period,
            lifetime_s=self.data.lifetime_s,
            scrub_items=self.store.scrub_items,
            inline_bytes=INLINE_BYTES,
        )

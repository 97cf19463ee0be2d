"""All settings of one node: the sections of the packages together, and the agent's own."""

from __future__ import annotations

from typing import Annotated, Literal, Protocol

from rass_mav.config.bounds import NonNegative, Positive
from rass_mav.config.sections import Meta, Mistakes, Section
from rass_mav.core.settings import CustodySettings, Forward, NodeSettings, RiskSettings, RoutingSettings
from rass_mav.mavlink.settings import MavlinkSettings
from rass_mav.policy.settings import PolicySettings
from rass_mav.store.settings import StoreSettings
from rass_mav.wire import INLINE_BYTES
from rass_mav.wire.measurement import MEASUREMENT_BYTES

#: By default a status comes once a minute, and on a slow link, where turns are long, once in so many.
USUAL_STATUS_S = 60.0
LEAST_STATUS_TURNS = 60


class DataSettings(Section):
    """The measurements that a node creates."""

    interval_steps: Annotated[int, Meta(ge=0)] = 10
    """Steps between two measurements; 0: none. `due` determines in which steps."""
    due: Literal["step-id", "step+id", "together"] = "step-id"
    """Which number must be a multiple of the interval: (step - node id), (step + node id), or step (all at once)."""
    until_step: Annotated[int, Meta(ge=0)] | None = None
    """No more measurements from this step on."""
    bytes: Annotated[int, Meta(ge=MEASUREMENT_BYTES, le=1 << 20)] = MEASUREMENT_BYTES
    """Smallest size of a measurement. Random bytes fill the space after the measurement itself, which has up to 23.
    With keys it is at most 16 less than what a datum, or under `stigmergy` a frame, holds."""
    lifetime_s: Positive | None = None
    """Data older than this expire, or sooner by their own lifetimes; null: only by these."""
    status_s: NonNegative | None = 0.0
    """Seconds between two status data of a drone; 0: none; null: 60, and more on a slow link."""


class GroundSettings(Section):
    """What a ground station receives, and what it may set."""

    may_set: bool = True
    """Whether a directly connected ground station can set parameters. It can always read them."""
    may_set_by_radio: bool = False
    """The same for senders behind the autopilot's port: anybody in range of its radio can send there."""
    values_s: NonNegative = 10.0
    """Seconds between two NAMED_VALUE_FLOATs of the same name (fitness, hops, risk, fill); 0: never."""
    computer_s: NonNegative = 30.0
    """Seconds between two ONBOARD_COMPUTER_STATUS; 0: never."""


class Sections(Protocol):
    """The sections that a `run` configuration, a scenario and a replay have in common."""

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
    """All settings of one node."""

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
    """Readings come through `Agent.reading`; those of the autopilot are ignored."""
    unit: str | None = None
    """Of the readings, a key of `wire.measurement.UNITS`; None: unknown."""

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
        sensor_unit: str | None = None,
    ) -> AgentSettings:
        """One node's part of a configuration. `data` and `mavlink`, if given, replace its own sections.

        `sensor_unit`: the node has its own sensor, whose readings are in this unit; None: it has none.
        """
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
            own_sensor=sensor_unit is not None,
            unit=sections.risk.unit if sensor_unit is None else sensor_unit,
        )

    def node_settings(self) -> NodeSettings:
        """The settings that the core needs. Raises `ConfigError`."""
        mistakes = Mistakes()
        policy = None
        with mistakes.gathering():
            policy = self.policy.make()
        if policy is not None and policy.replicates and self.data.bytes > INLINE_BYTES:
            mistakes.add(
                "data.bytes", f"expected at most {INLINE_BYTES} with policy {policy.name}, got {self.data.bytes}"
            )
        drop_oldest = self.store.overflow == "drop-oldest"
        if drop_oldest and self.custody.mode != "none":
            mistakes.add("store.overflow", "drop-oldest breaks custody, expected custody.mode none with it")
        mistakes.check()
        assert policy is not None
        bounded = not self.base or policy.replicates
        acknowledged = self.custody.mode == "acknowledged"
        mirrored = acknowledged and self.custody.mirror is not False and not policy.replicates
        until_receipt = self.custody.mirror_until == "receipt" and self.custody.receipts
        return NodeSettings(
            node_id=self.node_id,
            base=self.base,
            step_s=self.step_s,
            capacity_items=self.store.most_items if bounded else None,
            capacity_bytes=self.store.capacity_bytes if bounded else None,
            own_share=policy.own_share if self.store.own_share is None else self.store.own_share,
            drop_oldest=drop_oldest,
            bandwidth_items=self.store.bandwidth_items,
            acknowledged=acknowledged,
            mirror=mirrored and not self.base,
            mirror_until_receipt=until_receipt,
            copies_auto=self.custody.copies == "auto",
            overhear=self.custody.overhear and acknowledged and (self.base or (mirrored and until_receipt)),
            distant=self.custody.distant,
            immediate=self.forward == "immediate",
            receipts=self.custody.receipts,
            digest=self.custody.digest and mirrored and until_receipt,
            receipt_steps=self.custody.receipt_steps,
            retry_steps=self.custody.retry_steps,
            measured=self.custody.retries == "measured",
            max_tries=self.custody.max_tries,
            neighbour_steps=self.routing.neighbour_steps,
            max_neighbours=self.routing.max_neighbours,
            max_hops=self.routing.max_hops,
            queue_toll=self.routing.queue_toll,
            contacts=self.routing.contacts,
            seq_period=policy.seq_period if self.routing.seq_period is None else self.routing.seq_period,
            lifetime_s=self.data.lifetime_s,
            scrub_items=self.store.scrub_items,
            inline_bytes=INLINE_BYTES,
        )

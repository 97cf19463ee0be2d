"""All settings of one node: the sections of the packages together, and the agent's own."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, Literal

from rass_mav.config.sections import Meta, NonNegative, Section
from rass_mav.core.messages import INLINE_BYTES
from rass_mav.core.settings import LifetimeSettings, NodeSettings, RiskSettings
from rass_mav.errors import ConfigError
from rass_mav.mavlink.settings import MavlinkSettings
from rass_mav.policy.settings import PolicySettings
from rass_mav.wire.measurement import MEASUREMENT_BYTES

#: The sections of a node, which a `run` configuration, a scenario and a replay have in common.
SECTIONS = ("policy", "risk", "routing", "custody", "store", "data", "mavlink")
# Tuned: python -m tools.sensitivity agent.settings
#: By default a status comes once a minute, and on a slow link, where turns are long, once in so many.
USUAL_STATUS_S = 60.0
LEAST_STATUS_TURNS = 60


class DataSettings(LifetimeSettings):
    """The data that a node creates."""

    interval_steps: Annotated[int, Meta(ge=0)] = 10
    """Steps between two measurements; 0: none. `due` says which steps."""
    due: Literal["step-id", "step+id", "together"] = "step-id"
    """A node measures when this is a multiple of the interval. step-id: step minus node id; step+id: their sum;
    together: the step, so all nodes at once."""
    until_step: Annotated[int, Meta(ge=0)] | None = None
    """The step from which there are no more measurements; null: none."""
    bytes: Annotated[int, Meta(ge=MEASUREMENT_BYTES, le=1 << 20)] = MEASUREMENT_BYTES
    """Smallest size of a measurement. The measurement itself has 20 to 23 bytes; random bytes fill the rest. With keys
    the maximum is 16 less, and under `stigmergy` what one frame holds."""
    status_s: NonNegative | None = 0.0
    """Time between two status data of a drone; 0: none; null: 60, and more on a slow link."""


class GroundSettings(Section):
    """What a ground station receives, and what it may set."""

    may_set: bool = True
    """Whether a ground station at `url` can set parameters. It can always read them."""
    may_set_by_radio: bool = False
    """The same for senders behind the autopilot, where any sender in range of its radio is heard."""
    values_s: NonNegative = 10.0
    """Time between two reports of fitness, hops, risk and fill (NAMED_VALUE_FLOAT); 0: never."""
    computer_s: NonNegative = 30.0
    """Time between two reports of the computer's state (ONBOARD_COMPUTER_STATUS); 0: never."""


class AgentSettings(NodeSettings):
    """All settings of one node. What its core reads is part of them."""

    policy: PolicySettings = PolicySettings()
    risk: RiskSettings = RiskSettings()
    data: DataSettings = DataSettings()
    mavlink: MavlinkSettings = MavlinkSettings()
    ground: GroundSettings | None = None
    """None: no ground station is answered (the mock swarm has none)."""
    sensor_unit: str | None = None
    """Unit of the node's own sensor, whose readings come through `Agent.reading`; those of the autopilot are then
    ignored. None: it has none."""

    @classmethod
    def of(cls, configuration: Section, **more: Any) -> AgentSettings:
        """One node's part of a configuration, which has all the sections. `more`: the other settings, and sections
        that replace the configuration's own. Raises `ConfigError`."""
        return cls(**{name: getattr(configuration, name) for name in SECTIONS} | more)

    @property
    def unit(self) -> str | None:
        """Of the readings, a key of `wire.measurement.UNITS`; None: unknown."""
        return self.risk.unit if self.sensor_unit is None else self.sensor_unit

    def mistakes(self) -> Iterator[str]:
        """Checks across several sections."""
        policy = None
        try:
            policy = self.policy.make()
        except ConfigError as error:
            yield from error.mistakes
        if policy is not None and policy.replicates and self.data.bytes > INLINE_BYTES:
            yield f"data.bytes: expected at most {INLINE_BYTES} with policy {policy.name}, got {self.data.bytes}"
        if self.store.overflow == "drop-oldest" and self.acknowledged:
            yield "store.overflow: drop-oldest breaks custody, expected custody.mode none with it"

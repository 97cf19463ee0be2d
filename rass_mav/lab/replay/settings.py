"""The settings of a replay: the keys of a scenario, except those that the logs determine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from rass_mav.agent.settings import AgentSettings
from rass_mav.config.loading import set_keys
from rass_mav.config.old_keys import read_old_keys
from rass_mav.config.sections import Mistakes, NonNegative, Positive, Section
from rass_mav.config.typed import build_with
from rass_mav.lab.medium.settings import RadioSection
from rass_mav.lab.swarm.scenario import NodeSection, SwarmSettings
from rass_mav.sensor.dose import TUBES, DoseMeter, Unit
from rass_mav.sensor.kinds import KINDS
from rass_mav.sensor.settings import TubeName, adjusted


class ReplayNodeSection(NodeSection):
    """Settings of every node."""

    step_s: Positive = 1.0
    """Length of a step, seconds."""


class ReplayRadioSection(RadioSection):
    """The air between the nodes."""

    range_m: Positive = 100.0
    """Nodes at most this far away hear a frame, metres in three dimensions."""


class ReplayRadiationSection(Section):
    """What radiation does to stored data."""

    corruption: bool = False
    """Whether data in a drone's store are struck in each step. The probability is the risk from its reading (Eq. 2,
    with the reading taken for one source). Where the reading is unknown nothing is struck."""


class CountsSettings(Section):
    """How counts become readings, for recorded bGeigie logs."""

    unit: Unit = "usvh"
    """usvh: microsievert per hour; cpm, cps: counts per minute, per second."""
    tube: TubeName | None = None
    """Name of the tube; null: the tube of bGeigies, with Safecast's conversion."""
    cpm_per_usvh: Positive | None = None
    """Counts per minute at 1 uSv/h; null: the tube's."""
    dead_time_us: NonNegative | None = None
    """Dead time, microseconds; null: the tube's; 0: no correction."""

    def meter(self) -> DoseMeter:
        """A new converter with these settings."""
        tube = TUBES[self.tube or KINDS["log"].tube]
        return DoseMeter(adjusted(tube, self.cpm_per_usvh, self.dead_time_us), self.unit)


class ReplaySettings(SwarmSettings):
    """A replay."""

    node: ReplayNodeSection = ReplayNodeSection()
    radio: ReplayRadioSection = ReplayRadioSection()
    sensor: CountsSettings = CountsSettings()
    radiation: ReplayRadiationSection = ReplayRadiationSection()

    def with_highest(self, highest: float | None) -> ReplaySettings:
        """Set `risk.high` to the largest reading of the logs, above background. If that is not above `risk.low` (or
        there is no reading), set it 1 above `risk.low`, so that every reading means risk 0."""
        low = self.risk.low
        above = None if highest is None else highest - self.risk.background
        high = above if above is not None and above > low else low + 1.0
        return replace(self, risk=replace(self.risk, high=high))

    def agent_settings(self, node_id: int, system_id: int | None, *, steps: int) -> AgentSettings:
        """The settings of one node.

        :param system_id: of its vehicle; None: it is the base, with no autopilot.
        :param steps: no new data from this step on.
        """
        until = self.data.until_step
        data = replace(self.data, until_step=steps if until is None else min(until, steps))
        return self.settings_of(node_id, base=system_id is None, system_id=system_id, data=data)


def load_settings(range_m: float | None = None, assignments: Sequence[str] = ()) -> tuple[ReplaySettings, bool]:
    """The settings of a replay, from the command line.

    :param range_m: `--range`.
    :param assignments: of `--set`, each `key.path=value`; they come last.
    :returns: the settings, and whether `risk.high` was left open: `with_highest` must then fill it in.
    :raises ConfigError: names the key.
    """
    raw: dict[str, Any] = {}
    if range_m is not None:
        raw["radio"] = {"range_m": range_m}
    mistakes = Mistakes("replay")
    set_keys(raw, assignments, mistakes)
    read_old_keys(raw, mistakes, lab=True)
    risk = raw.setdefault("risk", {})
    is_open = isinstance(risk, dict) and "high" not in risk
    low = risk.get("low", 0.0) if is_open else None
    if isinstance(low, (int, float)):
        # Any value above `low`, until the logs have been read.
        risk["high"] = low + 1.0
    settings = build_with(raw, ReplaySettings, mistakes)
    mistakes.check()
    assert settings is not None
    return settings, is_open

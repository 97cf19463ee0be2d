"""Reports of trouble to the people at the ground station, and how often they are sent."""

from __future__ import annotations

from rass_mav.agent.agent import Agent, VehicleService
from rass_mav.core.alarms import Alarm
from rass_mav.mavlink.messages import CRITICAL, WARNING
from rass_mav.wire.codec import VERSION

#: Seconds between two reports of the same trouble, at least.
REPORT_S = 30.0
#: Seconds between two texts about nodes with another version, whichever nodes: any sender can invent them.
VERSION_TEXT_S = 5.0
#: How many such nodes are remembered as reported: more than there can be texts in `REPORT_S`.
MAX_REPORTED = 64


class Reports(VehicleService):
    """A service of the agent. It knows what was reported, and when that may be reported again."""

    __slots__ = (
        "_agent", "_alarms", "_alarms_at", "_fault_at", "_faults", "_full_at", "_refused", "_rivals_at", "_twins_at",
        "_versions", "_versions_at",
    )  # fmt: skip

    def __init__(self, agent: Agent, now: float) -> None:
        self._agent = agent
        self._rivals_at = self._alarms_at = self._full_at = self._fault_at = self._versions_at = self._twins_at = now
        self._alarms: dict[Alarm, int] = {}
        """How often each had been counted when it was reported last."""
        self._refused = self._faults = 0
        """Measurements refused, and frames that hit a fault, up to the last step."""
        self._versions: dict[int, tuple[float, frozenset[int]]] = {}
        """Node id -> time of the last text about it, and the versions reported. In the order of the texts."""

    def step(self, now: float) -> None:
        """Once a step: report whatever people should know."""
        agent = self._agent
        alarms = agent.node.alarms
        if alarms.rivals and now >= self._rivals_at:
            self._report_rivals(now)
        if alarms.counts and now >= self._alarms_at:
            self._report_alarms(now)
        if agent.peers.other_versions and now >= self._versions_at:
            self._report_versions(now)
        if agent.trust.twins and now >= self._twins_at:
            self._report_twins(now)
        if agent.refused != self._refused:
            self._refused = agent.refused
            if now >= self._full_at:
                self._full_at = now + REPORT_S
                agent.tell_ground(WARNING, f"RASS: store full, {agent.refused} measurements refused so far")
        if agent.guard.faults != self._faults:
            self._faults = agent.guard.faults
            if now >= self._fault_at and agent.guard.last is not None:
                self._fault_at = now + REPORT_S
                agent.tell_ground(
                    CRITICAL,
                    f"RASS: a bug dropped a frame ({agent.guard.last.sender}); please report",
                )

    def _report_rivals(self, now: float) -> None:
        """Other nodes with this node's id."""
        self._rivals_at = now + REPORT_S
        node = self._agent.node
        recent = [life for life, at in node.alarms.rivals.items() if now - at <= REPORT_S]
        if recent:
            self._agent.tell_ground(
                CRITICAL, f"RASS: two nodes have node id {node.id} (other life {recent[0]:08x}): change one"
            )

    def _report_alarms(self, now: float) -> None:
        self._alarms_at = now + REPORT_S
        alarms = self._agent.node.alarms
        for alarm, count in alarms.counts.items():
            if count != self._alarms.get(alarm):
                self._alarms[alarm] = count
                self._agent.tell_ground(CRITICAL, f"RASS: {alarm.value} ({alarms.about[alarm]})")

    def _report_versions(self, now: float) -> None:
        """Nodes with another version: each once per version, and one in a step."""
        own_id = self._agent.node.id
        for node_id, (version, heard) in self._agent.peers.other_versions.items():
            at, reported = self._versions.get(node_id, (now - REPORT_S, frozenset()))
            if version in reported or now - at < REPORT_S or now - heard > REPORT_S:
                continue
            self._versions.pop(node_id, None)
            self._versions[node_id] = (now, reported | {version})
            if len(self._versions) > MAX_REPORTED:
                del self._versions[next(iter(self._versions))]
            self._versions_at = now + VERSION_TEXT_S
            behind = node_id if version < VERSION else own_id
            self._agent.tell_ground(
                WARNING, f"RASS: node {node_id} uses version {version}, this one {VERSION}: update node {behind}"
            )
            return

    def _report_twins(self, now: float) -> None:
        """Other nodes with this node's system and component id."""
        recent = [node_id for node_id, at in self._agent.trust.twins.items() if now - at <= REPORT_S]
        if recent:
            self._twins_at = now + REPORT_S
            own = self._agent.peers.writer
            ids = f"system id {own.system_id} and component {own.component_id}"
            self._agent.tell_ground(CRITICAL, f"RASS: node {recent[-1]} has this {ids}: change one")

"""Reports of trouble to the people at the ground station, and how often they are sent."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from rass_mav.agent.peers import OtherVersion
from rass_mav.core.alarms import Alarm
from rass_mav.core.participant import Participant
from rass_mav.mavlink.frames import FrameWriter
from rass_mav.wire.codec import VERSION

#: Seconds between two reports of the same trouble, at least.
REPORT_S = 30.0
#: Seconds between two texts about nodes with another version, whichever nodes: any sender can invent them.
VERSION_TEXT_S = 5.0
#: How many such nodes are remembered as reported: more than there can be texts in `REPORT_S`.
MAX_TOLD = 64
_CRITICAL = 2
_WARNING = 4

#: Sends a text to the ground; MAV_SEVERITY and the text.
Tell = Callable[[int, str], None]


class Reports:
    """What was reported, and when it may be reported again."""

    __slots__ = (
        "_alarms_at", "_fault_at", "_full_at", "_refused", "_rivals_at", "_told", "_twins_at", "_versions",
        "_versions_at",
    )  # fmt: skip

    def __init__(self, now: float) -> None:
        self._rivals_at = self._alarms_at = self._full_at = self._fault_at = self._versions_at = self._twins_at = now
        self._told: dict[Alarm, int] = {}
        self._refused = 0
        self._versions: dict[int, tuple[float, frozenset[int]]] = {}
        """Node id -> time of the last text about it, and the versions reported. In the order of the texts."""

    def look(self, node: Participant, now: float, tell: Tell) -> None:
        """Once a step: report whatever people should know."""
        alarms = node.alarms
        if alarms.rivals and now >= self._rivals_at:
            self._rivals_at = now + REPORT_S
            recent = [life for life, at in alarms.rivals.items() if now - at <= REPORT_S]
            if recent:
                tell(
                    _CRITICAL,
                    f"RASS: another node with node id {node.id} on the air (life {recent[0]:08x}), change one",
                )
        if alarms.counts and now >= self._alarms_at:
            self._alarms_at = now + REPORT_S
            for alarm, count in alarms.counts.items():
                if count != self._told.get(alarm):
                    self._told[alarm] = count
                    tell(_CRITICAL, f"RASS: {alarm.value} ({alarms.about[alarm]})")

    def versions(self, own_id: int, others: Mapping[int, OtherVersion], now: float, tell: Tell) -> None:
        """Once a step, if nodes with another version were heard. Each is reported once per version."""
        if now < self._versions_at:
            return
        for node_id, (version, heard) in others.items():
            at, told = self._versions.get(node_id, (now - REPORT_S, frozenset()))
            if version in told or now - at < REPORT_S or now - heard > REPORT_S:
                continue
            self._versions.pop(node_id, None)
            self._versions[node_id] = (now, told | {version})
            if len(self._versions) > MAX_TOLD:
                del self._versions[next(iter(self._versions))]
            self._versions_at = now + VERSION_TEXT_S
            behind = node_id if version < VERSION else own_id
            tell(_WARNING, f"RASS: node {node_id} uses version {version}, this one {VERSION}: update node {behind}")
            return

    def twins(self, twins: Mapping[int, float], own: FrameWriter, now: float, tell: Tell) -> None:
        """Once a step: other nodes with this node's system and component id were heard, by node id, and when."""
        if now < self._twins_at:
            return
        recent = [node_id for node_id, at in twins.items() if now - at <= REPORT_S]
        if recent:
            self._twins_at = now + REPORT_S
            ids = f"system id {own.system_id} and component {own.component_id}"
            tell(_CRITICAL, f"RASS: node {recent[-1]} has our {ids}: change one")

    def full(self, now: float, tell: Tell) -> None:
        """A measurement was refused because the store is full."""
        self._refused += 1
        if now >= self._full_at:
            self._full_at = now + REPORT_S
            tell(_WARNING, f"RASS: store full, {self._refused} measurements refused so far")

    def fault(self, sender: str, now: float, tell: Tell) -> None:
        """A frame hit a fault."""
        if now >= self._fault_at:
            self._fault_at = now + REPORT_S
            tell(_CRITICAL, f"RASS: a frame hit a fault in this program and was dropped ({sender}); please report")

"""A node's status: a small datum that percolates to a base like any other. It tells what is lost if the node fails."""

from __future__ import annotations

import logging

from rass_mav.agent.agent import Agent
from rass_mav.agent.settings import LEAST_STATUS_TURNS, USUAL_STATUS_S
from rass_mav.core.datum import Kind
from rass_mav.core.messages import INLINE_BYTES
from rass_mav.errors import StoreFullError
from rass_mav.mavlink.dialect import common
from rass_mav.mavlink.frames import Frame
from rass_mav.wire.nodestatus import NodeStatus, encode_status

log = logging.getLogger(__name__)

_SYS_STATUS: int = common.MAVLINK_MSG_ID_SYS_STATUS
_system_status = common.MAVLink_sys_status_message.unpacker
_BATTERY_REMAINING = 12
#: Of an unlimited store in `Holdings.free`.
_NO_LIMIT = 0xFFFF
#: The part of the interval after which a node sends its first status is its id times this: they are spread evenly.
_GOLDEN = 0.6180339887


class Statuses:
    """A service of the agent. It creates data of kind STATUS."""

    def __init__(self, agent: Agent, interval_s: float | None, now: float) -> None:
        """`interval_s`: seconds between two; None: as usual."""
        self._agent = agent
        self._interval_s = interval_s
        self._due = now + self._interval_now_s() * (agent.node.id * _GOLDEN % 1.0)
        self._battery: int | None = None

    def hear(self, frame: Frame, now: float) -> None:
        """Take the battery from the autopilot's SYS_STATUS
        (https://mavlink.io/en/messages/common.html#SYS_STATUS)."""
        telemetry = self._agent.telemetry
        ours = frame.system_id == telemetry.system_id and frame.component_id == telemetry.component_id
        if ours and frame.message_id == _SYS_STATUS:
            fields = _system_status.unpack_from(frame.payload.ljust(_system_status.size, b"\0"))
            percent = fields[_BATTERY_REMAINING]
            self._battery = percent if 0 <= percent <= 100 else None

    def step(self, now: float) -> None:
        """Create a status if one is due. A full store creates none."""
        until = self._agent.settings.data.until_step
        if now < self._due or (until is not None and self._agent.steps >= until):
            return
        # After a stop it does not make up for those that were missed.
        self._due = max(self._due + self._interval_now_s(), now)
        try:
            # Sealed, too, it goes whole in one frame.
            most = INLINE_BYTES - self._agent.node.seals.added
            self._agent.node.put(encode_status(self._status(now), most), now, Kind.STATUS)
        except StoreFullError as error:
            log.info("no status: %s", error)

    def _interval_now_s(self) -> float:
        if self._interval_s is not None:
            return self._interval_s
        return max(USUAL_STATUS_S, LEAST_STATUS_TURNS * self._agent.node.pace.turn_s)

    def _status(self, now: float) -> NodeStatus:
        node, position = self._agent.node, self._agent.telemetry.position
        holdings, route, free = node.holdings, node.routing.route, node.holdings.free()
        # At a base data are at their goal, and no risk matters.
        alone = {} if node.base else holdings.alone()
        return NodeStatus(
            held=len(holdings.custody),
            alone=sum(alone.values()),
            spares=len(holdings) - len(holdings.custody),
            free=None if free == _NO_LIMIT else free,
            risk=0.0 if node.base else node.risk.risk(now),
            hops=None if route is None else route.hops,
            battery=self._battery,
            place=None if position is None else (position.latitude, position.longitude),
            neighbours={id: neighbour.quality for id, neighbour in node.routing.neighbours.items()},
            alone_by_origin=alone,
            base=node.base,
            next_hop=node.routing.next_hop,
            link_key=self._agent.trust.link_key,
        )

"""The neighbours' radio as the agent sees it: TUNNEL frames to messages, messages to TUNNEL frames."""

from __future__ import annotations

import logging
from collections.abc import Sequence

from rass_mav.agent.outgoing import Outgoing, frames_of
from rass_mav.core.messages import Message
from rass_mav.core.store import Store
from rass_mav.errors import MalformedError
from rass_mav.mavlink.frames import Frame, FrameWriter
from rass_mav.mavlink.identity import addressed_to
from rass_mav.mavlink.reader import FrameReader
from rass_mav.mavlink.tunnel import decode_tunnel
from rass_mav.wire import decode
from rass_mav.wire.codec import ForeignError

log = logging.getLogger(__name__)


class Peers:
    """What is heard from the neighbours is counted here."""

    __slots__ = ("_node_id", "_payload_type", "foreign", "malformed", "reader", "received", "writer")

    def __init__(self, node_id: int, writer: FrameWriter, payload_type: int) -> None:
        """:param payload_type: of the swarm's TUNNEL messages."""
        self._node_id = node_id
        self._payload_type = payload_type
        self.writer = writer
        self.reader = FrameReader()
        self.received = 0
        """TUNNEL frames of ours heard from the radio, whoever they were for."""
        self.malformed = 0
        """TUNNEL payloads that do not parse."""
        self.foreign = 0
        """TUNNEL payloads of another version, type or purpose."""

    def understood(self, frame: Frame, now: float) -> Message | None:
        """The message in a frame with a TUNNEL message; None: it is not for this node, or cannot be understood."""
        try:
            tunnel = decode_tunnel(frame.payload)
        except MalformedError as error:
            self._count(error)
            return None
        return self.message(tunnel.target_system, tunnel.target_component, tunnel.payload_type, tunnel.payload, now)

    def message(self, system: int, component: int, payload_type: int, payload: bytes, now: float) -> Message | None:
        """The same with a frame taken apart."""
        if payload_type != self._payload_type:
            self.foreign += 1
            return None
        self.received += 1
        writer = self.writer
        if (system or component) and not addressed_to(system, component, writer.system_id, writer.component_id):
            return None
        try:
            return decode(payload, now, self._node_id)
        except MalformedError as error:
            self._count(error)
            return None

    def _count(self, error: MalformedError) -> None:
        if isinstance(error, ForeignError):
            self.foreign += 1
        else:
            self.malformed += 1
        log.debug("frame not understood: %s", error)

    def frames(self, messages: Sequence[Message], store: Store, now: float) -> list[Outgoing]:
        """Messages for the neighbours in frames."""
        return frames_of(messages, self.writer, self._payload_type, store, now)

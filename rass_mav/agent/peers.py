"""The agent's view of the neighbours' radio: turns TUNNEL frames into messages, and messages into TUNNEL frames."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

from rass_mav.agent.outgoing import Outgoing, frames_about_links, frames_of, held_back
from rass_mav.agent.seam import KEYLESS, NO_STREAM, Keyless
from rass_mav.core.messages import BROADCAST, Message, Urgency
from rass_mav.core.pace import Pace
from rass_mav.core.store import Store
from rass_mav.errors import MalformedError
from rass_mav.mavlink.frames import Frame, FrameReader, FrameWriter, Stream
from rass_mav.mavlink.identity import addressed_to
from rass_mav.mavlink.messages import TUNNEL
from rass_mav.mavlink.tunnel import TUNNEL_AHEAD, decode_tunnel
from rass_mav.wire import decode, is_overheard, target_of
from rass_mav.wire.codec import MORE_HEAD, VERSION, ForeignError

log = logging.getLogger(__name__)

#: How many nodes with another version are remembered.
MAX_OTHERS = 16
#: How many nodes' system ids are remembered.
MAX_SPEAKERS = 256

#: A TUNNEL message: target system and component, payload type, payload, the target node id in the payload, and the
#: message in it, if it is decoded already.
Opened: TypeAlias = tuple[int, int, int, bytes, int, Message | None]


def head_of(frame: Frame) -> bytes:
    """The bytes of a TUNNEL message's payload that say what kind it is: one, or two where the first has no room."""
    head = frame.payload[TUNNEL_AHEAD : TUNNEL_AHEAD + 2]
    return head if head[:1] == MORE_HEAD else head[:1]


class OtherVersion(NamedTuple):
    """A node that uses another version of the wire format. Any sender can claim this in its name."""

    version: int
    """Major version, 0..15."""
    heard: float
    """When it was last heard, seconds."""


class Peers:
    """Decodes and counts what is heard from the neighbours."""

    __slots__ = (
        "_node_id", "_payload_type", "_trust", "foreign", "malformed", "other_versions", "overhears", "reader",
        "received", "system_ids", "writer",
    )  # fmt: skip

    def __init__(self, node_id: int, writer: FrameWriter, payload_type: int, trust: Keyless = KEYLESS) -> None:
        """:param payload_type: of the swarm's TUNNEL messages.
        :param trust: what keys do at its links; it sends with this `writer`.
        """
        self._node_id = node_id
        self._payload_type = payload_type
        self._trust = trust
        self.writer = writer
        self.reader = FrameReader(trust.check())
        self.overhears = False
        """Whether data for other nodes are for this node too."""
        self.received = 0
        """TUNNEL frames of our payload type heard from the radio, whatever their target."""
        self.malformed = 0
        """TUNNEL payloads that do not parse."""
        self.foreign = 0
        """TUNNEL payloads of another version, type or purpose."""
        self.other_versions: dict[int, OtherVersion] = {}
        """By node id, the longest silent first. Use it only to inform people: any sender can forge it."""
        self.system_ids: dict[int, int] = {}
        """System id of each node's last beacon, by node id, the longest silent first. Use it only to inform people."""

    def tunnels(self, data: bytes) -> list[Frame]:
        """The frames with TUNNEL messages in a datagram of whole frames."""
        return [frame for frame in self.reader.datagram(data) if frame.message_id == TUNNEL]

    def understood(self, frame: Frame, now: float) -> Message | None:
        """The message in a frame with a TUNNEL message; None: it is not for this node, not new, or does not parse."""
        try:
            tunnel = decode_tunnel(frame.payload)
        except MalformedError as error:
            self._count(error, now)
            return None
        opened = (*tunnel, target_of(tunnel.payload), None)
        if not self._is_admitted(opened, frame.stream, frame.timestamp, now):
            return None
        return self.message(opened, now, frame.stream, frame)

    def heard(self, datagram: bytes, opened: Opened, now: float) -> Message | None:
        """The same for a datagram of one frame that is opened already: for all that hear it together."""
        if self._trust is KEYLESS:
            return self.message(opened, now)
        stamp = self._trust.stamp(datagram)
        if stamp is None:
            # It refuses the frame too, and counts it.
            self.reader.datagram(datagram)
        elif self._is_admitted(opened, *stamp, now):
            return self.message(opened, now, stamp[0])
        return None

    def _is_admitted(self, opened: Opened, stream: Stream, timestamp: int, now: float) -> bool:
        _, _, payload_type, payload, _, _ = opened
        return self._trust.admit(stream, timestamp, payload if payload_type == self._payload_type else b"", now)

    def message(
        self, opened: Opened, now: float, stream: Stream = NO_STREAM, frame: Frame | None = None
    ) -> Message | None:
        """The same where keys have no objection to the frame, or there are none."""
        system, component, payload_type, payload, target, message = opened
        if payload_type != self._payload_type:
            self.foreign += 1
            return None
        self.received += 1
        if target != BROADCAST and target != self._node_id and not (self.overhears and is_overheard(payload)):
            return None
        if (system or component) and not addressed_to(
            system, component, self.writer.system_id, self.writer.component_id
        ):
            return None
        trust = self._trust
        if message is not None and trust is KEYLESS:
            return message
        try:
            if trust is KEYLESS:
                return decode(payload, now)
            if payload[:1] == MORE_HEAD and trust.takes(payload, stream, now):
                return None
            return trust.believe(message or decode(payload, now), payload, stream, frame, now)
        except MalformedError as error:
            self._count(error, now)
            return None

    def beacon_from(self, node_id: int, system_id: int) -> None:
        """Remember the system id under which a neighbour sent a beacon."""
        ids = self.system_ids
        ids.pop(node_id, None)
        ids[node_id] = system_id
        if len(ids) > MAX_SPEAKERS:
            del ids[next(iter(ids))]

    def _count(self, error: MalformedError, now: float) -> None:
        if isinstance(error, ForeignError):
            self.foreign += 1
            if error.sender is not None and error.version != VERSION:
                others = self.other_versions
                others.pop(error.sender, None)
                others[error.sender] = OtherVersion(error.version, now)
                if len(others) > MAX_OTHERS:
                    del others[next(iter(others))]
        else:
            self.malformed += 1
        log.debug("frame not understood: %s", error)

    def frames(self, messages: Sequence[Message], store: Store, now: float) -> list[Outgoing]:
        """The frames with these messages for the neighbours."""
        if not messages:
            return []
        if self._trust is KEYLESS:
            return frames_of(messages, self.writer, self._payload_type, store, now)
        # Before the messages that they prove.
        frames = frames_about_links(self._trust.introductions(now), self.writer, self._payload_type)
        return self._claimed(frames + frames_of(messages, self.writer, self._payload_type, store, now, self._trust))

    def frames_of_turn(self, messages: Sequence[Message], store: Store, now: float) -> list[Outgoing]:
        """The frames of a turn: with keys, what shows that bases are heard, asks for it, and key updates are among
        them."""
        if self._trust is KEYLESS:
            return frames_of(messages, self.writer, self._payload_type, store, now)
        payloads, messages = self._trust.turn(messages)
        about = frames_about_links(payloads, self.writer, self._payload_type, Urgency.DATA)
        return self._claimed(about) + self.frames(messages, store, now)

    def about_links(self, now: float, pace: Pace) -> list[Outgoing]:
        """The frames in which this node asks others who they are, and for keys, and answers them. Call it in each
        step."""
        return self._claimed(frames_about_links(self._trust.due(now, pace), self.writer, self._payload_type))

    def _claimed(self, frames: list[Outgoing]) -> list[Outgoing]:
        """These frames, held back if their timestamps are not claimed on disk yet."""
        return frames if self._trust.covers() else held_back(frames)

    def leaving(self, outgoing: Outgoing) -> Outgoing:
        """A frame to the neighbours as it leaves, with its signature. Call it when the frame need not wait any more."""
        if self._trust is KEYLESS:
            return outgoing
        return outgoing._replace(frame=self._trust.sign(outgoing.frame))

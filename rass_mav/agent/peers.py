"""The agent's view of the neighbours' radio: turns TUNNEL frames into messages, and messages into TUNNEL frames."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple, TypeAlias

from rass_mav.agent.outgoing import Outgoing, frames_about_links, frames_of, held_back
from rass_mav.core.messages import BROADCAST, Beacon, Message, Urgency
from rass_mav.core.pace import Pace
from rass_mav.core.store import Store
from rass_mav.errors import MalformedError
from rass_mav.mavlink.frames import FLAG_SIGNED, Frame, FrameWriter, Stream
from rass_mav.mavlink.identity import addressed_to
from rass_mav.mavlink.messages import TUNNEL
from rass_mav.mavlink.reader import FrameReader
from rass_mav.mavlink.signing import SIGNATURE_SIZE, SigningKey
from rass_mav.mavlink.tunnel import TUNNEL_AHEAD, decode_tunnel, tunnel_from_datagram
from rass_mav.trust.signed import Signed
from rass_mav.trust.streams import Verdict
from rass_mav.trust.tags import OPEN, NoTags
from rass_mav.trust.word import Word
from rass_mav.wire import beacon_sender, decode, is_overheard, target_of
from rass_mav.wire.codec import MORE_HEAD, VERSION, ForeignError
from rass_mav.wire.introduction import is_introduction
from rass_mav.wire.word import is_word

log = logging.getLogger(__name__)

#: How many nodes with another version are remembered.
MAX_OTHERS = 16
#: How many nodes' system ids are remembered.
MAX_SPEAKERS = 256

#: A TUNNEL message: target system and component, payload type, payload, and the target node id in the payload.
Opened: TypeAlias = tuple[int, int, int, bytes, int]


# In a mock swarm all receivers of a frame open it one after another.
@lru_cache(maxsize=16)
def open_datagram(data: bytes) -> Opened | None:
    """Open a datagram that is exactly one frame with a TUNNEL message, whoever signed it. None: it is anything else."""
    fields = tunnel_from_datagram(data)
    return None if fields is None else (*fields[2:], target_of(fields[5]))


@lru_cache(maxsize=16)
def stamp_of(data: bytes, key: SigningKey) -> tuple[Stream, int] | None:
    """Stream and timestamp of a datagram that is exactly one frame. None: the key has not signed it."""
    if not data[2] & FLAG_SIGNED or not key.made(data):
        return None
    return (data[5], data[6], data[-SIGNATURE_SIZE]), int.from_bytes(data[-12:-6], "little")


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
        "_node_id", "_payload_type", "foreign", "malformed", "other_versions", "overhears", "reader", "received",
        "signed", "system_ids", "tags", "word", "writer",
    )  # fmt: skip

    def __init__(
        self, node_id: int, writer: FrameWriter, payload_type: int, signed: Signed | None = None, tags: NoTags = OPEN
    ) -> None:
        """:param payload_type: of the swarm's TUNNEL messages.
        :param signed: of this `writer`; None: frames are not signed, and signatures not checked.
        :param tags: prove this node's words, and doubt others'.
        """
        self._node_id = node_id
        self._payload_type = payload_type
        self.signed = signed
        self.tags = tags
        if signed is not None:
            tags.use(signed.streams)
        self.word: Word | None = None
        """What is known of the ground's word; None: there are no keys, and bases are believed."""
        self.writer = writer
        self.reader = FrameReader(None if signed is None else signed.check())
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
        opened = (*tunnel, target_of(tunnel.payload))
        if not self._admits(frame.stream, frame.timestamp, opened, now):
            return None
        return self._believed(self.message(opened, now, frame.stream), tunnel.payload, frame.stream, frame)

    def heard(self, datagram: bytes, opened: Opened, now: float) -> Message | None:
        """The same for the datagram that `open_datagram` has opened."""
        stream = (0, 0, 0)
        if self.signed is not None:
            stamp = stamp_of(datagram, self.signed.key)
            if stamp is None:
                # It refuses the frame too, and counts it.
                self.reader.datagram(datagram)
                return None
            stream = stamp[0]
            if not self._admits(*stamp, opened, now):
                return None
        return self._believed(self.message(opened, now, stream), opened[3], stream, None)

    def _believed(self, message: Message | None, payload: bytes, stream: Stream, frame: Frame | None) -> Message | None:
        if self.word is None or message is None:
            return message
        return self.word.admit(message, payload, self._bringer(stream), frame)

    def _bringer(self, stream: Stream) -> Stream:
        return stream if self.signed is None else self.signed.streams.bringer(stream)

    def _admits(self, stream: Stream, timestamp: int, opened: Opened, now: float) -> bool:
        """Whether a frame is new, and the node may look at it. Introductions are, since they show that themselves."""
        if self.signed is None:
            return True
        payload = opened[3] if opened[2] == self._payload_type else b""
        if is_introduction(payload):
            return True
        verdict = self.signed.admit(stream, timestamp, payload, now)
        if verdict is Verdict.STRANGE or verdict is Verdict.LATE:
            sender = beacon_sender(payload)
            if sender is not None and sender != self._node_id:
                self.tags.meet(sender, now, stream)
        return verdict is Verdict.NEW

    def message(self, opened: Opened, now: float, stream: Stream = (0, 0, 0)) -> Message | None:
        """The message in a frame that is open, and new. `stream`: whose it is, if it is signed."""
        system, component, payload_type, payload, target = opened
        if payload_type != self._payload_type:
            self.foreign += 1
            return None
        self.received += 1
        if target != self._node_id and target != BROADCAST and not (self.overhears and is_overheard(payload)):
            return None
        if (system or component) and not addressed_to(
            system, component, self.writer.system_id, self.writer.component_id
        ):
            return None
        try:
            if payload[:1] == MORE_HEAD:
                if self.tags.introduced(payload, now, stream):
                    return None
                if self.word is not None and is_word(payload):
                    self.word.hear(payload, self._bringer(stream))
                    return None
            return self.tags.believed(decode(payload, now), payload, now, stream)
        except MalformedError as error:
            self._count(error, now)
            return None

    def beacon_from(self, node_id: int, system_id: int) -> None:
        """Remember the system id under which a neighbour sent a beacon."""
        known = self.system_ids
        known.pop(node_id, None)
        known[node_id] = system_id
        if len(known) > MAX_SPEAKERS:
            del known[next(iter(known))]

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
        # Before the words that they prove.
        frames = frames_about_links(self.tags.introductions(now), self.writer, self._payload_type)
        return self._claimed(frames + frames_of(messages, self.writer, self._payload_type, store, now, self.tags))

    def frames_of_turn(self, messages: Sequence[Message], store: Store, now: float) -> list[Outgoing]:
        """The frames of a turn: with keys, what shows that bases are heard, and asks for it, is among them."""
        messages = [self.tags.shown(message) if type(message) is Beacon else message for message in messages]
        if self.word is None:
            return self.frames(messages, store, now)
        payloads, messages = self.word.turn(messages)
        about = frames_about_links(payloads, self.writer, self._payload_type, Urgency.DATA)
        return self._claimed(about) + self.frames(messages, store, now)

    def about_links(self, now: float, pace: Pace) -> list[Outgoing]:
        """The frames in which this node asks others who they are, and answers them, and those about a change of the
        link key. Call it in each step."""
        signed = self.signed
        if signed is None:
            return []
        rolls, letters = signed.letters.due(now, pace.turn_s, pace.items)
        payloads = rolls + self.tags.introductions(now)
        out = frames_about_links(payloads, self.writer, self._payload_type)
        return self._claimed(out + frames_about_links(letters, self.writer, self._payload_type, Urgency.DATA))

    def _claimed(self, frames: list[Outgoing]) -> list[Outgoing]:
        """These frames, held back if their timestamps are not claimed on disk yet."""
        return frames if self.signed is None or self.signed.timestamps.cover() else held_back(frames)

    def leaving(self, outgoing: Outgoing) -> Outgoing:
        """A frame to the neighbours as it leaves: with its signature. Call it when the frame has not to wait any more.

        Signed earlier, what waits for the disk would be overtaken by too many others.
        """
        if self.signed is None:
            return outgoing
        return outgoing._replace(frame=self.signed.timestamps.sign(outgoing.frame))

"""What keys do for a node, and what it does without any: the one interface between a node and `rass_mav.trust`.

A node without keys has `KEYLESS`. It loads nothing of `rass_mav.trust`, which has the other implementation.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, ClassVar, Protocol

from rass_mav.core.messages import Message
from rass_mav.core.pace import Pace
from rass_mav.core.participant import Participant
from rass_mav.core.seals import NO_SEALS, ContentHashes, NoSeals
from rass_mav.core.store import Store
from rass_mav.mavlink.frames import Frame, FrameWriter, Stream
from rass_mav.mavlink.messages import RADIO_STATUS
from rass_mav.mavlink.signing import SignatureCheck
from rass_mav.wire import encode

#: Of frames that are not signed.
NO_STREAM: Stream = (0, 0, 0)


def all_but_radio(message_id: int) -> bool:
    """Whether messages with this id must be signed: all but RADIO_STATUS, which the node's own radio sends."""
    return message_id != RADIO_STATUS


class Keyless:
    """What is decided about frames and messages in one life of a node without keys: everything is believed."""

    __slots__ = ()

    content_hashes: ClassVar[ContentHashes] = ContentHashes()
    """What answers to hand-overs confirm."""

    # -- the node's own ------------------------------------------------------------------------------------------------

    def seals(self, store: Store) -> NoSeals:
        """What the keys do to data, from what the store holds now on."""
        return NO_SEALS

    def connect(self, writer: FrameWriter, payload_type: int, start: int | None = None) -> None:
        """Before anything is heard or sent: what sends the node's frames, and the type of the swarm's TUNNEL messages.

        `start`: 15 bits, where its beacons begin; None: drawn."""

    def serve(self, node: Participant) -> None:
        """From now on all is for this participant."""

    def begin(self, tell: Callable[[int, str], None]) -> None:
        """`tell` reports to the ground: MAV_SEVERITY and a text."""

    # -- what comes in -------------------------------------------------------------------------------------------------

    def check(self, needed: Callable[[int], bool] = all_but_radio) -> SignatureCheck | None:
        """For a reader: whether frames are signed rightly; None: signatures are not checked. `needed`: returns whether
        messages with this id must be signed."""
        return None

    def stamp(self, datagram: bytes) -> tuple[Stream, int] | None:
        """Stream and timestamp of a datagram that is exactly one frame. None: the link key has not signed it."""
        return NO_STREAM, 0

    def admit(self, stream: Stream, timestamp: int, payload: bytes, now: float) -> bool:
        """Whether a frame is new, and the node may look at it.

        :param payload: of its TUNNEL, if it is of the swarm's type; otherwise empty.
        """
        return True

    def takes(self, payload: bytes, stream: Stream, now: float) -> bool:
        """Whether a TUNNEL payload is about keys; if so, it was taken here. Raises `MalformedError`."""
        return False

    def believe(
        self, message: Message, payload: bytes, stream: Stream, frame: Frame | None, now: float
    ) -> Message | None:
        """A message that was heard, without what its sender has not said; None: nothing is left of it, or it waits.

        :param payload: of its TUNNEL. :param frame: in which it came, if somebody needs that later.
        """
        return message

    def proves(self, message: Message) -> bool:
        """Whether nobody but its sender can have said a message that is believed."""
        return False

    def released(self) -> Sequence[tuple[Message, Frame | None]]:
        """Once a step: the statements of bases that core may hear now, because the ground has signed them, and the
        frames in which they came; None: that was not kept."""
        return []

    # -- what goes out -------------------------------------------------------------------------------------------------

    def encoded(self, message: Message, store: Store, now: float) -> list[bytes]:
        """The TUNNEL payloads of a message of this node."""
        return encode(message, now)

    def turn(self, messages: Sequence[Message]) -> tuple[list[bytes], Sequence[Message]]:
        """Once a turn: TUNNEL payloads to send, and the messages of this turn as they should leave."""
        return [], messages

    def introductions(self, now: float) -> list[bytes]:
        """What this node has to say of itself now, as TUNNEL payloads for everybody."""
        return []

    def due(self, now: float, pace: Pace) -> list[bytes]:
        """Once a step: what this node asks about keys, and answers, as TUNNEL payloads for everybody."""
        return []

    def covers(self) -> bool:
        """Whether frames that are made now may leave at once. If not, they may when the store has committed."""
        return True

    def sign(self, frame: bytes) -> bytes:
        """A frame to the neighbours as it leaves. Call it for frames that may leave, in their order on the air."""
        return frame

    def refresh(self, frame: bytes, newest: int) -> tuple[bytes, int]:
        """A frame that has waited for its link, signed again if hearers would refuse it as late; and the highest
        timestamp that has left on this link, which was `newest`."""
        return frame, newest

    # -- for people ----------------------------------------------------------------------------------------------------

    @property
    def link_key(self) -> int | None:
        """Number of the link key in use; None: links are open."""
        return None

    @property
    def twins(self) -> Mapping[int, float]:
        """Other nodes with this node's system and component id, by node id: when the last beacon came, seconds."""
        return MappingProxyType({})

    def report(self, now: float) -> dict[str, Any]:
        """For `status`."""
        return {"authentication": None, "statement_signatures": None, "streams": None}


#: It has no state.
KEYLESS = Keyless()


class Keys(Protocol):
    """A node's keys, over all its lives."""

    def life(self, node_id: int, store: Store, rng: random.Random, step_s: float) -> Keyless:
        """What they do in a life that begins. `step_s`: seconds."""

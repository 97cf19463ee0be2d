"""From messages to frames for the neighbours: to whom, how urgent, and whether they rest on the disk."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from rass_mav.core.messages import (
    BROADCAST,
    Accept,
    Beacon,
    Chunk,
    Committed,
    Data,
    Message,
    Offer,
    PassedOn,
    Put,
    Query,
    Receipt,
    Sack,
    Words,
)
from rass_mav.core.store import Store
from rass_mav.link.airtime import Urgency
from rass_mav.mavlink.frames import FrameWriter
from rass_mav.wire import encode

_URGENCIES: dict[type, Urgency] = {
    Beacon: Urgency.BEACON,
    Committed: Urgency.ANSWER,
    Accept: Urgency.ANSWER,
    Sack: Urgency.ANSWER,
    PassedOn: Urgency.ANSWER,
    Words: Urgency.ANSWER,
}
_PROMISES_NOTHING = frozenset((Beacon, Query, Accept, Chunk, Sack, Words))
_FOR_EVERYBODY = frozenset((Beacon, Receipt, Put))


class Outgoing(NamedTuple):
    """A frame for the neighbours."""

    frame: bytes
    target: int
    """Node id of the neighbour it is for, or BROADCAST. Everybody in range may hear it all the same."""
    promises: bool
    """True: it rests on what is not on disk yet, and must not leave before the store has committed."""
    urgency: Urgency = Urgency.DATA
    """What goes first where airtime is short."""


def frames_of(
    messages: Sequence[Message], writer: FrameWriter, payload_type: int, store: Store, now: float
) -> list[Outgoing]:
    """Messages in frames of `writer`, in the same order. `now`: seconds on the node's timeline, for ages."""
    tunnel = writer.tunnel
    out = []
    for message in messages:
        target = BROADCAST if type(message) in _FOR_EVERYBODY else message.target  # type: ignore[union-attr]
        promises = _promises(message, store)
        urgency = _URGENCIES.get(type(message), Urgency.DATA)
        for payload in encode(message, now):
            out.append(Outgoing(tunnel(payload, payload_type=payload_type), target, promises, urgency))
    return out


def _promises(message: Message, store: Store) -> bool:
    """Whether a message may rest on something that is not on disk yet.

    Data that are on disk leave at once: so a node whose disk is full can still hand on what it has.
    """
    if type(message) in _PROMISES_NOTHING:
        return False
    if type(message) is Data:
        return not all(store.durable(handover.datum.id) for handover in message.handovers)
    if type(message) is Offer:
        return not store.durable(message.id)
    return True

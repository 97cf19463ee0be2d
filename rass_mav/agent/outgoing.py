"""The frames that leave a node: where each goes, how urgent it is, and whether it must wait for the disk."""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

from rass_mav.agent.seam import KEYLESS, Keyless
from rass_mav.core.messages import BROADCAST, KINDS, Message, Urgency, destination
from rass_mav.core.store import Store
from rass_mav.mavlink.frames import FrameWriter


class Way(IntEnum):
    """Where a frame goes, or came from."""

    VEHICLE = 0
    """The autopilot, and through it the ground."""
    GROUND = 1
    """A ground station, directly (`ground.url`)."""
    NEIGHBOURS = 2


class Outgoing(NamedTuple):
    """A frame that leaves."""

    frame: bytes
    target: int
    """Node id of the neighbour it is for, or BROADCAST. Every node in range may hear it in either case."""
    promises: bool
    """True: it depends on changes that are not on disk yet, and must not leave before the store has committed."""
    urgency: Urgency = Urgency.DATA
    """Which frames leave first where airtime is short."""
    way: Way = Way.NEIGHBOURS


def aside(frame: bytes, way: Way, *, promises: bool = False) -> Outgoing:
    """A frame for the autopilot or the ground."""
    return Outgoing(frame, BROADCAST, promises, Urgency.VEHICLE, way)


def frames_of(
    messages: Sequence[Message],
    writer: FrameWriter,
    payload_type: int,
    store: Store,
    now: float,
    trust: Keyless = KEYLESS,
) -> list[Outgoing]:
    """The messages as frames of `writer`, in the same order. `now`: seconds on the node's timeline, for ages."""
    tunnel, unwritten = writer.tunnel, store.unwritten
    out = []
    for message in messages:
        target, urgency = destination(message)
        promises = False
        if unwritten:
            data = KINDS[type(message)].rests(message)
            # Data that are on disk leave at once, so a node whose disk is full can still hand over its data.
            promises = data is None or not all(map(store.durable, data))
        for payload in trust.encoded(message, store, now):
            out.append(Outgoing(tunnel(payload, payload_type=payload_type), target, promises, urgency))
    return out


def frames_about_links(
    payloads: Sequence[bytes], writer: FrameWriter, payload_type: int, urgency: Urgency = Urgency.ANSWER
) -> list[Outgoing]:
    """TUNNEL payloads that are no messages of core, as frames of `writer` to everybody in range."""
    frames = (writer.tunnel(payload, payload_type=payload_type) for payload in payloads)
    return [Outgoing(frame, BROADCAST, False, urgency) for frame in frames]


def held_back(frames: Sequence[Outgoing]) -> list[Outgoing]:
    """The same frames, which must not leave before the store has committed."""
    return [outgoing._replace(promises=True) for outgoing in frames]

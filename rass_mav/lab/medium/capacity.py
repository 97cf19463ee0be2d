"""The one-hop capacity of an air: how much nodes that all hear each other can hand over to each other. It is worked out
from the properties of the channel, not measured, so it does not depend on what the nodes do with it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from random import Random
from typing import NamedTuple

from rass_mav.agent.outgoing import frames_of
from rass_mav.core.custody.flow import SACK_EVERY
from rass_mav.core.datum import DatumId, Kind, make_datum
from rass_mav.core.messages import (
    CHUNK_BYTES,
    INLINE_BYTES,
    Accept,
    Beacon,
    Chunk,
    Committed,
    Data,
    Handover,
    Message,
    Offer,
    Sack,
    Urgency,
)
from rass_mav.link.airtime import Pacer
from rass_mav.mavlink.frames import FrameWriter
from rass_mav.store.memory import MemoryStore
from rass_mav.wire import encode

from .channel import MOST_SLOTS
from .settings import Channel, RadioSection

_ID = DatumId(1, 1, 1)
# A MAVLink frame ends without the zeros at its end, so the last fields are large.
_BEACON = Beacon(1, 1, 1, 0, 0, 1, 1, 1, 0, 0, 1, 1, 1, 1, 1, 0xFFFF)


class _Part(NamedTuple):
    """Equal frames of a hand-over."""

    bytes: int
    """Of one frame."""
    urgency: Urgency
    times: float
    """How many frames."""


def _part(message: Message, times: float = 1.0) -> _Part:
    (out,) = frames_of([message], FrameWriter(1, 1), 1, MemoryStore(1), 0.0)
    return _Part(len(out.frame), out.urgency, times)


def one_hop_bytes_s(radio: RadioSection, size: int, *, nodes: int, step_s: float) -> float:
    """Bytes of payload a second that nodes hand over when they all have data to send and all hear each other.

    Answers and beacons are counted in. Nothing collides, and nothing is sent twice. With `radio.air` none it is the
    capacity of the preset.

    :param radio: with a preset, or an air that takes time.
    :param size: of the data, bytes.
    :param nodes: how many hear each other, at least 2.
    :param step_s: seconds between two beacons of a node.
    """
    channel = (replace(radio, air=None) if radio.kind == "none" else radio).channel
    items = _items(size)
    parts = list(_hand_over(size, items))
    airtime_s = _airtime_s(channel, parts)
    beacons = nodes / step_s * _occupied_s(channel, _part(_BEACON).bytes)
    rate = max(1.0 - beacons, 0.0) / airtime_s
    if channel.budget is not None:
        # Each node takes its part, so many bytes of data and so many data in each turn. One of them only receives.
        pacer = Pacer(channel.budget, Random(0), now=0.0, step_s=step_s)
        pacer.neighbours = nodes - 1
        pace = pacer.pace()
        data_bytes = sum(part.times * part.bytes for part in parts if part.urgency is Urgency.DATA)
        rate = (nodes - 1) * min(pacer.data_rate / data_bytes, pace.items / pace.turn_s / items)
    if channel.air == "tdma":
        # The slots of others stay empty.
        rate = min(rate, min(nodes / (channel.slots or MOST_SLOTS), 1.0) / airtime_s)
    return items * size * rate


def hand_over_s(radio: RadioSection, size: int) -> float:
    """How long the air is taken for the hand-over of one datum of `size` bytes, alone in its frame, and its answer,
    seconds. `radio`: an air that takes time."""
    return _airtime_s(radio.channel, _hand_over(size, 1))


def _airtime_s(channel: Channel, parts: Iterable[_Part]) -> float:
    return sum(part.times * (_occupied_s(channel, part.bytes) + channel.answer_s) for part in parts)


def _occupied_s(channel: Channel, frame_bytes: int) -> float:
    """How long the air is taken for a frame, with the silence around it, seconds."""
    airtime_s = channel.airtime(frame_bytes)
    if channel.air == "tdma":
        return airtime_s * channel.slot_s / (channel.slot_s - channel.gap_s)
    return airtime_s + channel.gap_s + channel.window / 2 * channel.slot_s


def _items(size: int) -> int:
    """How many data of this size go into one frame; 1 if they are sent in chunks."""
    items = 1
    while size <= INLINE_BYTES and len(encode(_data(size, items + 1), 0.0)) == 1:
        items += 1
    return items


def _data(size: int, items: int) -> Data:
    return Data(1, 1, (Handover(1, make_datum(_ID, Kind.BYTES, 0.0, b"\xff" * size)),) * items)


def _hand_over(size: int, items: int) -> Iterator[_Part]:
    """The frames by which data of this size are handed over."""
    if size <= INLINE_BYTES:
        yield _part(_data(size, items))
    else:
        chunks = size / CHUNK_BYTES
        yield _part(Offer(1, 1, 1, _ID, Kind.BYTES, 0.0, 0, 1, size, CHUNK_BYTES))
        yield _part(Accept(1, 1, 1, 1, 0x3FFF))
        yield _part(Chunk(1, 1, 0, False, b"\xff" * CHUNK_BYTES), chunks)
        yield _part(Sack(1, 1, 1, 1, 1), chunks / SACK_EVERY)
    yield _part(Committed(1, 1, ((1, 0xFFFFFFFF),) * items, ()))

"""A bGeigie log as the frames that an autopilot would have sent, so that a counter that was driven around replays as a
vehicle."""

from __future__ import annotations

from collections.abc import Iterator

from rass_mav.mavlink.dialect import payload_of
from rass_mav.mavlink.frames import FrameWriter
from rass_mav.mavlink.messages import (
    GLOBAL_POSITION_INT,
    HEARTBEAT,
    NAMED_VALUE_FLOAT,
    autopilot_heartbeat,
    global_position_int_payload,
    named_value_float_payload,
)
from rass_mav.mavlink.reader import FrameReader
from rass_mav.sensor.bgeigie_log import BgeigieLog
from rass_mav.sensor.dose import DoseMeter

from .tlog import Record

_HEARTBEAT = payload_of(autopilot_heartbeat())


def system_id_of(log: BgeigieLog) -> int:
    """A system id, 1..255, for the device of a log: its number, from 256 on counted from 1 again."""
    return (log.records[0].device - 1) % 255 + 1


def spoken(log: BgeigieLog, system_id: int, reading_name: str, meter: DoseMeter) -> Iterator[Record]:
    """For each measurement a heartbeat, the position if there was a fix, and the reading if it was valid.

    :param log: with at least one record.
    """
    writer, reader = FrameWriter(system_id, 1), FrameReader()
    begin_us = log.records[0].time_us
    ground: float | None = None
    for _, time_us, cpm, place in log.records:
        boot_ms = (time_us - begin_us) // 1000
        said = [(HEARTBEAT, _HEARTBEAT)]
        if place is not None:
            ground = place.altitude if ground is None else ground
            said.append((GLOBAL_POSITION_INT, global_position_int_payload(*place, place.altitude - ground, boot_ms)))
        if cpm is not None:
            said.append((NAMED_VALUE_FLOAT, named_value_float_payload(reading_name, meter.reading(cpm), boot_ms)))
        for message_id, payload in said:
            raw = writer.frame(message_id, payload)
            yield Record(time_us, raw, reader.feed(raw)[0])

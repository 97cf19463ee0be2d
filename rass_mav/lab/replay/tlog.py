"""Reading telemetry logs (.tlog), damaged ones too; and bGeigie logs as the frames an autopilot would have sent.

A record is 8 bytes, big-endian microseconds since 1970, then one MAVLink frame. Three things prove a record: a
plausible time, a complete frame, and its checksum. Unproved records are rejected and counted: one for each record as
far as records can be distinguished, else one for each damaged stretch. After a damaged stretch the reader looks for the
next proved record.

A message that the common dialect does not know has an unknown CRC_EXTRA. It is accepted if it is where a record is
expected and some CRC_EXTRA makes its checksum good. A damaged frame passes that test once in 256 times, and nodes
ignore the message anyway.

Nothing in a record shows that its time is damaged. A record more than `NEAR_S` away from the one before waits for the
next, and is rejected unless that one agrees with it: it is near (the clock was set, or nothing was recorded for a
while), or the three are in order and little was recorded, with a record at least every `SILENCE_S`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import BinaryIO, NamedTuple

from rass_mav.lab.swarm.autopilot import autopilot_heartbeat, global_position_int_payload
from rass_mav.mavlink.crc import crc16
from rass_mav.mavlink.dialect import FORMATS, payload_of
from rass_mav.mavlink.frames import MAGIC_V2, MAX_FRAME, Frame, FrameReader, FrameWriter
from rass_mav.mavlink.messages import GLOBAL_POSITION_INT, HEARTBEAT, NAMED_VALUE_FLOAT, named_value_float_payload
from rass_mav.sensor.bgeigie_log import BgeigieLog
from rass_mav.sensor.dose import DoseMeter

#: A time further than this from the one before needs a second record that agrees, seconds.
NEAR_S = 5.0
#: The longest silence between records in order that agree, seconds.
SILENCE_S = 60.0

_STAMP = 8
_MAGIC = re.compile(rb"[\xfd\xfe]")
# Times end in the year 2112; garbage rarely looks like an earlier one.
_MAX_US = 1 << 52
_NEAR_US = int(NEAR_S * 1e6)
_SILENCE_US = int(SILENCE_S * 1e6)
# Enough to judge a record and the head of the next one.
_LOOKAHEAD = 2 * (_STAMP + MAX_FRAME)
_CHUNK = 1 << 16
_SIGNED = 1


class Record(NamedTuple):
    """One record of a log."""

    time_us: int
    """Microseconds since 1970, as recorded."""
    raw: bytes
    """The frame's bytes as recorded."""
    frame: Frame | None
    """The frame; None if the dialect does not know its message."""


def _agree(before: int | None, doubtful: int, after: int) -> bool:
    """Whether the next record's time confirms a doubtful one. All in microseconds."""
    if abs(after - doubtful) <= _NEAR_US:
        return True
    since = 0 if before is None else doubtful - before
    return 0 <= since <= _SILENCE_US and 0 <= after - doubtful <= _SILENCE_US


class TlogReader:
    """Iterate over it once to get the records of a log. Never raises because of the file's content.

    At most one chunk of the file is in memory, and the work is linear in its size.
    """

    def __init__(self, file: BinaryIO) -> None:
        """`file`: open for reading, in binary; the caller closes it."""
        self._file = file
        self._buffer = b""
        self._at = 0
        """Where in the buffer the next record is expected."""
        self._ended = False
        self._extras: dict[int, int] = {}
        self.read = 0
        """Records, and damaged stretches, seen so far."""
        self.rejected = 0
        """Of these, how many were not used."""

    def __iter__(self) -> Iterator[Record]:
        """The records in the order of the file. Their times may go backwards."""
        last: int | None = None
        doubtful: Record | None = None
        for record in self._intact():
            self.read += 1
            if doubtful is not None:
                if _agree(last, doubtful.time_us, record.time_us):
                    last = doubtful.time_us
                    yield doubtful
                else:
                    self.rejected += 1
                doubtful = None
            if last is None or abs(record.time_us - last) > _NEAR_US:
                doubtful = record
                continue
            last = record.time_us
            yield record
        if doubtful is not None:
            if last is None:
                yield doubtful
            else:
                self.rejected += 1

    def _intact(self) -> Iterator[Record]:
        while self._fill():
            size = self._size()
            record = self._record(size) if size else None
            if record is not None:
                self._at += size
                yield record
                continue
            self.read += 1
            self.rejected += 1
            left = len(self._buffer) - self._at
            # If the framing fits, the damage is inside this one record. Or it is in the length, which happens to end
            # where another record does: then there are proved ones before.
            if size and (size == left or (size < left and self._size(size))):
                self._at += self._first_inside(size)
            else:
                self._search()

    def _fill(self) -> bool:
        """Read until a record and the head of the next are in the buffer. False: nothing is left."""
        while not self._ended and len(self._buffer) - self._at < _LOOKAHEAD:
            chunk = self._file.read(_CHUNK)
            self._ended = not chunk
            self._buffer = self._buffer[self._at :] + chunk
            self._at = 0
        return self._at < len(self._buffer)

    def _size(self, offset: int = 0) -> int:
        """Bytes of the record that seems to begin here; 0 if none does, or its head is cut off."""
        start = self._at + offset
        head = self._buffer[start : start + _STAMP + 3]
        if len(head) < _STAMP + 3 or int.from_bytes(head[:_STAMP], "big") >= _MAX_US:
            return 0
        magic, length, flags = head[_STAMP:]
        if magic == MAGIC_V2:
            return 0 if flags & ~_SIGNED else _STAMP + 12 + length + 13 * flags
        return _STAMP + 8 + length if magic == MAGIC_V2 + 1 else 0

    def _record(self, size: int, offset: int = 0, *, known_only: bool = False) -> Record | None:
        """The record of that size, if it is proved."""
        start = self._at + offset
        raw = self._buffer[start + _STAMP : start + size]
        if len(raw) < size - _STAMP:
            return None
        reader = FrameReader()
        frames = reader.datagram(raw)
        frame = frames[0] if frames and not (reader.garbage_bytes or reader.unknown) else None
        if frame is None and (known_only or not self._strange(raw)):
            return None
        return Record(int.from_bytes(self._buffer[start : start + _STAMP], "big"), raw, frame)

    def _strange(self, raw: bytes) -> bool:
        """Whether a frame is intact, as far as can be determined without knowing its message."""
        if raw[0] == MAGIC_V2:
            end, message_id = 10 + raw[1], int.from_bytes(raw[7:10], "little")
        else:
            end, message_id = 6 + raw[1], raw[5]
        if message_id in FORMATS:
            return False
        checksum = int.from_bytes(raw[end : end + 2], "little")
        learned = self._extras.get(message_id)
        if learned is not None and crc16(raw[1:end] + bytes((learned,))) == checksum:
            return True
        for extra in range(256):
            if crc16(raw[1:end] + bytes((extra,))) == checksum:
                self._extras[message_id] = extra
                return True
        return False

    def _first_inside(self, size: int) -> int:
        """Where in the next `size` bytes, but not at their beginning, a record is proved; `size` if nowhere."""
        first = self._at + 1 + _STAMP
        for found in _MAGIC.finditer(self._buffer, first, self._at + size + _STAMP):
            offset = found.start() - _STAMP - self._at
            inner = self._size(offset)
            if inner and self._record(inner, offset, known_only=True) is not None:
                return offset
        return size

    def _search(self) -> None:
        """Go to the next proved record, or to the end."""
        self._at += 1
        while self._fill():
            found = _MAGIC.search(self._buffer, self._at + _STAMP)
            if found is None:
                # The last bytes may be the time of a record whose magic byte has not been read yet.
                self._at = len(self._buffer) if self._ended else max(self._at, len(self._buffer) - _STAMP)
                continue
            self._at = found.start() - _STAMP
            self._fill()
            size = self._size()
            if size and self._record(size, known_only=True) is not None:
                return
            self._at += 1


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

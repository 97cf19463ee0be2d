"""GQ GMC Geiger counters: questions and binary answers of fixed length.

GMC-280, 300 and 320 answer `<GETCPM>>` with 2 bytes (GQ-RFC1201), GMC-500, 600 and 800 with 4 bytes (GQ-RFC1801), most
significant byte first. Nothing marks where an answer begins, and 4 bytes read as 2 are a rate of 0. So the counter is
first asked who it is, and an answer is believed only if nothing follows it and its length is the one expected.
"""

from __future__ import annotations

import re

from rass_mav.errors import MalformedError

from .protocol import Protocol, Sample, shown

#: Seconds between two questions.
POLL_S = 1.0
#: After so much silence an answer is whole, seconds: many times what its bytes take at the slowest rate.
QUIET_S = 0.2
#: The longest answer that is kept, bytes; a version has 14 or a little more.
MAX_ANSWER = 64

#: A counter in heartbeat mode speaks unasked; it is told to stop.
_QUIET_PLEASE = b"<HEARTBEAT0>>"
_WHO = b"<GETVER>>"
_HOW_MUCH = b"<GETCPM>>"
_VERSION = re.compile(rb"GMC-(\d)\d\d")
_BYTES = {b"2": 2, b"3": 2, b"5": 4, b"6": 4, b"8": 4}


def decode_version(answer: bytes) -> int:
    """How many bytes this counter's CPM has, 2 or 4, by its answer to `<GETVER>>`. Raises `MalformedError`."""
    found = _VERSION.search(answer)
    if found is None or found[1] not in _BYTES:
        raise MalformedError(f"expected the version of a GMC-2xx, 3xx, 5xx, 6xx or 8xx, got {shown(answer)}")
    return _BYTES[found[1]]


def decode_cpm(answer: bytes, size: int) -> float:
    """Counts per minute by an answer to `<GETCPM>>`. Raises `MalformedError` for another length than `size`."""
    if len(answer) != size:
        raise MalformedError(f"expected {size} bytes, got {len(answer)}: {shown(answer)}")
    return float(int.from_bytes(answer, "big"))


class Gmc(Protocol):
    """Asks once a second."""

    def __init__(self) -> None:
        super().__init__()
        self.reset()

    def reset(self) -> None:
        """A new connection: whoever is there now is asked who it is."""
        self._size: int | None = None
        self._answer = b""
        self._last = 0.0
        self._asked: float | None = None
        self._greeted = False

    def ask(self, now: float) -> bytes:
        """The next question, when its time has come."""
        if self._asked is not None and now - self._asked < POLL_S:
            return b""
        # What is still incomplete now belongs to an older question: it must not be taken for the next one's answer.
        if self._answer:
            self._not_understood(MalformedError(f"an answer that does not end: {shown(self._answer)}"))
            self._answer = b""
        self._asked = now
        if self._size is not None:
            return _HOW_MUCH
        greeting = b"" if self._greeted else _QUIET_PLEASE
        self._greeted = True
        return greeting + _WHO

    def feed(self, data: bytes, now: float) -> list[Sample]:
        """Take in what has arrived; the answer comes out once there was silence behind it."""
        if data:
            self._answer = (self._answer + data)[: MAX_ANSWER + 1]
            self._last = now
            return []
        if not self._answer or now - self._last < QUIET_S:
            return []
        answer, self._answer = self._answer, b""
        try:
            if self._size is None:
                self._size = decode_version(answer)
                self._asked = None
                self._understood()
                return []
            cpm = decode_cpm(answer, self._size)
        except MalformedError as error:
            self._not_understood(error)
            return []
        self._understood()
        return [Sample(cpm, self._last)]

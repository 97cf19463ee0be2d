"""GQ GMC Geiger counters: questions and binary answers of fixed length.

GMC-280, 300 and 320 answer `<GETCPM>>` with 2 bytes (GQ-RFC1201), GMC-500, 600 and 800 with 4 bytes (GQ-RFC1801), most
significant byte first. Nothing marks the start of an answer, and 4 bytes read as 2 would be a rate of 0. So the counter
is first asked for its model. An answer is accepted only if it has the expected length and nothing follows it.
"""

from __future__ import annotations

import re

from rass_mav.errors import MalformedError

from .protocol import Protocol, Sample, shown

#: Seconds between two questions.
POLL_S = 1.0
#: After this much silence an answer is complete, seconds: many times longer than its bytes take at the slowest rate.
QUIET_S = 0.2
#: The longest answer that is kept, bytes. A version has 14 or slightly more.
MAX_ANSWER = 64

#: A counter in heartbeat mode sends without being asked. This stops it.
_QUIET_PLEASE = b"<HEARTBEAT0>>"
_WHO = b"<GETVER>>"
_HOW_MUCH = b"<GETCPM>>"
_VERSION = re.compile(rb"GMC-(\d)\d\d")
_BYTES = {b"2": 2, b"3": 2, b"5": 4, b"6": 4, b"8": 4}


def decode_version(answer: bytes) -> int:
    """The size of this counter's CPM in bytes, 2 or 4, from its answer to `<GETVER>>`. Raises `MalformedError`."""
    found = _VERSION.search(answer)
    if found is None or found[1] not in _BYTES:
        raise MalformedError(f"expected the version of a GMC-2xx, 3xx, 5xx, 6xx or 8xx, got {shown(answer)}")
    return _BYTES[found[1]]


def decode_cpm(answer: bytes, size: int) -> float:
    """Counts per minute from an answer to `<GETCPM>>`. Raises `MalformedError` if its length is not `size`."""
    if len(answer) != size:
        raise MalformedError(f"expected {size} bytes, got {len(answer)}: {shown(answer)}")
    return float(int.from_bytes(answer, "big"))


class Gmc(Protocol):
    """Asks once a second."""

    def __init__(self) -> None:
        super().__init__()
        self.reset()

    def reset(self) -> None:
        """A new connection: ask the device for its model again."""
        self._size: int | None = None
        self._answer = b""
        self._last = 0.0
        self._asked: float | None = None
        self._greeted = False

    def ask(self, now: float) -> bytes:
        """The next question, if it is due."""
        if self._asked is not None and now - self._asked < POLL_S:
            return b""
        # What has no end by now belongs to an earlier question. It must not be taken for the answer to the next one.
        if self._answer:
            self._not_understood(MalformedError(f"an answer without an end: {shown(self._answer)}"))
            self._answer = b""
        self._asked = now
        if self._size is not None:
            return _HOW_MUCH
        greeting = b"" if self._greeted else _QUIET_PLEASE
        self._greeted = True
        return greeting + _WHO

    def feed(self, data: bytes, now: float) -> list[Sample]:
        """Take the bytes that have arrived. An answer is returned after the silence that follows it."""
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

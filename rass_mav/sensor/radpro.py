"""Counters with the Rad Pro firmware: questions and answers in lines, 115200 baud 8N1.

https://github.com/Gissio/radpro/blob/main/docs/comm.md. An answer is `OK value` or `ERROR`, and does not name its
question. So only one question is open at a time. If its answer is late, nothing is asked for a while, and answers that
come in that time are dropped.
"""

from __future__ import annotations

import re

from rass_mav.errors import MalformedError

from .protocol import LineProtocol, Lines, Sample, shown

#: Seconds between two questions. The counter computes its rate once a second.
POLL_S = 1.0

_SENSITIVITY = b"GET tubeSensitivity\r\n"
_RATE = b"GET tubeRate\r\n"
_VALUE = re.compile(rb"OK (\d{1,12}(?:\.\d{1,9})?)")


def decode_answer(line: bytes) -> float | None:
    """The value, at least 0; None: the device answered ERROR. Raises `MalformedError`."""
    if line == b"ERROR":
        return None
    found = _VALUE.fullmatch(line)
    if found is None:
        raise MalformedError(f"expected 'OK value' or 'ERROR', got {shown(line)}")
    return float(found[1])


class RadPro(LineProtocol):
    """Asks for the tube's sensitivity first, then for its rate once a second."""

    def __init__(self) -> None:
        super().__init__()
        self.reset()

    def reset(self) -> None:
        """A new connection: perhaps another device."""
        super().reset()
        self._open: bytes | None = None
        """The unanswered question."""
        self._due: float | None = None
        self._sensitivity: float | None = None
        self._next = _SENSITIVITY

    def ask(self, now: float) -> bytes:
        """The next question, if it is due."""
        if self._due is not None and now < self._due:
            return b""
        self._due = now + POLL_S
        if self._open is not None:
            self._open = None
            self._lines = Lines()
            return b""
        self._open = self._next
        return self._open

    def _line(self, line: bytes, now: float) -> Sample | None:
        asked, self._open = self._open, None
        if asked is None:
            raise MalformedError(f"an unsolicited answer: {shown(line)}")
        value = decode_answer(line)
        if asked is _SENSITIVITY:
            # Firmware that does not know the question answers ERROR. Then the configured tube is used.
            self._sensitivity = value or None
            self._next = _RATE
            self._due = None
            return None
        if value is None:
            raise MalformedError("the counter answered ERROR when asked for the rate")
        return Sample(value, now, self._sensitivity)

"""What all device protocols have in common. They are pure: bytes and times in, samples and questions out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

from rass_mav.errors import MalformedError

#: The longest line of text that a device may send, bytes.
MAX_LINE = 256


class Sample(NamedTuple):
    """A rate as a device told it."""

    cpm: float
    """Counts per minute, finite, at least 0; not corrected for dead time by us."""
    at: float
    """When it arrived, seconds on the caller's timeline."""
    cpm_per_usvh: float | None = None
    """The device's own sensitivity, counts per minute in 1 uSv/h; None: it does not tell."""


class Protocol(ABC):
    """One device's language, for one connection after the other."""

    def __init__(self) -> None:
        self.heard = 0
        """Lines or answers that made sense. A device that is heard lives, even while it has no valid rate to tell."""
        self.malformed = 0
        """Lines or answers that did not."""
        self.trouble = ""
        """Why the last one did not; empty after one that did."""

    @abstractmethod
    def reset(self) -> None:
        """A new connection: forget what was half said."""

    def ask(self, now: float) -> bytes:
        """What is to be sent to the device at `now`. Call it a few times a second; most of the time it is nothing."""
        return b""

    @abstractmethod
    def feed(self, data: bytes, now: float) -> list[Sample]:
        """Take in what has arrived, perhaps nothing. Never raises for what a device says."""

    def _understood(self) -> None:
        self.heard += 1
        self.trouble = ""

    def _not_understood(self, error: MalformedError) -> None:
        self.malformed += 1
        self.trouble = str(error)


class Lines:
    """Cuts a stream into lines, however its bytes arrive. Holds at most `MAX_LINE` bytes."""

    def __init__(self) -> None:
        self.overlong = 0
        """Lines that were longer, and were left out."""
        self._rest = b""
        self._skipping = False

    def feed(self, data: bytes) -> list[bytes]:
        """The lines that have become whole, without their ends; empty ones are left out."""
        *whole, rest = (self._rest + data).split(b"\n")
        lines = []
        for line in whole:
            if self._skipping:
                self._skipping = False
            elif len(line) > MAX_LINE:
                self.overlong += 1
            elif line := line.strip():
                lines.append(line)
        if len(rest) > MAX_LINE and not self._skipping:
            self.overlong += 1
            self._skipping = True
        self._rest = b"" if self._skipping else rest
        return lines


class LineProtocol(Protocol):
    """A device that speaks in lines of text."""

    def __init__(self) -> None:
        super().__init__()
        self._lines = Lines()

    def reset(self) -> None:
        """A new connection: forget what was half said."""
        self._lines = Lines()

    def feed(self, data: bytes, now: float) -> list[Sample]:
        """Take in what has arrived, perhaps nothing. Never raises for what a device says."""
        samples = []
        lines = self._lines
        overlong = lines.overlong
        for line in lines.feed(data):
            try:
                sample = self._line(line, now)
            except MalformedError as error:
                self._not_understood(error)
                continue
            self._understood()
            if sample is not None:
                samples.append(sample)
        for _ in range(lines.overlong - overlong):
            self._not_understood(MalformedError(f"a line of more than {MAX_LINE} bytes"))
        return samples

    @abstractmethod
    def _line(self, line: bytes, now: float) -> Sample | None:
        """What a line says; None: nothing about the rate. Raises `MalformedError`."""


def shown(data: bytes) -> str:
    """Bytes of a device as they stand in an error: short, and on one line."""
    return repr(data[:40])[1:] + ("..." if len(data) > 40 else "")

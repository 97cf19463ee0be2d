"""The base of all device protocols. They are pure: bytes and times in, samples and questions out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

from rass_mav.errors import MalformedError

#: The longest line of text that a device may send, bytes.
MAX_LINE = 256


class Sample(NamedTuple):
    """A rate as reported by a device."""

    cpm: float
    """Counts per minute, finite, at least 0; not yet corrected for dead time by us."""
    at: float
    """When it arrived, seconds on the caller's timeline."""
    cpm_per_usvh: float | None = None
    """The sensitivity that the device reports, counts per minute at 1 uSv/h; None: it reports none."""


class Protocol(ABC):
    """The protocol of one device, for one connection after another."""

    def __init__(self) -> None:
        self.heard = 0
        """Lines or answers that parsed. They show that the device works, even while it has no valid rate."""
        self.malformed = 0
        """Lines or answers that did not parse."""
        self.trouble = ""
        """Why the last one did not parse; empty if it did."""

    @abstractmethod
    def reset(self) -> None:
        """A new connection: forget incomplete input."""

    def ask(self, now: float) -> bytes:
        """The bytes to send to the device at `now`, usually none. Call it a few times a second."""
        return b""

    @abstractmethod
    def feed(self, data: bytes, now: float) -> list[Sample]:
        """Take the bytes that have arrived, perhaps none. Never raises because of what a device sends."""

    def _understood(self) -> None:
        self.heard += 1
        self.trouble = ""

    def _not_understood(self, error: MalformedError) -> None:
        self.malformed += 1
        self.trouble = str(error)


class Lines:
    """Splits a stream into lines, however its bytes arrive. Holds at most `MAX_LINE` bytes."""

    def __init__(self) -> None:
        self.overlong = 0
        """Longer lines, which were dropped."""
        self._rest = b""
        self._skipping = False

    def feed(self, data: bytes) -> list[bytes]:
        """The lines that are now complete, without their line ends; empty ones are left out."""
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
    """A device that sends lines of text."""

    def __init__(self) -> None:
        super().__init__()
        self._lines = Lines()

    def reset(self) -> None:
        """A new connection: forget incomplete input."""
        self._lines = Lines()

    def feed(self, data: bytes, now: float) -> list[Sample]:
        """Take the bytes that have arrived, perhaps none. Never raises because of what a device sends."""
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
        """The sample in a line; None: the line contains no rate. Raises `MalformedError`."""


def shown(data: bytes) -> str:
    """A device's bytes for an error message: short, and on one line."""
    return repr(data[:40])[1:] + ("..." if len(data) > 40 else "")

"""The MightyOhm Geiger counter: a line a second, 9600 baud 8N1 (https://mightyohm.com/blog/products/geiger-counter/).

`CPS, 0, CPM, 13, uSv/hr, 0.07, SLOW`. CPM is that of the last minute (SLOW), of the last five seconds when there are
many counts (FAST), or 60 times CPS when there are very many (INST). The dose rate assumes the tube that the counter was
sold with, so it is not used.
"""

from __future__ import annotations

import re

from rass_mav.errors import MalformedError

from .protocol import LineProtocol, Sample, shown

_LINE = re.compile(rb"CPS, ?\d{1,9}, ?CPM, ?(\d{1,9}), ?uSv/hr, ?\d{1,9}(?:\.\d{1,9})?, ?(?:SLOW|FAST|INST)")


def decode_line(line: bytes) -> float:
    """Counts per minute from a line without its line end. Raises `MalformedError`."""
    found = _LINE.fullmatch(line)
    if found is None:
        raise MalformedError(f"expected 'CPS, n, CPM, n, uSv/hr, x, MODE', got {shown(line)}")
    return float(found[1])


class MightyOhm(LineProtocol):
    """Listens only: the counter sends without being asked."""

    def _line(self, line: bytes, now: float) -> Sample:
        return Sample(decode_line(line), now)

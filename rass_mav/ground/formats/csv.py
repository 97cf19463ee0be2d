"""Comma-separated values (RFC 4180), a line for each datum: for spreadsheets and scripts."""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from unicodedata import category, normalize

from rass_mav.ground.entry import Data, Entry, iso, shown_reading

from . import Exported, Format

COLUMNS = (
    "id", "drone", "kind", "created_utc", "time_error_s", "at_least_so_old", "latitude", "longitude", "altitude_m",
    "position_error_m", "north_m", "east_m", "down_m", "reading", "unit", "risk", "hops", "bytes", "file",
)  # fmt: skip
# With the ends of cells; and what begins a formula, also a minus sign that is no hyphen.
_CELLS = re.compile(r"([;\t\r\n])")
_SIGNS = frozenset("=+-@\u2212")


def write(entries: Iterable[Entry], out: Path, source: Data) -> Exported:
    """Numbers as JSON writes them, dates as ISO 8601 in UTC, nothing for what is unknown."""
    count = 0
    # With a byte order mark Excel reads names in UTF-8; Python's csv and LibreOffice skip it.
    with out.open("x", encoding="utf-8-sig", newline="") as file:
        table = csv.writer(file)
        table.writerow(COLUMNS)
        for entry in entries:
            table.writerow([*row(entry)[:-1], _harmless(entry.file)])
            count += 1
    return Exported(count, Counter(), [out])


def row(entry: Entry) -> list[object]:
    """The values of `COLUMNS`; None: unknown."""
    m = entry.measurement
    file = entry.manifest
    where = (None,) * 3 if file is None or file.place is None else file.place
    measured: tuple[object, ...] = (*where, *(None,) * 7) if m is None else (
        m.latitude, m.longitude, m.altitude, m.error_m, *(m.local or (None,) * 3), shown_reading(m.reading), m.unit,
        m.risk,
    )  # fmt: skip
    return [
        entry.name, entry.id.origin, entry.kind_name, iso(entry.utc), entry.error_s, int(entry.at_least), *measured,
        entry.hops, entry.size, entry.file,
    ]  # fmt: skip


def _harmless(text: str | None) -> str | None:
    """A spreadsheet takes what begins like a formula for one, so a drone could have it run something. Some cut at
    semicolons, tabs and line ends, even where there are quotes."""
    return text and "".join(f"'{cell}" if _is_formula(cell) else cell for cell in _CELLS.split(text))


def _is_formula(cell: str) -> bool:
    """Whether its first character that a spreadsheet sees may begin one, in any width."""
    for character in normalize("NFKC", cell):
        if character in _SIGNS:
            return True
        if character != '"' and category(character)[0] not in "CZ":
            break
    return False


FORMAT = Format(".csv", "all data", write)

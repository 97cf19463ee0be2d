"""bGeigie logs (.LOG) as Safecast takes them: a file for each drone and UTC day, such as `drone-7-2026-11-22.LOG`.

The fields of a sentence, and what those hold that a drone does not know (rass_mav/sensor/bgeigie.py describes all):

- device: the drone's id; time: when the measurement was created, UTC, without fractions of a second
- counts in the last minute: the reading in cpm; both flags: A
- counts in the last 5 s: a twelfth of that; counts in total: those of the last minute. Safecast recognises a line that
  it has already, so a line depends on nothing but its datum: a longer log of the same day can be uploaded again
- dilution of precision and satellites: 0
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from functools import reduce
from itertools import groupby
from operator import itemgetter, xor
from pathlib import Path

from rass_mav.ground.entry import Data, Entry, iso
from rass_mav.ground.sorting import sorting
from rass_mav.sensor.dose import TUBES

from . import Exported, Format
from .geojson import point_of

#: Counts per minute in one of each unit.
_CPM = {"cpm": 1.0, "cps": 60.0, "usvh": TUBES["safecast"].cpm_per_usvh}
#: The most that a date may be wrong by, seconds.
MOST_ERROR_S = 60.0
#: What the fields of a sentence have room for: counts, metres, and a year of four digits, seconds since 1970.
_MOST_CPM, _MOST_M, _LAST_S = 999_999_999, 999_999.0, 253_402_300_799.0
_HEAD = "# NEW LOG\r\n# format=1.3.5nano\r\n# deadtime=on\r\n"


def write(entries: Iterable[Entry], out: Path, source: Data) -> Exported:
    """Log files into the folder `out`, in order of time.

    Data come in order of arrival, so their lines wait in a sorter. One log is open at a time.
    """
    out.mkdir()
    count, left_out = 0, Counter[str]()
    files = []
    with sorting(out) as sorter:
        for entry in entries:
            try:
                body = _body(entry)
            except _LeftOutError as reason:
                left_out[str(reason)] += 1
                continue
            time = _time(entry)
            sorter.add(entry.id.origin, time[:10], time, body)
            count += 1
        for (drone, day), lines in groupby(sorter.sorted(), itemgetter(0, 1)):
            file = out / f"drone-{drone}-{day}.LOG"
            _write_log(file, (text for *_, text in lines))
            files.append(file)
    return Exported(count, left_out, files)


def _write_log(file: Path, bodies: Iterator[str]) -> None:
    with file.open("x", encoding="ascii", newline="") as log:
        log.write(_HEAD)
        for body in bodies:
            log.write(f"${body}*{reduce(xor, body.encode('ascii')):02X}\r\n")


class _LeftOutError(Exception):
    """No such log can hold a datum, and why."""


def _body(entry: Entry) -> str:
    """What is between $ and star. Raises `_LeftOutError`."""
    cpm, point = _counts(entry), point_of(entry)
    if point is None:
        raise _LeftOutError("no position")
    if abs(point[2]) > _MOST_M:
        raise _LeftOutError("altitude too high")
    if entry.error_s is None or entry.at_least or entry.error_s > MOST_ERROR_S or not 0.0 <= entry.utc <= _LAST_S:
        raise _LeftOutError(f"time not known to {MOST_ERROR_S:g} s")
    longitude, latitude, altitude = point
    return (
        f"BNRDD,{entry.id.origin},{_time(entry)},{cpm},{round(cpm / 12)},{cpm},A,"
        f"{_degrees(latitude, 2)},{'S' if latitude < 0.0 else 'N'},"
        f"{_degrees(longitude, 3)},{'W' if longitude < 0.0 else 'E'},{altitude:.2f},A,0,0"
    )


def _time(entry: Entry) -> str:
    return iso(entry.utc)[:19] + "Z"


def _counts(entry: Entry) -> int:
    """The reading in counts per minute. Raises `_LeftOutError`."""
    m = entry.measurement
    if m is None:
        raise _LeftOutError("no measurement")
    if m.reading is None:
        raise _LeftOutError("no reading")
    if m.unit not in _CPM:
        raise _LeftOutError(f"unit {m.unit or 'unknown'}")
    cpm = m.reading * _CPM[m.unit]
    if not 0.0 <= cpm <= _MOST_CPM:
        raise _LeftOutError("reading below 0 or too high")
    return round(cpm)


def _degrees(degrees: float, digits: int) -> str:
    """Degrees and minutes, `dddmm.mmmm`, without the sign; the degrees with so many digits."""
    # In whole numbers, because minutes that are rounded on their own may become 60.
    whole, minutes = divmod(round(abs(degrees) * 600_000), 600_000)
    return f"{whole:0{digits}d}{minutes // 10_000:02d}.{minutes % 10_000:04d}"


FORMAT = Format(
    "", "measurements in cpm, cps or uSv/h with a position on Earth and a time known to 60 s, for Safecast", write
)

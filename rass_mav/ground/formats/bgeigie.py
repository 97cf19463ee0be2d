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

from rass_mav.ground.demands import LeftOutError, date_of, place_of, reading_of
from rass_mav.ground.entry import Data, Entry, iso
from rass_mav.ground.sorting import sorting
from rass_mav.sensor.dose import TUBES

from . import Exported, Format

#: Counts per minute in one of each unit.
_CPM = {"cpm": 1.0, "cps": 60.0, "usvh": TUBES["safecast"].cpm_per_usvh}
#: What the fields of a sentence have room for: counts, metres.
_MOST_CPM, _MOST_M = 999_999_999, 999_999.0
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
            except LeftOutError as reason:
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


def _body(entry: Entry) -> str:
    """What is between $ and star. Raises `LeftOutError`."""
    cpm = _counts(entry)
    latitude, longitude = place_of(entry)
    altitude = entry.altitude or 0.0
    if abs(altitude) > _MOST_M:
        raise LeftOutError("altitude too high")
    date_of(entry)
    return (
        f"BNRDD,{entry.id.origin},{_time(entry)},{cpm},{round(cpm / 12)},{cpm},A,"
        f"{_degrees(latitude, 2)},{'S' if latitude < 0.0 else 'N'},"
        f"{_degrees(longitude, 3)},{'W' if longitude < 0.0 else 'E'},{altitude:.2f},A,0,0"
    )


def _time(entry: Entry) -> str:
    return iso(entry.utc)[:19] + "Z"


def _counts(entry: Entry) -> int:
    """The reading in counts per minute. Raises `LeftOutError`."""
    reading, unit = reading_of(entry)
    if unit not in _CPM:
        raise LeftOutError(f"unit {unit}")
    cpm = reading * _CPM[unit]
    if not 0.0 <= cpm <= _MOST_CPM:
        raise LeftOutError("reading below 0 or too high")
    return round(cpm)


def _degrees(degrees: float, digits: int) -> str:
    """Degrees and minutes, `dddmm.mmmm`, without the sign; the degrees with so many digits."""
    # In whole numbers, because minutes that are rounded on their own may become 60.
    whole, minutes = divmod(round(abs(degrees) * 600_000), 600_000)
    return f"{whole:0{digits}d}{minutes // 10_000:02d}.{minutes % 10_000:04d}"


FORMAT = Format(
    "", "measurements in cpm, cps or uSv/h with a position on Earth and a time known to 60 s, for Safecast", write
)

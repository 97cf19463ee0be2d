"""The tables in docs/how-to/capacity.md say how long a store lasts: the program says the same."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

from rass_mav.app.config import NodeSection, RunConfig, RunDataSettings, RunStoreSettings
from rass_mav.app.endurance import Left, endurance
from rass_mav.app.files import USUAL_PART
from rass_mav.app.spool import MOST_WAITING
from rass_mav.store.quota import cost
from rass_mav.wire.file import PART_HEAD, cut_file

PAGE = Path(__file__).parents[2] / "docs/how-to/capacity.md"
_ROW = re.compile(r"^\| (\d+) s(?: \(default\))? \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \|$", re.M)
_ENDLESS = 1 << 60


def config(interval_steps: int) -> RunConfig:
    return RunConfig(node=NodeSection(id=7), data=RunDataSettings(interval_steps=interval_steps))


def hours(of: RunConfig, items: int, room: int = _ENDLESS) -> float:
    return endurance(of, Left(items, room)).seconds / 3600


def test_the_table_of_hours() -> None:
    rows = _ROW.findall(PAGE.read_text(encoding="utf-8"))
    assert len(rows) == 4
    for interval, alone, files, half, fifty, megabytes in rows:
        of = config(int(interval))
        items = of.store.most_items
        for told, found in (
            (alone, hours(of, items)),
            (files, hours(of, items - 100 * 32)),
            (half, hours(of, items // 2)),
            (fifty, hours(of, 50)),
            (megabytes, (86_400 / int(interval) * cost(23) + 1_440 * cost(97)) / 1e6),
        ):
            digits = len(told.partition(".")[2])
            assert abs(float(told) - found) <= 0.5 * 10**-digits + 1e-9, (interval, told, found)


_PICTURE = re.compile(r"^\| (\d+) (kB|MB) \| (\d+) \| ([\d,]+) \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \|$", re.M)


def test_the_table_of_pictures() -> None:
    """Parts are created while less than half of the store is in use (tests/app/test_put_files.py); other files wait."""
    rows = _PICTURE.findall(PAGE.read_text(encoding="utf-8"))
    assert len(rows) == 3
    of = config(10)
    for number, unit, parts, pictures, gigabytes, often, seldom in rows:
        size = int(number) * {"kB": 1_000, "MB": 1_000_000}[unit]
        cut = cut_file(size, size, bytes(32), 0, USUAL_PART, None)
        in_store = of.store.most_items // 2 // (cut.data() + 1)
        found = in_store + MOST_WAITING
        taken = in_store * cut.data() * cost(PART_HEAD + cut.part_bytes) + MOST_WAITING * size
        assert (int(parts), int(pictures.replace(",", ""))) == (cut.data(), found)
        for told, figure in ((gigabytes, taken / 1e9), (often, found * 10 / 3600), (seldom, found * 60 / 3600)):
            assert abs(float(told) - figure) <= 0.051, (number, told, figure)


def test_the_tighter_bound_counts() -> None:
    of = config(10)
    assert hours(of, 1000) < hours(of, 2000)
    assert hours(of, 2000, 1000 * cost(23)) < hours(of, 1000)
    tight = replace(of, store=RunStoreSettings(capacity_bytes=100))
    assert hours(tight, 1000) < 0.02

"""Which data become readings of the estimate."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path

import pytest

from rass_mav.core.datum import DatumId, Kind
from rass_mav.ground.archive import Archive
from rass_mav.ground.entry import Entry
from rass_mav.ground.sources import readings
from rass_mav.ground.sources.readings import Samples
from rass_mav.wire.measurement import Measurement
from tests.ground.missions import HERE, Base

PLAIN = Measurement(47.0, 8.0, 510.0, 0.5, 0.1, unit="usvh", error_m=6.0)


def entry(measurement: Measurement | None, number: int = 0, *, apart: bool = False, utc: float = 1000.0) -> Entry:
    return Entry(
        number, DatumId(7, 1, number), 0, Kind.MEASUREMENT, 30, 1, utc, 0.0, False, 0.0, measurement, apart=apart
    )  # fmt: skip


def taken(*entries: Entry) -> Samples:
    samples = Samples()
    for one in entries:
        samples.take(one)
    return samples


def test_a_measurement_becomes_a_reading_with_half_of_its_bound_as_error() -> None:
    unit, (sample,) = taken(entry(PLAIN)).main
    assert unit == "usvh"
    assert sample == (7, 1000.0, 47.0, 8.0, 510.0, 0.5, 3.0)


@pytest.mark.parametrize(
    "useless",
    [
        entry(None), entry(PLAIN, apart=True), entry(PLAIN, utc=math.inf), entry(PLAIN._replace(reading=None)),
        entry(PLAIN._replace(reading=math.nan)), entry(PLAIN._replace(reading=math.inf)),
        entry(PLAIN._replace(latitude=None, longitude=None)), entry(PLAIN._replace(latitude=91.0)),
    ],
)  # fmt: skip
def test_what_is_no_reading_with_a_place_and_a_time_is_left_out(useless: Entry) -> None:
    assert taken(useless).main == ("", [])


def test_a_reading_below_nothing_is_nothing() -> None:
    assert taken(entry(PLAIN._replace(reading=-0.2))).main[1][0].value == 0.0


def test_units_are_apart_and_most_readings_decide() -> None:
    cpm = PLAIN._replace(unit="cpm")
    samples = taken(entry(PLAIN), entry(cpm, 1), entry(cpm, 2))
    assert (samples.main[0], len(samples.main[1]), len(samples.by_unit["usvh"])) == ("cpm", 2, 1)


def test_of_very_many_some_are_kept_of_the_whole_mission(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(readings, "MOST_READINGS", 100)
    samples = taken(*(entry(PLAIN, n, utc=float(n)) for n in range(10_000)))
    times = [sample.utc for sample in samples.main[1]]
    assert 50 <= len(times) <= 100
    assert times == sorted(times)
    gaps = {after - before for before, after in pairwise(times)}
    assert max(gaps) <= 2 * min(gaps)
    assert times[-1] > 9_800
    assert samples.changes == 10_000


def test_readings_come_from_a_store(tmp_path: Path) -> None:
    base = Base(tmp_path / "rass-1.db")
    base.arrive(base.measurement(7, 0, HERE), base.measurement(7, 3, HERE))
    base.close()
    with Archive(base.path) as archive:
        assert len(taken(*archive.entries()).main[1]) == 2

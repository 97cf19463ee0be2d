"""Hot spots: one definition for the report, the page and the list of what needs attention."""

from __future__ import annotations

import json
import math
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.core.datum import DatumId, Kind
from rass_mav.ground import hotspots
from rass_mav.ground.entry import Entry
from rass_mav.ground.hotspots import MOST_OF_DRONE, MOST_SPOTS, SPOT_M, HotSpots, report_lines
from tests.ground.missions import EPOCH, HERE
from tests.ground.page.flights import place
from tests.some import some

T0 = 1_795_341_600.0


def measured(number: int, drone: int = 7, at: float = 0.0, **fields: Any) -> Entry:
    """A measurement at a place; its risk is 1."""
    m = HERE._replace(**{"risk": 1.0, **fields})
    return Entry(number, DatumId(drone, EPOCH, number), 0, Kind.MEASUREMENT, 30, 1, T0 + at, 1.0, False, 0.0, m)


def here(number: int, north: float, east: float, reading: float, drone: int = 7, **fields: Any) -> Entry:
    latitude, longitude = place(north, east)
    return measured(number, drone, float(number), latitude=latitude, longitude=longitude, reading=reading, **fields)


def metres(one: tuple[float, float], other: tuple[float, float]) -> float:
    north = (one[0] - other[0]) * 111_320.0
    return math.hypot(north, (one[1] - other[1]) * 111_320.0 * math.cos(math.radians(one[0])))


def test_the_highest_first_each_where_it_was_highest() -> None:
    spots = HotSpots()
    assert spots.take(here(0, 0, 0, 50.0), 25.0) is not None, "new"
    assert spots.take(here(1, 40, 0, 80.0), 25.0) is None, "near another"
    assert spots.take(here(2, 300, 0, 200.0, drone=8), 25.0) is not None
    assert spots.take(here(3, 600, 0, 24.0), 25.0) is None, "not high"
    first, second = spots.highest()
    assert (first.reading, first.drone) == (200.0, 8)
    assert first.place == pytest.approx(place(300, 0))
    assert (second.reading, second.drone, second.utc) == (80.0, 7, T0 + 1)
    assert second.place == pytest.approx(place(40, 0)), "not where the first high reading was"


def test_without_a_threshold_it_is_the_highest_usual_level_or_the_drones_own_risk() -> None:
    spots = HotSpots()
    spots.take(here(0, 0, 0, 99.0, risk=0.9), None)
    spots.take(here(1, 300, 0, 3.0, risk=1.0), None)
    # Its risk may be scaled to doses that no mission sees: people are warned all the same.
    spots.take(here(2, 600, 0, 101.0, risk=0.3), None)
    spots.take(here(3, 900, 0, 5000.0, risk=0.9, unit="cpm"), None)
    assert [spot.reading for spot in spots.highest()] == [101.0, 3.0]


def test_other_units_are_other_spots_and_those_of_most_places_come_first() -> None:
    spots = HotSpots()
    spots.take(here(0, 0, 0, 9000.0, unit="cpm"), None)
    spots.take(here(1, 0, 0, 30.0), None)
    spots.take(here(2, 300, 0, 20.0), None)
    assert [(spot.reading, spot.unit) for spot in spots.highest()] == [(30.0, "usvh"), (20.0, "usvh"), (9000.0, "cpm")]


MEASURED = st.lists(
    st.tuples(st.floats(-900, 900), st.floats(-900, 900), st.floats(0, 3.4e38), st.integers(1, 4)), max_size=60
)


@given(MEASURED, st.randoms(use_true_random=False))
def test_they_are_apart_in_order_and_the_same_in_whatever_order_data_arrive(
    come: list[tuple[float, float, float, int]], random: Any
) -> None:
    entries = [here(number, *one[:3], drone=one[3]) for number, one in enumerate(come)]
    spots, others = HotSpots(), HotSpots()
    for entry in entries:
        spots.take(entry, 25.0)
    found = spots.highest()
    for number, one in enumerate(found):
        assert one.reading > 25.0
        for other in found[:number]:
            assert metres(one.place, other.place) >= SPOT_M * 0.999
    assert all(one.reading >= other.reading for one, other in pairwise(found))
    if len(found) < MOST_SPOTS and all(sum(one.drone == id for one in found) < MOST_OF_DRONE for id in range(5)):
        for entry in entries:
            if (entry.reading or 0.0) > 25.0:
                near = [spot for spot in found if metres(spot.place, some(entry.place)) < SPOT_M * 2.5]
                assert near, "each high reading is near one that is listed"
    # Equal readings keep the one that came first.
    if len({one.reading for one in entries}) == len(entries):
        for entry in random.sample(entries, len(entries)):
            others.take(entry, 25.0)
        assert others.highest() == found


def test_what_is_forged_is_left_out_or_stays_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hotspots, "MOST_CELLS", 30)
    spots = HotSpots()
    for number, reading in enumerate((math.inf, -math.inf, math.nan, 1e39, None)):
        spots.take(
            here(number, 300.0 * number, 0, 0.0)._replace(measurement=HERE._replace(reading=reading, risk=1.0)), 1.0
        )
    for latitude, longitude in ((math.nan, 8.0), (91.0, 0.0), (0.0, 181.0), (math.inf, math.inf)):
        spots.take(measured(9, latitude=latitude, longitude=longitude, reading=50.0), 1.0)
    assert spots.highest() == []
    for number in range(500):
        spots.take(measured(number, 66, latitude=-80.0 + number / 4, longitude=8.0, reading=3e38), 1.0)
    spots.take(measured(1, 7, latitude=47.0, longitude=-90.0, reading=50.0), 1.0)
    found = spots.highest()
    assert sum(spot.drone == 66 for spot in found) == MOST_OF_DRONE, "a forger does not fill the list"
    assert found[-1].drone == 7


def test_the_list_is_short_and_json() -> None:
    spots = HotSpots()
    for number in range(100):
        spots.take(here(number, 300.0 * number, 0, 50.0 + number, drone=number % 9), 1.0)
    found = [json.loads(json.dumps(spot.plain(), allow_nan=False)) for spot in spots.highest()]
    assert len(found) == MOST_SPOTS
    assert found[0]["reading"] == 149.0
    assert found[0]["utc"].endswith("Z")
    [head, first, *_] = report_lines(found)
    assert head == "hot spots: 20, the highest first"
    assert first.startswith(
        f"     1. {found[0]['place'][0]:.6f}, {found[0]['place'][1]:.6f}, 149 uSv/h, drone 0, 2026-"
    )
    assert report_lines([]) == []

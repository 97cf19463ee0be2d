"""Contacts: a neighbour that flies out of range is given no more data."""

from __future__ import annotations

from math import inf

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.core.messages import Data, Route
from rass_mav.core.routes.contacts import (
    HOVERS_M_S,
    STALE_S,
    UNIT_DEGREES,
    UNIT_M_S,
    WINDOW_S,
    Contacts,
    pack,
    unpack,
)
from rass_mav.mavlink.telemetry import Position

from .build import beacon, make_node

#: Metres in a degree of latitude.
DEGREE = 111_319.5


def motion(latitude: float, longitude: float, north: float, east: float, at: float) -> Position:
    return Position(latitude, longitude, 0.0, at, north, east)


def at(north_m: float, speed: float = 0.0, *, now: float = 0.0, latitude: float = 45.0) -> Position:
    """So many metres north of a place, flying north."""
    return motion(latitude + north_m / DEGREE, 7.0, speed, 0.0, now)


@given(st.floats(-90, 90), st.floats(-180, 180), st.floats(-40, 40), st.floats(-40, 40), st.floats(0, STALE_S))
def test_a_motion_survives_the_beacon(latitude: float, longitude: float, north: float, east: float, age: float) -> None:
    packed = pack(motion(latitude, longitude, north, east, 100.0 - age), 100.0)
    assert 0 < packed < 1 << 64
    units, _, its_north, its_east = unpack(packed)
    assert its_north == pytest.approx(north, abs=UNIT_M_S)
    assert its_east == pytest.approx(east, abs=UNIT_M_S)
    now_at = (latitude + north * age / DEGREE) / UNIT_DEGREES
    assert (units - now_at + 1.0) % (1 << 20) <= 2.0


def test_nothing_is_told_where_nothing_moves_or_nothing_is_known() -> None:
    contacts = Contacts()
    assert contacts.announced(0.0) == 0
    contacts.observe(at(0.0, HOVERS_M_S / 2))
    assert contacts.announced(0.0) == 0
    contacts.observe(at(0.0, 3.0))
    assert contacts.announced(0.0) != 0
    assert contacts.announced(STALE_S + 0.1) == 0


def test_who_hovers_near_one_that_moves_reports_its_place() -> None:
    contacts = Contacts()
    contacts.observe(at(0.0))
    contacts.leaves(pack(at(50.0), 0.0), 0.0)
    assert contacts.announced(0.0) == 0
    contacts.leaves(pack(at(50.0, 5.0), 0.0), 0.0)
    assert contacts.announced(1.0) != 0
    contacts.observe(at(0.0, now=9.0))
    assert contacts.announced(9.0) == 0


@pytest.mark.parametrize("latitude", [0.0, 45.0, -70.0])
def test_a_neighbour_leaves_when_it_passes_the_greatest_distance_at_which_any_was_heard(latitude: float) -> None:
    contacts = Contacts()
    contacts.observe(at(0.0, latitude=latitude))
    assert contacts.leaves(pack(at(-200.0, latitude=latitude), 0.0), 0.0) == inf
    assert contacts.range_m == pytest.approx(200.0, abs=0.1)
    # At 50 m, away with 10 m/s; then towards this node, past it, and away.
    assert contacts.leaves(pack(at(50.0, 10.0, latitude=latitude), 0.0), 0.0) == pytest.approx(15.0, abs=0.1)
    assert contacts.leaves(pack(at(50.0, -10.0, latitude=latitude), 0.0), 0.0) == pytest.approx(25.0, abs=0.1)
    # Side by side they never part.
    contacts.observe(at(0.0, 10.0, latitude=latitude))
    assert contacts.leaves(pack(at(50.0, 10.0, latitude=latitude), 0.0), 0.0) == inf
    # East and west count as much as north and south.
    east = motion(latitude, 7.0, 0.0, -10.0, 0.0)
    contacts.observe(motion(latitude, 7.0, 0.0, 10.0, 0.0))
    assert contacts.leaves(pack(east, 0.0), 0.0) == pytest.approx(10.0, abs=0.1)


def test_a_range_that_was_heard_long_ago_is_forgotten() -> None:
    contacts = Contacts()
    for moment, distance in ((0.0, 500.0), (WINDOW_S, 80.0), (2 * WINDOW_S, 70.0)):
        contacts.observe(at(0.0, now=moment))
        contacts.leaves(pack(at(distance, now=moment), moment), moment)
    assert contacts.range_m == pytest.approx(80.0, abs=0.1)


def test_places_on_both_sides_of_the_edge_of_a_beacons_grid_are_near_each_other() -> None:
    contacts = Contacts()
    edge = (1 << 20) * UNIT_DEGREES * 107
    contacts.observe(motion(edge - 30.0 / DEGREE, 179.99999, 0.0, 0.0, 0.0))
    contacts.leaves(pack(motion(edge + 30.0 / DEGREE, 179.99999, 5.0, 0.0, 0.0), 0.0), 0.0)
    assert contacts.range_m == pytest.approx(60.0, abs=0.2)


@pytest.mark.parametrize(("foresees", "to"), [(True, {3}), (False, {2, 3})])
def test_data_do_not_go_to_a_neighbour_that_has_flown_out_of_range(foresees: bool, to: set[int]) -> None:
    targets = set()
    for seed in range(12):
        node = make_node(1, contacts=foresees, seed=seed)
        contacts = node.routing.neighbours.contacts
        if contacts is not None:
            contacts.observe(at(0.0))
        # 2 has just left, though its last beacon is fresh.
        for id, north_m, speed in ((3, -100.0, 0.0), (2, 99.0, 20.0)):
            told = beacon(id, 1, Route(9, 9, 1, 1))
            node.receive(told._replace(moves=pack(at(north_m, speed), 0.0)), 0.0)
        node.put(b"reading", 0.5)
        targets |= {message.target for message in node.step(1.0) if isinstance(message, Data)}
    assert targets == to


def test_a_neighbour_that_has_left_is_still_better_than_none() -> None:
    node = make_node(1, contacts=True)
    assert node.routing.neighbours.contacts is not None
    node.routing.neighbours.contacts.observe(at(0.0))
    told = beacon(2, 1, Route(9, 9, 1, 1), potential=3)
    node.receive(told._replace(moves=pack(at(100.0, 20.0), 0.0)), 0.0)
    node.put(b"reading", 0.5)
    assert [m.target for m in node.step(1.0) if isinstance(m, Data)] == [2]

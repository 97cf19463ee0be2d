"""GPS of the mock swarm errs as it says."""

from __future__ import annotations

import random
from statistics import pstdev

import pytest

from rass_mav.lab.swarm.autopilot import to_arena
from rass_mav.lab.swarm.gps import LASTS_S, GpsErrors
from rass_mav.lab.swarm.scenario import load_scenario
from rass_mav.lab.swarm.world import World
from rass_mav.wire.measurement import decode_measurement


def test_errors_have_their_spread_and_last_about_a_minute() -> None:
    errors = GpsErrors(random.Random(1), 400, 3.0, 1.0)
    before = [errors.place(node, (10.0, 20.0)) for node in range(400)]
    assert pstdev(x for x, _ in before) == pytest.approx(3.0, rel=0.15)

    def alike() -> float:
        now = [errors.place(node, (10.0, 20.0)) for node in range(400)]
        return sum((a - 10.0) * (b - 10.0) for (a, _), (b, _) in zip(before, now, strict=True)) / 400 / 9.0

    errors.step()
    assert alike() > 0.8
    for _ in range(round(3 * LASTS_S)):
        errors.step()
    assert abs(alike()) < 0.25
    assert pstdev(errors.place(node, (10.0, 20.0))[1] for node in range(400)) == pytest.approx(3.0, rel=0.15)


def test_without_errors_places_are_true() -> None:
    assert GpsErrors(random.Random(1), 5, 0.0, 1.0).place(3, (1.0, 2.0)) == (1.0, 2.0)


def test_measurements_are_where_gps_says_and_say_how_wrong_that_may_be() -> None:
    world = World(load_scenario("field-sources", {"seed": 1, "steps": 5}))
    world.run(5)
    off = []
    for store in world.stores:
        for id in store.ids():
            datum = store.get(id)
            assert datum is not None
            measured = decode_measurement(datum.payload)
            assert measured.latitude is not None
            assert measured.longitude is not None
            assert measured.error_m is not None
            assert measured.error_m >= 6.0
            x, _ = to_arena(measured.latitude, measured.longitude)
            off.append(abs(x - world.positions[id.origin][0]))
    assert off
    # The drones have flown on since, at most at 10 m/s.
    assert max(off) < 50.0 + 5 * 3.0

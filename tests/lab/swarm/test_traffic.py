"""The load of a mock swarm: intervals that fit the air, and pictures beside measurements."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Any

import pytest

from rass_mav.config.loading import convert
from rass_mav.errors import ConfigError
from rass_mav.lab.medium.capacity import one_hop_bytes_s
from rass_mav.lab.swarm.invariants import check
from rass_mav.lab.swarm.scenario import Scenario
from rass_mav.lab.swarm.traffic import Load, Pictures, loaded
from rass_mav.lab.swarm.world import World
from tests.some import some

from .worlds import run


def scenario(**keys: Any) -> Scenario:
    return convert({"nodes": 11, "node": {"step_s": 2}, "radio": {"preset": "sik-250k"}, **keys}, Scenario, "test")


def capacity(scenario: Scenario, size: int) -> float:
    """Of a neighbourhood of six."""
    return one_hop_bytes_s(scenario.radio, size, nodes=6, step_s=scenario.node.step_s)


def created(scenario: Scenario, load: Load) -> float:
    """Bytes of payload that all drones create in a second."""
    drones, step_s = scenario.nodes - scenario.bases, scenario.node.step_s
    per_step = scenario.data.bytes / load.interval_steps if load.interval_steps else 0.0
    if load.picture_interval_steps:
        per_step += scenario.traffic.picture_bytes / load.picture_interval_steps
    return drones * per_step / step_s


def test_without_a_load_nothing_changes() -> None:
    plain = scenario()
    assert loaded(plain, 6) == (plain, None)
    assert "load" not in World(plain).statistics.summary()


@pytest.mark.parametrize("wanted", [0.01, 0.1, 0.5, 1.0])
def test_measurements_are_as_frequent_as_the_load_allows(wanted: float) -> None:
    asked = scenario(traffic={"load": wanted})
    made, load = loaded(asked, 6)
    assert load is not None
    assert made.data.interval_steps == load.interval_steps >= 1
    whole = capacity(asked, asked.data.bytes)
    assert load.capacity_bytes_s == round(whole)
    assert created(asked, load) / whole == pytest.approx(load.share, abs=1e-4)
    assert load.share <= wanted
    # One step less would be too often.
    faster = load._replace(interval_steps=load.interval_steps - 1)
    assert load.interval_steps == 1 or created(asked, faster) / whole > wanted


def test_pictures_fill_up_what_measurements_leave() -> None:
    asked = scenario(traffic={"load": 0.5, "picture_bytes": 5000}, data={"interval_steps": 20})
    made, load = loaded(asked, 6)
    assert load is not None
    measurements = 10 * 20 / 2 / 20 / capacity(asked, 20)
    pictures = 10 * 5000 / 2 / load.picture_interval_steps / capacity(asked, 5000)
    assert load.share == pytest.approx(measurements + pictures, abs=1e-4)
    assert load.share <= 0.5 < measurements + pictures * load.picture_interval_steps / (load.picture_interval_steps - 1)
    assert made.traffic.picture_interval_steps == load.picture_interval_steps
    assert load.created_bytes_s == round(created(asked, load))
    assert made.data == asked.data
    # Two bases have two neighbourhoods.
    _, several = loaded(replace(asked, bases=2, nodes=12), 6)
    assert some(several).picture_interval_steps == pytest.approx(load.picture_interval_steps / 2, abs=2)


def test_the_load_of_a_preset_fits_the_air_that_takes_no_time_too() -> None:
    asked = scenario(traffic={"load": 0.5})
    instant = scenario(traffic={"load": 0.5}, radio={"preset": "sik-250k", "air": "none"})
    assert loaded(instant, 6)[1] == loaded(asked, 6)[1]


def test_measurements_that_are_too_many_are_an_error() -> None:
    with pytest.raises(ConfigError, match=r"^data.interval_steps: the measurements alone are a load of \S+, expected"):
        World(scenario(traffic={"load": 0.1, "picture_bytes": 5000}, data={"interval_steps": 1}))


@pytest.mark.parametrize("interval", [1, 2, 10, 25])
def test_drones_take_pictures_in_turn(interval: int) -> None:
    pictures = Pictures(
        scenario(traffic={"picture_bytes": 100, "picture_interval_steps": interval}, data={"until_step": 50})
    )
    due = [pictures.due(t) for t in range(100)]
    assert Counter(drone for drones in due for drone in drones) == dict.fromkeys(range(1, 11), 50 // interval)
    assert max(len(drones) for drones in due) <= -(-10 // interval)
    assert not any(due[50:])
    assert not any(Pictures(scenario()).due(t) for t in range(5))


@pytest.mark.no_cover
def test_pictures_arrive_beside_measurements() -> None:
    world = World(
        scenario(
            nodes=5, topology="line", data={"interval_steps": 10, "until_step": 20},
            traffic={"picture_bytes": 20_000, "picture_interval_steps": 10}, radiation={"corruption": False},
            radio={},
        )
    )  # fmt: skip
    world.run(30, after=check)
    sizes = Counter(len(payload) for payload in world.ledger.payloads.values())
    assert sizes == {20: 8, 20_000: 8}
    assert len(world.ledger.arrived) == 16
    assert world.ledger.altered == 0


def test_a_full_store_refuses_pictures() -> None:
    world = World(
        scenario(
            nodes=2, topology="positions", mobility={"positions": [[0, 0], [100, 0]]}, data={"interval_steps": 0},
            store={"capacity_bytes": 50_000}, traffic={"picture_bytes": 20_000, "picture_interval_steps": 2},
            radiation={"corruption": False},
            radio={},
        )
    )  # fmt: skip
    world.run(10, after=check)
    summary = world.statistics.summary()
    assert (summary["created"], summary["held"], summary["lost"]["overflow"]) == (5, 2, 3)


@pytest.mark.parametrize(
    ("keys", "data", "needed"),
    [({}, 4, 4), ({"picture_bare": 0.5}, 4, 4), ({"picture_redundancy": [4, 6]}, 6, 4)],
)
def test_pictures_in_parts_are_whole_when_enough_of_them_has_arrived(
    keys: dict[str, Any], data: int, needed: int
) -> None:
    traffic = {"picture_bytes": 320, "picture_part_bytes": 80, "picture_interval_steps": 20, **keys}
    world = run(
        nodes=4, steps=60, topology="line", traffic=traffic, store={"capacity_items": 500},
        data={"interval_steps": 0, "until_step": 30}, radiation={"corruption": False},
    )  # fmt: skip
    pictures = some(world.statistics.pictures)
    (stripe,) = pictures.taken[0]
    assert (len(stripe.ids), stripe.needed) == (data, needed)
    found = world.statistics.summary()["pictures"]
    assert found == {"taken": len(pictures.taken), "whole": len(pictures.taken)}
    assert pictures.whole(set(stripe.ids[:needed])) == 1
    assert pictures.whole(set(stripe.ids[: needed - 1])) == 0

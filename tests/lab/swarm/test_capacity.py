"""The one-hop capacity of an air: against numbers worked out by hand, and against what a saturated swarm delivers."""

from __future__ import annotations

from random import Random
from typing import Any

import pytest

from rass_mav.config.loading import convert
from rass_mav.lab.medium.capacity import one_hop_bytes_s
from rass_mav.lab.medium.settings import PRESETS, RadioSection
from rass_mav.lab.swarm.scenario import Scenario
from rass_mav.lab.swarm.world import World


def capacity(size: int, nodes: int = 5, step_s: float = 1e9, **radio: Any) -> float:
    return one_hop_bytes_s(convert(radio, RadioSection, "test"), size, nodes=nodes, step_s=step_s)


def test_a_hand_over_takes_its_frames_and_the_waits_between_them() -> None:
    # A frame of Data with one datum of 97 bytes has 17 + 128 bytes, Committed has 17 + 15.
    radio: dict[str, Any] = {
        "air": "csma",
        "bitrate": 8000,
        "slot_s": 0.001,
        "gap_s": 0.002,
        "window": 10,
        "overhead_bytes": 3,
    }
    waits = 0.002 + 0.001 * 10 / 2
    assert capacity(97, **radio) == pytest.approx(97 / (0.148 + 0.035 + 2 * waits))
    # Two data of 20 bytes share a frame of 17 + 6 + 2 * 45 bytes, and their answer has 17 + 7 + 2 * 8.
    assert capacity(20, **radio) == pytest.approx(40 / (0.116 + 0.043 + 2 * waits))


def test_acknowledgements_take_their_part() -> None:
    radio: dict[str, Any] = {"air": "csma", "bitrate": 8000, "slot_s": 0.001, "gap_s": 0.005}
    # SIFS 3 ms, and 14 bytes, after each of the two frames.
    unicast_s = 97 / capacity(97, mac="unicast", **radio)
    assert unicast_s == pytest.approx(97 / capacity(97, **radio) + 2 * (0.003 + 0.014))


def test_large_data_need_an_offer_and_acknowledgements() -> None:
    radio: dict[str, Any] = {"air": "csma", "bitrate": 8000, "slot_s": 1e-6}
    chunks = 65536 / 123
    frames_s = (51 + 30 + 32) / 1000 + chunks * 0.145 + chunks / 8 * (17 + 11) / 1000
    assert capacity(65536, **radio) == pytest.approx(65536 / frames_s, rel=1e-3)


def test_beacons_take_their_part() -> None:
    # 10 beacons of 17 + 43 bytes take 0.6 of each second.
    radio: dict[str, Any] = {"air": "csma", "bitrate": 8000, "slot_s": 1e-9}
    assert capacity(97, 10, 1.0, **radio) == pytest.approx(0.4 * capacity(97, **radio), rel=1e-3)
    assert capacity(97, 100, 1.0, **radio) == 0.0


def test_the_slots_of_others_stay_empty() -> None:
    radio: dict[str, Any] = {"air": "tdma", "bitrate": 8000, "slot_s": 1.0, "gap_s": 0.5, "slots": 10}
    assert capacity(97, 5, **radio) == pytest.approx(0.5 * capacity(97, 10, **radio))
    assert capacity(97, 10, **radio) == pytest.approx(97 / (2 * 0.177))


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_has_a_capacity_with_or_without_its_air(preset: str) -> None:
    assert capacity(20, 7, 5.0, preset=preset) > 0
    assert capacity(20, 7, 5.0, preset=preset, air="none") == capacity(20, 7, 5.0, preset=preset)


@pytest.mark.no_cover
@pytest.mark.parametrize(("preset", "step_s"), [("lora", 10.0), ("sik-250k", 2.0)])
def test_saturated_neighbours_deliver_what_a_paced_radio_can_carry(preset: str, step_s: float) -> None:
    rng, nodes, steps = Random(1), 6, 60
    places = [[rng.uniform(-50, 50), rng.uniform(-50, 50)] for _ in range(nodes)]
    world = World(
        convert(
            {
                "nodes": nodes, "topology": "positions", "mobility": {"positions": places}, "node": {"step_s": step_s},
                "radio": {"preset": preset, "range_m": 300}, "radiation": {"sources": []},
                "data": {"interval_steps": 0}, "store": {"capacity_items": None, "bandwidth_items": 1000},
            },
            Scenario, "test",
        )
    )  # fmt: skip
    for agent in world.agents[1:]:
        for _ in range(1000):
            agent.node.put(bytes(20), 0.0)
    world.run(steps)
    # The first steps find the neighbours.
    delivered = sum(20 for step in world.ledger.arrived.values() if step >= steps // 3)
    measured = delivered / (steps - steps // 3) / step_s
    assert measured == pytest.approx(capacity(20, nodes, step_s, preset=preset), rel=0.1)

"""The scenarios of the field: what they promise, and short runs in which all invariants hold."""

from __future__ import annotations

import pytest

from rass_mav.lab.medium.neighbours import reachable
from rass_mav.lab.swarm.invariants import check
from rass_mav.lab.swarm.scenario import load_scenario, shipped
from rass_mav.lab.swarm.surroundings import Surroundings
from rass_mav.lab.swarm.world import World

#: Surveys; the search for sources is a small area without pictures.
FIELD = [name for name in shipped() if name.startswith("field-") and name != "field-sources"]


@pytest.mark.parametrize("name", FIELD)
def test_a_scenario_is_what_the_page_promises(name: str) -> None:
    scenario = load_scenario(name)
    drones = scenario.nodes - scenario.bases
    assert 20 <= drones <= 60
    assert 200 <= scenario.radio.range_m <= 1000
    assert scenario.mobility.speed_m_s == (5.0, 15.0)
    assert scenario.node.step_s >= 1.0
    assert (scenario.traffic.picture_bytes == 1 << 16) == ("wifi" in name)
    # A drone has a reading in each step that is still fresh in the next one.
    assert scenario.risk.stale_s > scenario.node.step_s
    surroundings = Surroundings(scenario)
    assert reachable(surroundings.graph.neighbours, scenario.bases) >= 0.9 * drones


@pytest.mark.no_cover
@pytest.mark.parametrize("name", FIELD)
def test_all_invariants_hold_in_a_short_run(name: str) -> None:
    world = World(load_scenario(name, {"nodes": 11, "steps": 12}))
    world.run(12, after=check)
    summary = world.statistics.summary()
    assert summary["delivered"] > 0
    assert summary["altered"] == summary["routing"]["loops"] == 0
    assert 0 < summary["load"]["share"] <= 0.5

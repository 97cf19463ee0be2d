"""Robots that die, reboot, are wiped or land: who and when, and the swarm as a whole."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rass_mav.cli import main
from rass_mav.config.loading import convert
from rass_mav.errors import ConfigError
from rass_mav.lab.fleet.processes import run as run_processes
from rass_mav.lab.swarm.failures import Failure, Failures
from rass_mav.lab.swarm.invariants import check
from rass_mav.lab.swarm.scenario import FailureSection, load_scenario
from rass_mav.lab.swarm.world import World
from tests.commands import json_output, output
from tests.extent import examples

from .worlds import world_of

#: Failures are possible, but none comes.
NEVER = {"base_off": [[10**6, 10**6 + 1]]}


def plan(steps: int, nodes: int, level: float = 0.0, *, seed: int = 1, bases: int = 1, **keys: Any) -> dict[int, Any]:
    """The failures of a run by step, with the same radiation everywhere. A step is 0.01 hours."""
    section = convert(keys, FailureSection, "test")
    failures = Failures(section, seed=seed, steps=steps, nodes=nodes, bases=bases, step_s=36.0)
    found = {t: failures.due(t, [level] * nodes) for t in range(steps)}
    return {t: due for t, due in found.items() if due}


def nodes_of(planned: dict[int, list[Failure]]) -> list[int]:
    return [failure.node for due in planned.values() for failure in due]


# -- when --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("fraction", "dead"), [(0.0, 0), (0.1, 2), (0.25, 6), (0.29, 7), (0.3125, 8), (1.0, 24)])
def test_a_fraction_of_the_drones_dies_at_moments_spread_over_the_run(fraction: float, dead: int) -> None:
    planned = plan(200, 25, die_fraction=fraction)
    assert len(nodes_of(planned)) == len(set(nodes_of(planned))) == dead
    assert 0 not in nodes_of(planned)
    assert all(failure.back is None for due in planned.values() for failure in due)
    if dead == 24:
        assert min(planned) < 50
        assert max(planned) >= 150


def test_who_dies_of_a_smaller_fraction_dies_of_a_larger_one_too() -> None:
    few, many = plan(200, 100, die_fraction=0.1), plan(200, 100, die_fraction=0.3)
    assert all(set(due) <= set(many[t]) for t, due in few.items())


@pytest.mark.no_cover
@pytest.mark.parametrize(("level", "effective"), [(0.2, 0.2), (1.0, 1.0), (7.0, 1.0)])
def test_drones_die_in_proportion_to_the_radiation_up_to_one(level: float, effective: float) -> None:
    dead = len(nodes_of(plan(20, 5001, level, die_rate=0.05)))
    assert dead / 5000 == pytest.approx(1 - (1 - 0.05 * effective) ** 20, abs=0.02)


@pytest.mark.no_cover
def test_drones_die_of_the_dose_that_they_have_had() -> None:
    # 200 steps of 0.01 h at 1,000 uSv/h: 2,000 uSv.
    dead = len(nodes_of(plan(200, 5001, 1000.0, die_dose=4000.0)))
    assert dead / 5000 == pytest.approx(1 - math.exp(-2000 / 4000), abs=0.02)
    # The same dose in a tenth of the time kills the same drones.
    strong = plan(20, 5001, 10_000.0, die_dose=4000.0)
    assert len(nodes_of(strong)) == dead
    assert plan(200, 50, 0.0, die_dose=1e-9) == {}


def test_where_nothing_radiates_nobody_dies_of_it_and_a_certain_death_comes_at_once() -> None:
    assert plan(100, 50, 0.0, die_rate=1.0) == {}
    assert sorted(nodes_of({0: plan(1, 50, 1.0, die_rate=1.0)[0]})) == list(range(1, 50))


@pytest.mark.parametrize("kind", ["reboot", "wipe"])
def test_reboots_and_wipes_have_the_rate_that_was_asked_for(kind: str) -> None:
    keys: dict[str, Any] = {f"{kind}_rate": 0.1, "reboot_steps": 0}
    planned = plan(100, 101, **keys)
    assert len(nodes_of(planned)) / (100 * 100) == pytest.approx(0.1, abs=0.01)
    for t, due in planned.items():
        assert {(failure.back, failure.wiped) for failure in due} == {(t, kind == "wipe")}


def test_who_is_off_does_not_reboot() -> None:
    planned = plan(50, 3, reboot_rate=1.0, reboot_steps=10)
    assert sorted(planned) == [0, 10, 20, 30, 40]
    assert {failure.back for failure in planned[20]} == {30}


@pytest.mark.no_cover
def test_a_drone_lands_when_its_battery_is_empty_and_is_back_when_it_is_full() -> None:
    assert plan(100, 2, battery_steps=[30, 30]) == {30: [Failure(1, None, False)]}
    recharged = plan(100, 2, battery_steps=[30, 30], recharge_steps=10)
    assert recharged == {t: [Failure(1, t + 10, False)] for t in (30, 70)}
    uniform = plan(100, 2001, battery_steps=[21, 40])
    assert set(uniform) == set(range(21, 41))
    assert all(len(due) == pytest.approx(100, abs=40) for due in uniform.values())


def test_a_battery_ends_and_a_drone_dies_while_it_reboots_too() -> None:
    landing = plan(40, 2, reboot_rate=1.0, reboot_steps=1000, battery_steps=[30, 30])
    assert landing == {0: [Failure(1, 1000, False)], 30: [Failure(1, None, False)]}
    recharged = plan(36, 2, wipe_rate=1.0, reboot_steps=1000, battery_steps=[30, 30], recharge_steps=5)
    assert recharged == {0: [Failure(1, 1000, True)], 30: [Failure(1, 35, False)], 35: [Failure(1, 1035, True)]}
    dying = plan(40, 11, reboot_rate=1.0, reboot_steps=1000, die_fraction=1.0)
    assert sorted(node for due in dying.values() for node, back, _ in due if back is None) == list(range(1, 11))


def test_bases_are_off_when_it_was_said_and_never_fail_otherwise() -> None:
    rates: dict[str, Any] = {"die_fraction": 1.0, "die_rate": 1.0, "reboot_rate": 1.0, "wipe_rate": 1.0}
    assert {0, 1}.isdisjoint(nodes_of(plan(30, 5, 1.0, bases=2, **rates, battery_steps=[1, 5])))
    assert plan(30, 5, bases=2, base_off=[[3, 9], [20, 21]], base_wiped=True) == {
        3: [Failure(0, 9, True), Failure(1, 9, True)],
        20: [Failure(0, 21, True), Failure(1, 21, True)],
    }


def test_one_kind_of_failure_does_not_shift_another() -> None:
    deaths = plan(100, 50, 0.5, die_rate=0.01)
    both = plan(100, 50, 0.5, die_rate=0.01, reboot_rate=0.05, wipe_rate=0.01, battery_steps=[10, 20], recharge_steps=1)
    assert {t: set(due) for t, due in deaths.items()} == {
        t: dead for t, due in both.items() if (dead := {failure for failure in due if failure.back is None})
    }


def test_another_seed_is_another_plan() -> None:
    keys: dict[str, Any] = {"die_fraction": 0.5, "reboot_rate": 0.1, "battery_steps": [5, 50]}
    assert plan(60, 20, **keys) == plan(60, 20, **keys)
    assert plan(60, 20, **keys) != plan(60, 20, seed=2, **keys)


# -- the whole ---------------------------------------------------------------------------------------------------------


@pytest.mark.no_cover
@settings(max_examples=examples(15), suppress_health_check=[HealthCheck.too_slow])
@given(
    seed=st.integers(0, 10**6),
    nodes=st.integers(16, 25),
    bases=st.integers(1, 2),
    topology=st.sampled_from(["grid", "random-walk"]),
    policy=st.sampled_from(["rass", "hop-count", "survival", "stigmergy"]),
    custody=st.sampled_from([{}, {"replicas": True}, {"mode": "none"}]),
    forward=st.sampled_from(["step", "immediate"]),
    rates=st.fixed_dictionaries(
        {
            "die_fraction": st.sampled_from([0.0, 0.2]),
            "die_rate": st.sampled_from([0.0, 0.02]),
            "reboot_rate": st.sampled_from([0.01, 0.1]),
            "wipe_rate": st.sampled_from([0.005, 0.05]),
            "reboot_steps": st.integers(0, 10),
            "recharge_steps": st.sampled_from([None, 5]),
            "base_wiped": st.booleans(),
        }
    ),
    latency=st.integers(0, 1),
)
def test_the_invariants_hold_with_all_failures_at_once(rates: dict[str, Any], **keys: Any) -> None:
    world = world_of(
        nodes=keys["nodes"],
        bases=keys["bases"],
        seed=keys["seed"],
        steps=60,
        topology=keys["topology"],
        policy={"name": keys["policy"]},
        custody=keys["custody"],
        node={"forward": keys["forward"]},
        radio={"loss": 0.1, "latency_steps": keys["latency"]},
        data={"interval_steps": 5},
        failures={**rates, "battery_steps": [15, 50], "base_off": [[12, 20], [40, 41]]},
    )
    world.run(60, after=check)
    if "mode" not in keys["custody"]:
        assert world.statistics.summary()["lost"]["vanished"] == 0


def history(policy: str, seed: int = 3) -> tuple[list[dict[int, int | None]], dict[str, Any]]:
    world = world_of(
            nodes=25,
            seed=seed,
            steps=80,
            topology="random-walk",
            policy={"name": policy},
            failures={
                "die_fraction": 0.1, "die_rate": 0.02, "reboot_rate": 0.01, "wipe_rate": 0.01,
                "battery_steps": [20, 60], "recharge_steps": 9,
            },
        )  # fmt: skip
    off: list[dict[int, int | None]] = []
    world.run(80, after=lambda world: off.append(dict(world.off)))
    return off, world.statistics.summary()


@pytest.mark.no_cover
def test_the_same_seed_fails_the_same_robots_whatever_the_policy() -> None:
    off, summary = history("rass")
    assert history("rass") == (off, summary)
    other_off, other = history("hop-count")
    assert other_off == off
    assert (other["failures"], other["created"]) == (summary["failures"], summary["created"])
    assert other["air_sha256"] != summary["air_sha256"]
    assert all(count > 0 for count in summary["failures"].values())
    assert history("rass", seed=4)[0] != off


@pytest.mark.no_cover
def test_failures_that_never_come_change_no_byte() -> None:
    summaries = []
    for failures in ({}, NEVER, {"die_rate": 1.0}):
        world = world_of(nodes=25, steps=60, seed=5, radiation={"sources": []}, failures=failures)
        world.run(60)
        summaries.append(world.statistics.summary())
    none, *never = summaries
    assert "failures" not in none
    for summary in never:
        assert summary.pop("failures") == {"died": 0, "rebooted": 0, "wiped": 0, "landed": 0}
        assert summary == none


@pytest.mark.no_cover
def test_scripts_and_people_read_of_failures_where_there_can_be_any(capsys: pytest.CaptureFixture[str]) -> None:
    command = ["swarm", "--nodes", "4", "--steps", "5"]
    failures = ["--set", "failures.battery_steps=[3, 3]"]
    assert main([*command, *failures, "--json"]) == 0
    counts = {"died": 0, "rebooted": 0, "wiped": 0, "landed": 3}
    assert json.loads(capsys.readouterr().out)["failures"] == counts
    assert "drones that died: 0, landed: 3; reboots: 0, stores wiped: 0" in output(capsys, *command, *failures).out
    assert "failures" not in json_output(capsys, *command)
    assert main(command) == 0
    assert "drones that died" not in capsys.readouterr().out


def blasted(**keys: Any) -> World:
    """A line of six drones and a base that is off, so that nothing arrives; the data of three steps, and a blast."""
    world = world_of(
        nodes=7,
        steps=20,
        topology="line",
        data={"interval_steps": 1, "until_step": 3},
        radiation={"sources": []},
        failures={"base_off": [[0, 100]], "blast": 12},
        **keys,
    )
    world.run(12)
    return world


def test_a_blast_kills_the_drones_around_the_fullest_store_and_counts_what_was_nowhere_else() -> None:
    world = blasted(custody={"replicas": False}, policy={"name": "hop-count"})
    # Without a route and without replicas each drone has its own three data, and node 1 is the first of the fullest.
    assert [len(agent.node.holdings) for agent in world.agents] == [0, 3, 3, 3, 3, 3, 3]
    world.step()
    assert world.off == {0: 100, 1: None, 2: None}
    summary = world.statistics.summary()
    assert summary["blast"] == {"drones": 2, "held": 18, "lost": 6}
    assert (summary["failures"]["died"], summary["lost"]["died"]) == (2, 6)
    check(world)


def test_a_blast_finds_the_store_with_the_most_data_and_replicas_what_is_elsewhere_too() -> None:
    world = blasted()
    full = [len(agent.node.holdings) for agent in world.agents]
    centre = full.index(max(full))
    copies = dict(world.ledger.copies)
    world.step()
    dead = [node for node, back in world.off.items() if back is None]
    assert dead == list(range(max(centre - 1, 1), min(centre + 2, 7)))
    gone = copies.keys() - world.ledger.copies.keys()
    assert world.statistics.summary()["blast"] == {"drones": len(dead), "held": 18, "lost": len(gone)}
    check(world)


def test_a_blast_counts_neither_young_data_nor_those_that_have_arrived() -> None:
    world = world_of(
            nodes=2, steps=20, topology="line", data={"interval_steps": 1}, radiation={"sources": []},
            failures={"base_off": [[8, 100]], "blast": 12},
        )  # fmt: skip
    world.run(13, after=check)
    assert world.off == {0: 100, 1: None}
    summary = world.statistics.summary()
    # The data of steps 8 to 11 are lost, but were not old enough.
    assert (summary["delivered"], summary["lost"]["died"]) == (8, 4)
    assert summary["blast"] == {"drones": 1, "held": 0, "lost": 0}


def test_people_read_what_a_blast_did(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["swarm", "--nodes", "4", "--steps", "5", "--set", "failures.blast=3"]) == 0
    assert "blast: 3 drones; of 0 data held that were at least 5 steps old, 0 lost" in capsys.readouterr().out


# -- what makes no sense -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "assignment",
    [
        "die_fraction=0.1",
        "die_rate=0.1",
        "reboot_rate=0.1",
        "wipe_rate=0.1",
        "battery_steps=[5, 9]",
        "blast=3",
        "base_off=[[1, 2]]",
    ],
)
def test_processes_refuse_what_only_virtual_time_simulates(assignment: str) -> None:
    key = assignment.partition("=")[0]
    with pytest.raises(ConfigError, match=rf"^failures\.{key}: needs transport loopback"):
        run_processes(load_scenario("udp-line", assignments=[f"failures.{assignment}"]))

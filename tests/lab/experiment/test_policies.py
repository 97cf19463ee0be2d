"""`rass-mav experiment policies`: which runs, how they are compared, what is written."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.cli import main
from rass_mav.lab.experiment import policies
from rass_mav.lab.experiment.columns import (
    BYTES,
    DELAY,
    DELIVERED,
    LOOPS,
    LOST_BY_REASON,
    LOST_PER_MILLION,
    RELIABILITY,
    STANDARD,
    TRANSMISSIONS,
    Group,
)
from rass_mav.lab.experiment.declaration import HAND_ON, POLICIES, Extent
from rass_mav.lab.experiment.measures import Series
from rass_mav.lab.experiment.policies import (
    CEILING,
    CEILING_SHARE,
    FAILING,
    GAIN,
    LOSS_RATIO,
    REFERENCE,
    TRANSMISSION_RATIO,
    VARIANTS,
    WORLD,
)
from rass_mav.lab.experiment.runner import Result, Run
from tests.extent import extents

from .test_commands import BY_DISTANCE, SMALL, asked, check_files, promised, table


def plan(*, runs: int = 2, failures: float | None = None, **chosen: list[str]) -> list[Run]:
    levels = {"topology": ["grid"], "policy": POLICIES, "variant": list(VARIANTS), **chosen}
    return [run for _, run in policies.experiment(failures).plan(Extent(runs, steps=9), levels)]


# -- which runs --------------------------------------------------------------------------------------------------------


def test_each_policy_runs_in_each_variant_with_the_same_seeds_and_stigmergy_in_one() -> None:
    planned = plan(failures=0.25)
    found = {(run.world, run.policy, run.variant, run.scenario.seed) for run in planned}
    assert len(found) == len(planned) == 2 * (len(HAND_ON) * len(VARIANTS) + 1) * 2
    assert {variant for _, policy, variant, _ in found if policy == "stigmergy"} == {"plain"}
    assert {run.scenario.seed for run in planned} == {0, 1}
    for run in planned:
        assert run.scenario.failures.die_fraction == {WORLD: 0.0, FAILING: 0.25}[run.world]


def test_a_variant_sets_its_keys_and_the_rest_is_the_world_paper() -> None:
    by_variant = {run.variant: run.scenario for run in plan(policy=["survival"], runs=1)}
    found = {name: (s.custody.replicas, "receipts" not in s.without, s.node.forward) for name, s in by_variant.items()}
    assert found == {
        "plain": (False, False, "step"),
        "immediate": (False, False, "immediate"),
        "mirror": (True, False, "step"),
        "mirror-immediate": (True, True, "immediate"),
        "defaults": (True, True, "immediate"),
    }
    full = [name for name, s in by_variant.items() if not {"overhearing", "queue-toll"} & {*s.without}]
    assert full == ["defaults"]
    assert all({"measured-retries", "contacts"} <= {*s.without} for s in by_variant.values())
    for scenario in by_variant.values():
        assert (scenario.radiation.noise, scenario.store.capacity_items) == (0.05, 50)


def test_only_survival_averages_its_readings() -> None:
    places = list(policies.PLACES)
    for run in plan(topology=places, policy=["rass", "hop-count", "survival"], variant=["plain"], runs=1):
        assert run.scenario.risk.gain == (0.1 if run.policy == "survival" else 1.0), run.scenario.topology


def test_islands_are_the_papers_grid_but_for_the_split() -> None:
    (islands,) = plan(topology=["islands"], policy=["rass"], variant=["plain"], runs=1)
    (grid,) = plan(policy=["rass"], variant=["plain"], runs=1)
    a, b = islands.scenario, grid.scenario
    assert (a.topology, a.mobility.split_step, a.mobility.rejoin_step, a.mobility.gap_m) == ("islands", 100, None, 2.0)
    assert (a.data.interval_steps, a.nodes, a.arena) == (40, 100, 20.0)
    assert (a.radio, a.radiation, a.store, a.custody, a.risk) == (b.radio, b.radiation, b.store, b.custody, b.risk)


# -- how they are compared ---------------------------------------------------------------------------------------------


def result(seed: int, reliability: float, sent: float, kept: float = 90.0, **summary: Any) -> Result:
    """100 data; only what a comparison looks at."""
    told = {
        "created": 100, "lost": {"corrupted": round(100 * (1 - reliability)), "died": 0, "vanished": 0},
        "delivered": 50, "delay_steps": {"mean": 5.0}, "memory_used_percent": 1.0, "copies_mean": 1.0,
        "transmissions_per_datum": sent, "bytes_per_node_s": 7.0, "routing": {"max_hop_count": 9, "loops": 0},
        **summary,
    }  # fmt: skip
    ceiling = {"ceiling": {"data": 100, "kept": kept}}
    series, delays = Series([], [], [], [], []), {2: 30, 9 + seed: 20}
    return Result("", "paper", "grid", "rass", "plain", seed, 9, told, series, delays, {}, ceiling)


def test_a_comparison_by_hand() -> None:
    """Seed 2 has no partner: it counts for the means, not for what is compared."""
    reference = [result(0, 0.6, 4.0), result(1, 0.8, 6.0)]
    results = [result(1, 0.9, 9.0, routing={"loops": 2}), result(0, 0.8, 6.0), result(2, 0.4, 3.0, kept=60)]
    found = Group(REFERENCE, results, reference)
    assert found.certain(RELIABILITY).mean == pytest.approx(0.7)
    assert found.certain(LOST_PER_MILLION).mean == pytest.approx(300_000)
    assert found.certain(DELIVERED).values == (0.5, 0.5, 0.5)
    assert found.certain(TRANSMISSIONS).mean == pytest.approx(6.0)
    assert found.certain(BYTES).mean == 7.0
    # Of the 150 that arrived 90 took 2 steps, 20 each 9, 10 and 11.
    assert delays(found) == {"delay_p50": 2, "delay_p95": 11}
    # +0.1 and +0.2: all that two runs can tell.
    gain = found.certain(GAIN)
    assert gain.mean == pytest.approx(0.15)
    assert gain.interval == pytest.approx((0.1, 0.2))
    assert found[LOSS_RATIO] == pytest.approx((0.1 + 0.2) / (0.4 + 0.2))
    assert found[TRANSMISSION_RATIO] == pytest.approx(15 / 10)
    assert found.certain(CEILING).mean == pytest.approx(0.8)
    assert found[CEILING_SHARE] == pytest.approx(0.7 / 0.8)
    assert found[LOOPS] == 2
    assert {c.name: found.certain(c).mean for c in LOST_BY_REASON}["lost_corrupted"] == pytest.approx(0.3)


def delays(group: Group) -> dict[str, object]:
    return {column.name: group[column] for column in STANDARD if column.name.startswith("delay_p")}


def test_the_least_the_median_and_the_most_of_the_runs() -> None:
    found = Group({}, [result(seed, kept, 4.0) for seed, kept in enumerate((0.9, 0.4, 0.8, 0.7))])
    columns = {column.name: column for column in STANDARD if column.name.startswith("reliability_")}
    assert {name: found[column] for name, column in columns.items()} == pytest.approx(
        {"reliability_least": 0.4, "reliability_median": 0.75, "reliability_most": 0.9}
    )
    [shown] = (column for column in STANDARD if column.heading.startswith("Reliability: least"))
    assert shown.cell(found) == "0.4000, 0.7500, 0.9000"


def test_without_a_reference_nothing_is_compared() -> None:
    found = Group({}, [result(0, 0.6, 4.0)])
    assert [found[column] for column in (GAIN, LOSS_RATIO, TRANSMISSION_RATIO)] == [None, None, None]
    assert found.certain(RELIABILITY).mean == 0.6


def test_vanished_data_do_not_count_as_lost() -> None:
    lost = {"corrupted": 10, "vanished": 30}
    assert Group({}, [result(0, 0.0, 4.0, lost=lost)]).certain(RELIABILITY).mean == 0.9


def test_stigmergy_knows_no_base_and_so_no_delay() -> None:
    found = Group({}, [msgspec.structs.replace(result(0, 0.6, 4.0), policy="stigmergy")])
    assert found[DELAY] is None
    assert delays(found) == {"delay_p50": None, "delay_p95": None}


def test_a_reference_that_loses_nothing_gives_no_ratio() -> None:
    assert Group({}, [result(0, 0.6, 4.0)], [result(0, 1.0, 4.0)])[LOSS_RATIO] is None


@given(st.lists(st.tuples(st.floats(0, 0.99), st.floats(0.1, 99)), min_size=2, max_size=5))
def test_compared_with_itself_nothing_differs(pairs: list[tuple[float, float]]) -> None:
    runs = [result(seed, reliability, sent) for seed, (reliability, sent) in enumerate(pairs)]
    found = Group({}, runs, runs)
    assert (found.certain(GAIN).mean, found.certain(GAIN).interval) == (0.0, (0.0, 0.0))
    assert found[LOSS_RATIO] == found[TRANSMISSION_RATIO] == 1.0


# -- what is written ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seeds", extents(1, 5))
def test_the_command_from_end_to_end(seeds: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = [
        "policies", "--out", str(tmp_path), "--policy", "rass", "stigmergy", "survival", "--variant", "plain", "mirror",
        *SMALL, "--runs", str(seeds), "--set", "mobility.split_step=9",
    ]  # fmt: skip
    first = asked(capsys, *run, "--topology", "grid")
    assert first["runs"] == first["done"] == (2 * 2 + 1) * seeds
    second = asked(capsys, *run, "--topology", "grid", "islands", "--failures", "0.2")
    assert (second["done"], second["reused"]) == (3 * first["done"], first["done"])
    check_files(tmp_path, second)

    _, runs = table(tmp_path / "runs.csv")
    assert {r["failures.died"] for r in runs if r["world"] == WORLD} == {""}
    assert {r["failures.died"] for r in runs if r["world"] == FAILING} == {"3"}
    assert {r["routing.loops"] for r in runs} == {"0"}
    columns, rows = table(tmp_path / "table.csv")
    assert columns == promised("policies")
    assert len(rows) == 2 * 2 * (2 * 2 + 1)
    for row in rows:
        if row.items() >= REFERENCE.items():
            assert (row["over_reference_mean"], row["losses_in_references"]) == ("0.0", "1.0")
        # The oracle does not depend on who runs.
        same = [r for r in rows if (r["world"], r["topology"]) == (row["world"], row["topology"])]
        assert {r["ceiling_mean"] for r in same} == {row["ceiling_mean"]}
        assert float(row["lost_died_mean"]) == 0 or row["world"] == FAILING
    grid = {(r["policy"], r["variant"]): r for r in rows if (r["world"], r["topology"]) == (WORLD, "grid")}
    assert float(grid["rass", "mirror"]["reliability_mean"]) > float(grid["rass", "plain"]["reliability_mean"])
    assert grid["stigmergy", "plain"]["delay_mean"] == ""

    columns, rows = table(tmp_path / "delay-by-distance.csv")
    assert tuple(columns) == ("world", "topology", "policy", "variant", *BY_DISTANCE)
    assert {r["variant"] for r in rows} == {"plain", "mirror"}
    text = (tmp_path / "table.md").read_text(encoding="utf-8")
    assert "## grid, 3 of 15 drones die\n\nCeiling: " in text
    assert "## islands\n\nCeiling: " in text


def test_without_rass_people_are_told_that_nothing_is_compared(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--topology", "grid", "--policy", "survival", "stigmergy", "--variant", "plain", *SMALL]
    assert main(["experiment", "policies", "--out", str(tmp_path), *arguments]) == 0
    (survival, stigmergy) = (
        line for line in capsys.readouterr().out.splitlines() if line.startswith(("| surv", "| virt"))
    )
    assert survival.startswith("| survival | one copy, one hop a step | ")
    assert survival.count(" n/a ") == 3
    assert stigmergy.count(" n/a ") == 5  # nor a delay
    assert stigmergy.startswith("| virtual stigmergy | copies everywhere | ")

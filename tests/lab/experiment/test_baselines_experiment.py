"""`rass-mav experiment baselines`: which runs, and what is written."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from rass_mav.lab.baselines import OURS, PROTOCOLS
from rass_mav.lab.experiment import baselines as experiment
from rass_mav.lab.experiment.columns import Group
from rass_mav.lab.experiment.declaration import AIRS, Extent
from rass_mav.lab.experiment.runner import Result, Run, execute
from rass_mav.lab.swarm.scenario import load_scenario

from .test_commands import SMALL, asked, check_files, promised, table
from .test_policies import result


def plan(places: list[str], airs: list[str], protocols: list[str], own_runs: int | None = None) -> list[Run]:
    chosen = {"place": places, "air": airs, "protocol": protocols}
    return [run for _, run in experiment.experiment(own_runs).plan(Extent(2, 500), chosen)]


def test_each_protocol_runs_in_each_place_on_each_air_with_the_same_seeds() -> None:
    planned = plan(list(experiment.PLACES), list(AIRS), list(PROTOCOLS))
    found = {(run.world, run.variant, run.protocol, run.scenario.seed) for run in planned}
    assert len(found) == len(planned) == len(experiment.PLACES) * len(AIRS) * len(PROTOCOLS) * 2
    assert {run.world for run in planned} == {f"{place}-{air}" for place in experiment.PLACES for air in AIRS}
    assert all(run.variant == run.protocol for run in planned)


def test_ours_may_have_more_runs_which_begin_with_the_same_seeds() -> None:
    planned = plan(["grid"], ["none"], [OURS, "prophet"], own_runs=5)
    assert [(run.variant, run.scenario.seed) for run in planned] == [
        *((OURS, seed) for seed in range(5)), ("prophet", 0), ("prophet", 1),
    ]  # fmt: skip


@pytest.mark.parametrize("place", experiment.PLACES)
@pytest.mark.parametrize("air", AIRS)
def test_all_have_the_same_world_air_and_memory_and_ours_is_the_product_as_it_comes(place: str, air: str) -> None:
    planned = {run.variant: run.scenario for run in plan([place], [air], list(PROTOCOLS)) if not run.scenario.seed}
    ours = planned[OURS]
    shipped = load_scenario(experiment.PLACES[place].scenario or "demo")
    assert (ours.policy, ours.custody, ours.routing) == (shipped.policy, shipped.custody, shipped.routing)
    assert ours.radio.kind == ("none" if air == "none" else "csma")
    assert (ours.store.capacity_items, ours.store.bandwidth_items) == (50, 20)
    assert ours.data.until_step == 450
    for scenario in planned.values():
        # Only what a protocol does with data may differ, not what it has for that.
        assert replace(scenario, policy=ours.policy, custody=ours.custody, without=ours.without) == ours


def test_the_nodes_of_a_run_are_those_of_its_protocol_in_another_process_too() -> None:
    """Spray and wait holds what no base is near enough for; the others have delivered it."""
    held = {}
    for name in ("spray-and-wait", "hop-count"):
        (run, _) = plan(["grid"], ["none"], [name])
        small = replace(run.scenario, nodes=25, arena_m=10, steps=40)
        held[name] = execute(replace(run, scenario=small)).summary["held"]
    assert held["spray-and-wait"] > 10 > held["hop-count"]


@pytest.mark.usefixtures("pixels")
def test_the_command_from_end_to_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["baselines", "--out", str(tmp_path), *SMALL, "--place", "grid", "--air", "none"]
    first = asked(capsys, *command, "--baseline", OURS, "spray-and-wait")
    assert (first["done"], first["reused"]) == (4, 0)
    second = asked(capsys, *command, "--baseline", OURS, "spray-and-wait", "backpressure", "--own-runs", "3")
    assert (second["done"], second["reused"]) == (3, 4)
    check_files(tmp_path, second, pixels=True)
    columns, rows = table(tmp_path / "table.csv")
    assert columns == promised("baselines")
    assert [(row["place"], row["air"], row["protocol"], row["runs"]) for row in rows] == [
        ("grid", "none", OURS, "3"), ("grid", "none", "spray-and-wait", "2"), ("grid", "none", "backpressure", "2"),
    ]  # fmt: skip
    ours, waiting, _ = rows
    assert (ours["reliability_over_ours_mean"], ours["delivered_over_ours_high"]) == ("0.0", "0.0")
    # It waits for a base that does not come.
    assert float(waiting["delivered_over_ours_high"]) < 0
    text = (tmp_path / "table.md").read_text(encoding="utf-8")
    assert "## grid, air none\n" in text
    assert "| binary spray and wait | 2 |" in text


def test_the_table_begins_with_the_places_where_another_protocol_loses_less(tmp_path: Path) -> None:
    def runs(*reliabilities: float) -> list[Result]:
        return [result(seed, reliability, 4.0) for seed, reliability in enumerate(reliabilities)]

    def text(**results: list[Result]) -> str:
        groups = [
            Group({"place": "walk", "air": "wifi-6m", "protocol": protocol}, found, results.get(OURS, ()))
            for protocol, found in results.items()
        ]
        experiment.experiment().report(groups, tmp_path)
        return (tmp_path / "table.md").read_text(encoding="utf-8")

    ours, worse, better = runs(0.9, 0.8), runs(0.9, 0.6), runs(0.95, 0.85)
    assert "None of the protocols loses less than ours anywhere.\n" in text(default=ours, rapid=worse)
    assert "loses less" not in text(rapid=worse)
    told = text(default=ours, rapid=worse, epidemic=better)
    assert "- random walk, air wifi-6m: epidemic with receipts, +0.0500 " in told
    assert "RAPID" not in told[: told.index("##")]

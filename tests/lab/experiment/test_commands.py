"""`rass-mav experiment`, as a person or a script calls it; small swarms and few steps."""

from __future__ import annotations

import csv
import sys
from importlib import import_module
from inspect import signature
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

import pytest

from rass_mav.cli import main
from rass_mav.lab.commands.experiment import EXPERIMENTS, argument
from rass_mav.lab.experiment import five_drones, paper
from rass_mav.lab.experiment.tables import RUN_COLUMNS
from tests.commands import json_output, output

from .conftest import PNG

SMALL = ["--set", "nodes=16", "--set", "arena_m=8", "--runs", "2", "--steps", "30", "--jobs", "1"]
#: Columns of the tables, which scripts rely on; ~ stands for the mean and its interval.
STANDARD = (
    "reliability~ delivered~ reliability_least reliability_median reliability_most delivered_least delivered_median "
    "delivered_most lost_per_million~ delay~ delay_p50 delay_p95 transmissions~ bytes_per_node_s~"
)
COLUMNS = {
    "paper": f"world topology policy runs steps delay_paper memory_paper reliability_authors memory~ {STANDARD}",
    "five-drones": f"policy runs steps {STANDARD} from_A~ from_B~ from_C~ from_D~",
    "moving-sources": f"drift_m policy runs steps {STANDARD}",
    "local-maxima": (
        f"topology policy runs steps {STANDARD} nodes_in_basins~ nodes_lasting~ stored_in_basins~ "
        "stored_in_lasting~ corrupted_in_basins~ corrupted_in_lasting~"
    ),
    "policies": (
        f"world topology policy variant runs steps {STANDARD} over_reference~ delivered_over_reference~ "
        "losses_in_references ceiling~ share_of_ceiling bound~ transmissions_in_references memory~ copies~ loops "
        "lost_corrupted~ lost_overflow~ lost_expired~ lost_died~ lost_vanished~ lost_unfounded~"
    ),
    "ablation": (
        f"air topology off runs steps {STANDARD} reliability_over_defaults~ delivered_over_defaults~ "
        "losses_in_defaults transmissions_in_defaults loops"
    ),
    "baselines": (
        f"place air protocol runs steps {STANDARD} reliability_over_ours~ delivered_over_ours~ losses_in_ours "
        "memory~ loops lost_corrupted~ lost_overflow~ lost_expired~ lost_died~ lost_vanished~ lost_unfounded~"
    ),
    "hostile": (
        f"attacker policy variant place runs steps {STANDARD} unfounded~ false_delivered~ late~ lost~ refused~ "
        "false_losses~ before~ during~ after~ delay_after~"
    ),
    "sources": "world strength dead runs steps delivered~ readings",
}
#: Columns of delay-by-distance.csv after those of the case.
BY_DISTANCE = (
    "distance_hops", "created", "arrived", "lost", "delay_mean", "runs_with_arrivals", "delay_of_runs_mean",
    "delay_of_runs_low", "delay_of_runs_high",
)  # fmt: skip


def asked(capsys: pytest.CaptureFixture[str], *arguments: str) -> Any:
    """The one JSON object on stdout; nothing is on stderr."""
    return json_output(capsys, "experiment", *arguments)


def table(path: Path) -> tuple[list[str], list[dict[str, str]]]:
    with path.open(encoding="utf-8", newline="") as file:
        reader = csv.DictReader(file)
        rows = list(reader)
    return list(reader.fieldnames or ()), rows


def check_files(out: Path, summary: dict[str, Any], *, pixels: bool = False) -> None:
    """All files that the command names are there, and nothing else but the runs; figures are figures."""
    assert {path.name for path in out.iterdir()} - {"runs"} == set(summary["files"])
    for name in summary["files"]:
        if name.endswith(".png"):
            content = (out / name).read_bytes()
            assert content.startswith(PNG)
            assert len(content) > 10_000 or not pixels


def promised(experiment: str) -> list[str]:
    """The columns of its table."""
    ends = {False: ("",), True: ("_mean", "_low", "_high")}
    return [word.rstrip("~") + end for word in COLUMNS[experiment].split() for end in ends[word.endswith("~")]]


@pytest.fixture
def authors(tmp_path: Path) -> Path:
    """Files of the authors' form."""
    data = tmp_path / "authors"
    data.mkdir()
    curves = "topology,policy,step,reliability_mean,swarm_stored_mean,base_stored_mean\n"
    curves += "grid,rass,0,1,11,0\ngrid,rass,29,0.8125,60,90\n"
    (data / "curves.csv").write_text(curves)
    (data / "delays.csv").write_text("topology,policy,delay_steps,count\ngrid,rass,2,30\ngrid,rass,4,10\n")
    return data


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_the_options_are_those_of_the_declaration_and_the_columns_those_that_scripts_know(name: str) -> None:
    experiment = import_module(f"rass_mav.lab.experiment.{name.replace('-', '_')}").experiment
    row = EXPERIMENTS[name]
    assert list(experiment().csv_columns) == promised(name)
    assert {factor.option for factor in experiment().factors} - {""} == row.choices.keys()
    assert [argument(own.option) for own in row.own] == list(signature(experiment).parameters)
    # What the completions of the shells list.
    assert all(resolve_name(f"rass_mav.lab.experiment.{own.known}") for own in row.own if own.known)


def test_paper(tmp_path: Path, authors: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    command = ["paper", "--out", str(out), "--world", "paper", "--topology", "grid", "--reference-data", str(authors)]
    first = asked(capsys, *command, *SMALL)
    assert (first["runs"], first["done"], first["reused"]) == (6, 6, 0)
    check_files(out, first)
    assert sum(name.endswith(".png") for name in first["files"]) == 4

    columns, runs = table(out / "runs.csv")
    assert tuple(columns[:6]) == RUN_COLUMNS
    assert {"reliability", "delay_steps.mean", "lost.corrupted", "memory_used_percent", "air_sha256"} <= set(columns)
    assert [(r["policy"], r["seed"]) for r in runs] == [
        (policy, seed) for policy in paper.POLICIES for seed in ("0", "1")
    ]
    columns, rows = table(out / "table1.csv")
    assert columns == promised("paper")
    by_policy = {row["policy"]: row for row in rows}
    rass = by_policy["rass"]
    assert (rass["delay_paper"], rass["memory_paper"], rass["reliability_authors"]) == ("11.45", "1.35", "0.8125")
    assert by_policy["hop-count"]["reliability_authors"] == ""
    assert by_policy["stigmergy"]["delay_mean"] == ""
    for column, key in (
        ("reliability", "reliability"), ("delivered", "delivered_share"), ("delay", "delay_steps.mean"),
        ("transmissions", "transmissions_per_datum"), ("memory", "memory_used_percent"),
    ):  # fmt: skip
        a, b = (float(r[key]) for r in runs if r["policy"] == "rass")
        assert float(rass[f"{column}_mean"]) == pytest.approx((a + b) / 2, abs=1e-4)
    # Two values: half of the interval is t_1 |a - b| / 2.
    assert float(rass["memory_high"]) == pytest.approx((a + b) / 2 + 12.7062 * abs(a - b) / 2, abs=1e-3)
    assert float(rass["lost_per_million_high"]) == pytest.approx(1e6 * (1 - float(rass["reliability_low"])), abs=1)
    a, b = (float(r["bytes_sent"]) for r in runs if r["policy"] == "rass")
    assert float(rass["bytes_per_node_s_mean"]) == pytest.approx((a + b) / 2 / (16 * 30 * 0.2), abs=0.1)
    assert int(rass["delay_p50"]) <= int(rass["delay_p95"]) <= 30

    columns, rows = table(out / "delay-by-distance.csv")
    assert tuple(columns) == ("world", "topology", "policy", *BY_DISTANCE)
    assert {row["distance_hops"] for row in rows} == {"1", "2", "3"}
    assert "| grid | RASS | 11.45 |" in (out / "table1.md").read_text(encoding="utf-8")

    before = (out / "runs.csv").read_bytes(), (out / "table1.csv").read_bytes()
    again = asked(capsys, *command, *SMALL)
    assert (again["done"], again["reused"]) == (0, 6)
    assert ((out / "runs.csv").read_bytes(), (out / "table1.csv").read_bytes()) == before
    # More runs, or later seeds: those that were done are reused.
    more = asked(capsys, *command, *SMALL, "--runs", "3", "--policy", "rass")
    assert (more["done"], more["reused"]) == (1, 2)
    later = asked(capsys, *command, *SMALL, "--first-seed", "2", "--policy", "rass")
    assert (later["done"], later["reused"]) == (1, 1)
    assert [row["seed"] for row in table(out / "runs.csv")[1]] == ["2", "3"]


@pytest.mark.parametrize("world", ["reference", "both"])
def test_the_other_world(world: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    command = ["paper", "--out", str(out), "--world", world, "--topology", "grid", "--runs", "1", "--steps", "12"]
    summary = asked(capsys, *command, "--policy", "rass", "rass-literal", "--jobs", "1")
    _, runs = table(out / "runs.csv")
    expected = [("reference", "rass")]
    if world == "both":
        expected = [("paper", "rass"), ("paper", "rass-literal"), *expected]
    assert [(r["world"], r["policy"]) for r in runs] == expected
    check_files(out, summary)


@pytest.mark.usefixtures("pixels")
def test_five_drones(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    summary = asked(capsys, "five-drones", "--out", str(tmp_path), "--runs", "1", "--steps", "120", "--jobs", "1")
    assert summary["done"] == 3
    check_files(tmp_path, summary, pixels=True)
    columns, rows = table(tmp_path / "table.csv")
    assert columns == promised("five-drones")
    kept = {row["policy"]: float(row["from_C_mean"]) for row in rows}
    # C's data go round the source under `rass`, and past it under the others.
    assert kept["rass"] > kept["hop-count"] + 0.5
    assert kept["rass"] > kept["rass-literal"] + 0.5
    columns, rows = table(tmp_path / "reliability.csv")
    assert tuple(columns) == five_drones.SERIES_COLUMNS
    assert len(rows) == 3 * 5 * 25


def test_moving_sources(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["moving-sources", "--out", str(tmp_path), "--drift", "0.05", "0.5", "--policy", "rass", "hop-count"]
    summary = asked(capsys, *command, *SMALL, "--runs", "1")
    assert summary["done"] == 4
    check_files(tmp_path, summary)
    columns, rows = table(tmp_path / "table.csv")
    assert columns == promised("moving-sources")
    assert [(row["drift_m"], row["policy"]) for row in rows] == [
        ("0.05", "rass"), ("0.05", "hop-count"), ("0.5", "rass"), ("0.5", "hop-count"),
    ]  # fmt: skip
    _, runs = table(tmp_path / "runs.csv")
    # The sources are where they are: the drift changes what becomes of the data.
    assert len({row["air_sha256"] for row in runs}) == 4


def test_local_maxima(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["local-maxima", "--out", str(tmp_path), "--topology", "grid", "random-walk"]
    summary = asked(capsys, *command, *SMALL, "--runs", "1")
    assert summary["done"] == 6
    check_files(tmp_path, summary)
    columns, rows = table(tmp_path / "table.csv")
    assert columns == promised("local-maxima")
    on_grid = {row["policy"]: float(row["nodes_in_basins_mean"]) for row in rows if row["topology"] == "grid"}
    # With hops alone there is always a neighbour nearer to the base.
    assert on_grid["hop-count"] < 0.01 < on_grid["rass"]
    shown = (tmp_path / "table.md").read_text()
    assert "nodes that are basins: least, median, most" in shown
    alone = f"{100 * on_grid['rass']:.1f}"
    assert f"| grid | RASS | {alone}, {alone}, {alone} |" in shown


def test_people_read_the_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["five-drones", "--out", str(tmp_path), "--runs", "1", "--steps", "20", "--policy", "rass"]
    out = output(capsys, "experiment", *arguments, "--jobs", "1").out
    assert "| RASS |" in out
    assert "1 runs done" in out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["paper", "--runs", "0"], "--runs: expected 1 or more, got 0"),
        (["paper", "--first-seed", "-1"], "--first-seed: expected 0 or more, got -1"),
        (["paper", "--jobs", "0"], "--jobs: expected 1 or more, got 0"),
        (["paper", "--world", "reference", "--policy", "rass-literal"], "rass-literal belongs to the world paper"),
        (
            ["paper", "--reference-data", "/nowhere"],
            "/nowhere/curves.csv: there is no folder /nowhere",
        ),
        (["paper", "--set", "radio.loss=2"], "radio.loss"),
        (["moving-sources", "--drift", "-1"], "radiation.drift"),
        (["moving-sources", "--topology", "moon"], "--topology: expected some of grid, scale-free, "),
        (["five-drones", "--set", "policy.name=rass"], "--set: policy.name is chosen by --policy here"),
        (
            ["ablation", "--off", "radio"],
            "--off: expected some of nothing, policy, immediate, mirror, receipts, everything",
        ),
        (["ablation", "--air", "water"], "--air: expected some of none, wifi-6m, wifi-1m, sik-250k, sik-64k, lora"),
        (["ablation", "--set", "topology=line"], "chosen by --topology"),
        (
            ["baselines", "--baseline", "maxprop"],
            "--baseline: expected some of default, hop-count, epidemic, ",
        ),
        (["baselines", "--place", "moon"], "--place: expected some of grid, walk, field, dying-walk"),
        (["baselines", "--own-runs", "0"], "--own-runs: expected 1 or more, got 0"),
        (["baselines", "--set", "policy.name=rass"], "chosen by --baseline"),
        (["policies", "--policy", "stigmergy", "--variant", "mirror"], "stigmergy has the variant plain only"),
        (["policies", "--set", "radiation.rule=threshold"], "radiation.rule: expected probability"),
        (["policies", "--set", "topology=line"], "topology is chosen by --topology"),
        (["policies", "--set", "policy.name=rass"], "policy.name is chosen by --policy"),
        (["policies", "--topology", "grid", "--policy", "rass", "--failures", "1.5"], "failures.die_fraction"),
        (["moving-sources", "--set", "radiation.drift=1"], "--set: radiation.drift is chosen by the experiment"),
        (["moving-sources", "--set", "radiation={drift: 1}"], "--set: radiation.drift is chosen by the experiment"),
        (["policies", "--set", "custody.replicas=true"], "--set: custody.replicas is chosen by --variant here"),
        (["ablation", "--set", "node.forward=step"], "--set: node.forward is chosen by --off here"),
        (["baselines", "--set", "data.until_step=7"], "--set: data.until_step is chosen by the experiment here"),
        (["hostile", "--set", "keys=true"], "--set: keys is chosen by the experiment here"),
        (["sources", "--set", "radiation.strength=[1, 2]"], "--set: radiation.strength is chosen by the experiment"),
        (["five-drones", "--set", "steps=7"], "--set: steps is chosen by --steps here"),
        (["five-drones", "--set", "seed=1"], "--set: seed is chosen by --first-seed here"),
        (["hostile", "--attacker", "friend"], "--attacker: expected some of nobody, sinkhole"),
        (["counting-to-infinity", "--steps", "60"], "--steps: expected more than 60"),
    ],
)
def test_bad_usage_is_one_line(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    err = output(capsys, "experiment", *arguments, "--out", str(tmp_path / "out"), code=2).err
    assert message in err
    assert err.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_authors_files_of_another_form_are_refused(authors: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (authors / "delays.csv").write_text("topology,policy,delay\ngrid,rass,2\n")
    command = ["experiment", "paper", "--out", str(authors), "--reference-data", str(authors)]
    assert main(command) == 2
    assert "delays.csv: expected the columns topology, policy, delay_steps, count" in capsys.readouterr().err


def test_help_is_shown_where_the_authors_files_are_damaged(
    authors: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (authors / "curves.csv").write_text("topology\ngrid\n")
    monkeypatch.setattr(paper, "default_directory", lambda: authors)
    with pytest.raises(SystemExit, match="0"):
        main(["experiment", "paper", "--help"])
    assert "--topology NAME" in capsys.readouterr().out


def test_without_matplotlib_it_says_what_to_install_before_it_runs_anything(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert main(["experiment", "five-drones", "--out", str(tmp_path / "out")]) == 2
    assert "'.[sim]' in the checkout" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()

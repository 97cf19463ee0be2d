"""The experiment that judges the estimate of sources."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from rass_mav.cli import main
from rass_mav.lab.experiment.located import enough, matched
from rass_mav.lab.experiment.sources import LINES, POINTS, lines
from rass_mav.lab.swarm.autopilot import to_earth
from rass_mav.lab.swarm.radiation import Source
from rass_mav.lab.swarm.scenario import load_scenario
from rass_mav.lab.swarm.world import World


def test_it_writes_what_was_found_and_what_is_true(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("numpy", reason="numpy is not installed (extra ground)")
    args = ["experiment", "sources", "--out", str(tmp_path), "--runs", "1", "--steps", "61", "--jobs", "1", "--json"]
    assert main([*args, "--world", "1", "line", "--strength", "strong", "--dead", "0"]) == 0
    assert json.loads(capsys.readouterr().out)["done"] == 2
    text = (tmp_path / "table.md").read_text()
    assert "Worlds that fit the model" in text
    assert "Worlds that do not" in text
    for path in (tmp_path / "runs").glob("*.json"):
        looks = json.loads(path.read_text())["extra"]["sources"]
        assert set(looks) == {"early", "end"}
        assert looks["end"]["readings"] > 100
        assert len(looks["end"]["true"]) in (1, POINTS)


def test_lines_are_the_same_each_time() -> None:
    found = lines((100.0, 1000.0))
    assert found == lines((100.0, 1000.0))
    assert len(found) == LINES
    assert all(100.0 <= sum(strength for _, _, strength in line) <= 1000.0 for line in found)


def look(*found: tuple[float, bool], true: tuple[float, ...]) -> dict[str, Any]:
    """Sources on a line: places of those found, and whether they are resolved."""
    return {
        "found": [{"place": [x, 0.0], "resolved": resolved} for x, resolved in found],
        "true": [[x, 0.0, 1.0] for x in true],
    }


def test_each_source_is_matched_once_and_the_nearest_first() -> None:
    pairs = matched(look((0.0, True), (3.0, True), (100.0, False), true=(2.0, 90.0)))
    assert [(k, found["place"][0], distance) for k, found, distance in pairs] == [(0, 3.0, 1.0), (1, 0.0, 90.0)]
    assert matched(look(true=(2.0,))) == []


def test_enough_readings_are_of_two_drones_and_around_the_source() -> None:
    from rass_mav.ground.sources.readings import Sample

    world = World(load_scenario("field-sources", {"seed": 1, "steps": 1}))

    def of(drone: int, *places: tuple[float, float]) -> list[Sample]:
        around = places or ((5.0, 0.0), (-3.0, 4.0), (-3.0, -4.0))
        return [Sample(drone, 0.0, *to_earth(x, y), 110.0, 9.0, 3.0) for x, y in around for _ in range(2)]

    # 1,000 uSv/h at 1 m are 8 at 11 m, which are 14 counts.
    source = Source(0.0, 0.0, 1000.0)
    assert enough([*of(3), *of(4)], [source], world) == [True]
    assert enough([*of(3), *of(3)], [source], world) == [False]
    # All from the north: it may be anywhere in the south.
    north = [(-5.0, 1.0), (0.0, 5.0), (5.0, 1.0)]
    assert enough([*of(3, *north), *of(4, *north)], [source], world) == [False]
    assert enough([*of(3, *north), *of(4, *north, (0.0, -5.0))], [source], world) == [True]
    # Another source hides it.
    assert enough([*of(3), *of(4)], [source, Source(1.0, 0.0, 1e5)], world) == [False, True]

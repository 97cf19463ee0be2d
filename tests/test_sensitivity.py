"""tools/sensitivity.py: what half and twice a constant do in small swarms; docs/contribute/constants.md shows all."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tools.pages import ROOT
from tools.sensitivity import PAGE, WORLDS, changed, chosen, main, times, unit, worlds


def test_one_number_is_changed_where_it_stands() -> None:
    text = "FIRST, SECOND = 3, 0.999\nTHIRD = 2 * FIRST\n"
    for name, factor, wanted in (("FIRST", 2.0, (6, 0.999, 12)), ("SECOND", 0.5, (3, 0.9995, 6))):
        found: dict[str, float] = {}
        exec(changed(text, name, factor), found)
        assert (found["FIRST"], found["SECOND"], found["THIRD"]) == wanted
    assert times(1, 0.5) == 1
    assert times(0.5, 0.5) == 0.25


def test_names_choose_constants() -> None:
    assert {one.module for one in chosen(["trust.sessions", "pace"])} == {"core/pace", "trust/sessions"}
    assert [(one.name, unit(one)) for one in chosen(["routes.neighbours.RECENT_TURNS"])] == [("RECENT_TURNS", "turns")]
    with pytest.raises(SystemExit, match="nothing: no tuned constant"):
        chosen(["nothing"])


def test_every_constant_has_worlds() -> None:
    assert {world for one in chosen([]) for world in worlds(one)} == WORLDS.keys()


def test_the_page_has_each_constant_with_its_value() -> None:
    page = (ROOT / PAGE).read_text(encoding="utf-8")
    found = set()
    for section in page.split("\n### ")[1:]:
        module = section.partition("\n")[0]
        found |= {(f"{module}.{name}", value) for name, value in re.findall(r"^\| `(\w+)` \| (.*?) \|", section, re.M)}
    assert found == {(one.label, one.value) for one in chosen([])}, "python -m tools.sensitivity --into " + PAGE


def test_a_constant_is_run_with_half_and_twice_its_value(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    small = ("nodes=9", "arena_m=6", "steps=12", "data.until_step=10")
    command = ["gossip.IMIN", "--seeds", "1-1", "--folder", str(tmp_path), "--jobs", "2"]
    command += [word for key in small for word in ("--set", key)]
    main(command)
    said = capsys.readouterr().out
    head, row = (line for line in said.splitlines() if "half" in line or "`IMIN`" in line)
    assert head.count("|") == row.count("|") == 7
    assert row.startswith("| `IMIN` | 8 | periods | walk | ")
    assert "fails" not in said
    done = (tmp_path / "runs.jsonl").read_text(encoding="utf-8")
    main(command)
    assert (tmp_path / "runs.jsonl").read_text(encoding="utf-8") == done, "what is done is not done again"
    assert capsys.readouterr().out == said

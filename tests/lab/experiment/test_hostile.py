"""`rass-mav experiment hostile`: which runs, and what is written."""

from __future__ import annotations

from pathlib import Path

import pytest

from rass_mav.lab.experiment import hostile
from rass_mav.lab.experiment.declaration import HAND_ON, Extent
from rass_mav.lab.hostile.kinds import KINDS

from .test_commands import asked, check_files, promised, table


@pytest.mark.no_cover
def test_every_attacker_meets_every_policy_in_every_place_with_and_without_keys() -> None:
    planned = hostile.experiment(leaves=200).plan(Extent(2, 500))
    assert len(planned) == 2 * (1 + len(KINDS)) * len(HAND_ON) * 2 * 3
    for _, run in planned:
        variant, place = run.variant.split("-")
        there = [(each.kind, each.near, each.begin, each.end) for each in run.scenario.hostile]
        beside = (run.world, hostile.PLACES[place], hostile.ATTACK, 200)
        assert there == ([] if run.world == hostile.NOBODY else [beside])
        keys, captured = hostile.VARIANTS[variant]
        assert run.scenario.keys is keys
        assert all(each.captured is captured for each in run.scenario.hostile)


@pytest.mark.no_cover
def test_what_an_attacker_has_done_ends_when_it_has_left(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    left = hostile.ATTACK + 10
    asked(
        capsys, "hostile", "--out", str(tmp_path), "--runs", "1", "--attacker", "nobody", "impostor", "--place", "base",
        "--policy", "survival", "--leaves", str(left), "--jobs", "1", "--steps", str(left + hostile.HEALED + 50),
        "--set", f"data.until_step={left + hostile.HEALED + 11}", "--set", "nodes=9",
    )  # fmt: skip
    found = {(row["attacker"], row["variant"]): row for row in table(tmp_path / "table.csv")[1]}
    assert {row["place"] for row in found.values()} == {"base"}
    honest, visited = found["nobody", "open"], found["impostor", "open"]
    assert float(visited["delay_after_mean"]) == pytest.approx(float(honest["delay_after_mean"]), abs=1)
    assert {row[period] for row in (honest, visited) for period in ("before_mean", "after_mean")} == {"1.0"}
    assert float(visited["late_mean"]) == float(visited["lost_mean"]) == float(visited["false_losses_mean"]) == 0.0


@pytest.mark.usefixtures("pixels")
def test_a_stranger_costs_nothing_where_links_are_signed(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """With one copy, so that every datum that somebody is made to delete is lost."""
    summary = asked(
        capsys, "hostile", "--out", str(tmp_path), "--runs", "1", "--attacker", "nobody", "sinkhole", "--policy",
        "survival", "--place", "middle", "--jobs", "1", "--steps", str(hostile.ATTACK + 60),
        "--set", "custody.replicas=false", "--set", "nodes=16", "--set", f"data.until_step={hostile.ATTACK + 40}",
    )  # fmt: skip
    check_files(tmp_path, summary, pixels=True)
    columns, rows = table(tmp_path / "table.csv")
    assert columns == promised("hostile")
    found = {(row["attacker"], row["variant"]): row for row in rows}
    assert len(found) == 6
    assert float(found["sinkhole", "open"]["unfounded_mean"]) > 0.0
    for of_nobody, of_sinkhole in ((found["nobody", v], found["sinkhole", v]) for v in ("open", "signed")):
        assert float(of_nobody["unfounded_mean"]) == 0.0
        assert float(of_nobody["delivered_mean"]) == 1.0
        assert of_sinkhole["variant"] == "open" or of_sinkhole["delivered_mean"] == of_nobody["delivered_mean"]
    assert float(found["sinkhole", "captured"]["unfounded_mean"]) > 0.0

"""`rass-mav experiment hostile`: which runs, and what is written."""

from __future__ import annotations

from pathlib import Path

import pytest

from rass_mav.cli import main
from rass_mav.experiment import hostile
from rass_mav.experiment.runs import Extent

from .test_commands import asked, check_files, table


def test_every_attacker_meets_every_policy_with_and_without_keys() -> None:
    planned = hostile.plan(Extent(2, 500), hostile.ATTACKERS, hostile.POLICIES, list(hostile.VARIANTS))
    assert len(planned) == 2 * len(hostile.ATTACKERS) * len(hostile.POLICIES) * 3
    for run in planned:
        there = [(each.kind, each.begin, each.end) for each in run.scenario.hostile]
        assert there == ([] if run.world == hostile.NOBODY else [(run.world, hostile.ATTACK, None)])
        keys, captured = hostile.VARIANTS[run.variant]
        assert run.scenario.keys is keys
        assert all(each.captured is captured for each in run.scenario.hostile)


def test_a_stranger_costs_nothing_where_links_are_signed(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """With one copy, so that every datum that somebody is made to delete is lost."""
    summary = asked(
        capsys, "hostile", "--out", str(tmp_path), "--runs", "1", "--attacker", "nobody", "sinkhole", "--policy",
        "survival", "--jobs", "1", "--steps", str(hostile.ATTACK + 30), "--set", "custody.mirror=false",
        "--set", f"data.until_step={hostile.ATTACK + 10}",
    )  # fmt: skip
    check_files(tmp_path, summary)
    columns, rows = table(tmp_path / "table.csv")
    assert tuple(columns) == hostile.TABLE_COLUMNS
    found = {(row["attacker"], row["variant"]): row for row in rows}
    assert len(found) == 6
    assert float(found["sinkhole", "open"]["unfounded_mean"]) > 0.0
    for of_nobody, of_sinkhole in ((found["nobody", v], found["sinkhole", v]) for v in ("open", "signed")):
        assert float(of_nobody["unfounded_mean"]) == 0.0
        assert float(of_nobody["delivered_mean"]) == 1.0
        assert of_sinkhole["variant"] == "open" or of_sinkhole["delivered_mean"] == of_nobody["delivered_mean"]
    assert float(found["sinkhole", "captured"]["unfounded_mean"]) > 0.0


def test_an_attacker_that_is_none_is_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["experiment", "hostile", "--out", str(tmp_path), "--attacker", "friend"]) == 2
    assert "--attacker: expected some of nobody, sinkhole" in capsys.readouterr().err

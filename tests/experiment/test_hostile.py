"""`rass-mav experiment hostile`: which runs, and what is written."""

from __future__ import annotations

from pathlib import Path

import pytest

from rass_mav.cli import main
from rass_mav.experiment import hostile
from rass_mav.experiment.measures import ATTACK
from rass_mav.experiment.runs import Extent

from .test_commands import asked, check_files, table


def test_every_attacker_meets_every_policy_with_and_without_spare_copies() -> None:
    planned = hostile.plan(Extent(2, 500), hostile.ATTACKERS, hostile.POLICIES, list(hostile.VARIANTS))
    assert len(planned) == 2 * len(hostile.ATTACKERS) * len(hostile.POLICIES) * 2
    for run in planned:
        there = [(each.kind, each.begin, each.end) for each in run.scenario.hostile]
        assert there == ([] if run.world == hostile.NOBODY else [(run.world, *ATTACK)])
        assert run.scenario.custody.mirror is hostile.VARIANTS[run.variant]


def test_what_a_sinkhole_takes_is_healed_from_spares_and_told_where_there_are_none(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    summary = asked(
        capsys, "hostile", "--out", str(tmp_path), "--runs", "1", "--attacker", "nobody", "sinkhole", "--policy",
        "survival", "--jobs", "1", "--steps", "420",
    )  # fmt: skip
    check_files(tmp_path, summary)
    columns, rows = table(tmp_path / "table.csv")
    assert tuple(columns) == hostile.TABLE_COLUMNS
    found = {(row["attacker"], row["variant"]): row for row in rows}
    assert len(found) == 4
    for attacker in ("nobody", "sinkhole"):
        assert float(found[attacker, "mirrors"]["delivered_mean"]) >= 0.99
    healed, lost = found["sinkhole", "mirrors"], found["sinkhole", "one-copy"]
    # The thief is found out before it leaves.
    assert 0.0 < float(healed["late_mean"]) < 0.1
    # Some spare may have had to go for want of room.
    assert float(healed["healed_mean"]) >= 0.9 * float(healed["late_mean"])
    assert float(lost["unfounded_mean"]) > 0.1
    assert float(lost["noticed_mean"]) > 1
    assert "unconfirmed" in (tmp_path / "table.md").read_text(encoding="utf-8")


def test_an_attacker_that_is_none_is_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["experiment", "hostile", "--out", str(tmp_path), "--attacker", "friend"]) == 2
    assert "--attacker: expected some of nobody, sinkhole" in capsys.readouterr().err

"""`rass-mav experiment ablation`: which runs, and what is written."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import pytest

from rass_mav.core.settings import Mechanism
from rass_mav.lab.experiment import ablation
from rass_mav.lab.experiment.declaration import Extent
from rass_mav.lab.experiment.runner import Run
from rass_mav.lab.swarm.scenario import load_scenario

from .test_commands import SMALL, asked, check_files, promised, table


def plan(extent: Extent, air: str, topology: str, *off: str) -> list[Run]:
    chosen = {"air": [air], "topology": [topology], "off": off}
    return [run for _, run in ablation.experiment().plan(extent, chosen)]


def test_each_part_is_switched_off_alone_and_all_together() -> None:
    mechanisms = [name for name in get_args(Mechanism) if name != "receipts"]
    planned = plan(Extent(1, 9), "none", "grid", *ablation.SWITCHES)
    assert [run.scenario.without for run in planned if run.variant in mechanisms] == [(name,) for name in mechanisms]
    found = {
        run.variant: (s.policy.name, s.node.forward, s.custody.replicas, "receipts" not in s.without)
        for run in planned
        if run.variant not in mechanisms
        for s in [run.scenario]
    }
    assert found == {
        "nothing": ("survival", "immediate", None, True),
        "policy": ("hop-count", "immediate", None, True),
        "immediate": ("survival", "step", None, True),
        "mirror": ("survival", "immediate", False, True),
        "receipts": ("survival", "immediate", None, False),
        "everything": ("hop-count", "step", False, False),
    }


def test_each_place_and_air_that_go_together_can_be_run() -> None:
    planned = ablation.experiment().plan(
        Extent(1, 400), {"air": [*ablation.ALL_AIRS], "topology": [*ablation.PLACES], "off": [ablation.NOTHING]}
    )
    found = {(case["topology"], case["air"]): run.scenario for case, run in planned}
    assert found["blast", "none"].failures.blast == 250
    assert found["dying", "sik-64k"].failures.die_fraction == 0.1
    assert [air for place, air in found if place == "field"] == ["wifi-6m", "wifi-1m"]


def test_with_nothing_off_it_is_the_product_as_it_comes() -> None:
    (run,) = plan(Extent(1, 500, first_seed=1), "none", "grid", ablation.NOTHING)
    assert run.scenario == load_scenario("demo")
    (run,) = plan(Extent(1, 500, first_seed=1), "none", "islands", ablation.NOTHING)
    assert run.scenario == load_scenario("islands")


def test_the_command_from_end_to_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    summary = asked(
        capsys, "ablation", "--out", str(tmp_path), "--air", "none", "--topology", "grid", "--off", "nothing", "policy",
        "everything", *SMALL,
    )  # fmt: skip
    assert (summary["done"], summary["reused"]) == (6, 0)
    check_files(tmp_path, summary)
    columns, rows = table(tmp_path / "table.csv")
    assert columns == promised("ablation")
    assert [(row["air"], row["topology"], row["off"]) for row in rows] == [
        ("none", "grid", name) for name in ("nothing", "policy", "everything")
    ]
    nothing, _, everything = rows
    assert (nothing["reliability_over_defaults_mean"], nothing["delivered_over_defaults_high"]) == ("0.0", "0.0")
    more = float(everything["reliability_mean"]) - float(nothing["reliability_mean"])
    assert float(everything["reliability_over_defaults_mean"]) == pytest.approx(more, abs=2e-6)
    assert more < -0.05
    assert "## grid, air none\n" in (tmp_path / "table.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("air", ablation.ALL_AIRS)
def test_each_air_is_that_of_its_preset(air: str) -> None:
    (run,) = plan(Extent(1, 9), air, "random-walk", "policy")
    radio = run.scenario.radio
    assert (run.world, radio.preset, radio.takes_time) == (air, None if air == "none" else air, air != "none")

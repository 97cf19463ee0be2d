"""The store of what arrives in a mock swarm."""

from __future__ import annotations

from pathlib import Path

import pytest

from rass_mav.errors import ConfigError
from rass_mav.ground.archive import Archive
from rass_mav.ground.report import Report
from rass_mav.lab.swarm.harvest import Harvest
from rass_mav.lab.swarm.scenario import load_scenario
from rass_mav.lab.swarm.world import World
from tests.commands import json_output, output
from tests.some import some

BEGAN = 1_795_341_600.0


@pytest.mark.no_cover
def test_it_has_what_has_arrived_at_any_base_with_dates(tmp_path: Path) -> None:
    world = World(load_scenario("demo", {"nodes": 12, "bases": 2, "data.status_s": 10.0}))
    harvest = Harvest(tmp_path / "swarm.db", world, 2, BEGAN)
    for _ in range(60):
        world.step()
        harvest.gather()
    harvest.close()
    arrived = {id for store in world.stores[:2] for id in store.ids()}
    with Archive(tmp_path / "swarm.db", now=lambda: BEGAN + 60 * world.step_s) as archive:
        entries = list(archive.entries())
        report = Report.of(archive)
    assert {entry.id for entry in entries} == arrived
    assert len(entries) == len(arrived) > 0
    for entry in entries:
        assert entry.dated
        assert BEGAN <= entry.utc <= some(entry.arrived) <= BEGAN + 60 * world.step_s + 0.01
    assert {entry.id.origin for entry in entries if entry.status is not None and entry.status.base} == {0, 1}
    assert sum(drone.arrived for drone in report.drones.values()) == len(entries)


def test_a_file_that_is_there_stays(tmp_path: Path) -> None:
    (tmp_path / "swarm.db").write_text("mine")
    with pytest.raises(ConfigError, match="already exists"):
        Harvest(tmp_path / "swarm.db", World(load_scenario("demo", {"nodes": 2, "topology": "line"})), 1, BEGAN)
    assert (tmp_path / "swarm.db").read_text() == "mine"


@pytest.mark.no_cover
def test_the_command_keeps_what_report_reads(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store = tmp_path / "swarm.db"
    summary = json_output(capsys, "swarm", "demo", "--nodes", "16", "--steps", "40", "--store", str(store))
    report = json_output(capsys, "report", str(store))
    assert report["arrived"] == summary["delivered"] > 0


def test_processes_have_stores_of_their_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "--keep" in output(capsys, "swarm", "--transport", "udp", "--store", str(tmp_path / "swarm.db"), code=2).err

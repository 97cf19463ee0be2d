"""A base starts the next mission with an empty store, by the command in the runbook."""

from __future__ import annotations

import json
import re
import signal
import subprocess
from pathlib import Path
from typing import Any

import pytest

from .app_nodes import Tidy, command, line_of

RUNBOOK = Path(__file__).parents[2] / "docs/how-to/runbook.md"


def report(directory: Path, store: str) -> Any:
    return json.loads(command(directory, "report", store, "--json").stdout)


@pytest.mark.parametrize("kept", [False, True], ids=["moved", "kept"])
def test_the_next_mission_lists_only_its_own_drones(tmp_path: Path, kept: bool, tidy: Tidy) -> None:
    base, drone = (tidy(node) for node in line_of(tmp_path, [1, 7], store={}))
    base.start()
    drone.start()
    first = json.loads(command(tmp_path, "put", "-c", drone.config, "--line", "first", "--wait", "--json").stdout)
    assert first["id"] in base.listing()
    for node in (base, drone):
        assert node.signal(signal.SIGTERM) == 0

    if not kept:
        [move] = re.findall(r"^    (mkdir mission-1 && mv .*)$", RUNBOOK.read_text(encoding="utf-8"), re.MULTILINE)
        subprocess.run(move.replace("rass-1.db", "n1.db"), shell=True, cwd=tmp_path, check=True)
    base.start()
    new = report(tmp_path, base.config)
    assert [one["drone"] for one in new["drones"]] == ([7] if kept else [])
    if not kept:
        assert report(tmp_path, "mission-1/n1.db")["arrived"] == 1
        drone.start()
        again = json.loads(command(tmp_path, "put", "-c", drone.config, "--line", "next", "--wait", "--json").stdout)
        assert set(base.listing()) == {again["id"]}, "what has arrived in the old store stays there"

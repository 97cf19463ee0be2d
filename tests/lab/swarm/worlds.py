"""Mock swarms for tests."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

from rass_mav.config.loading import convert
from rass_mav.lab.swarm.invariants import check
from rass_mav.lab.swarm.scenario import Scenario
from rass_mav.lab.swarm.world import World
from tests.environment import environment


def scenario(**keys: Any) -> Scenario:
    return convert(keys, Scenario, "test")


def world_of(**keys: Any) -> World:
    return World(scenario(**keys))


def run(**keys: Any) -> World:
    """All its steps, with the invariants checked after each."""
    world = world_of(**keys)
    world.run(world.scenario.steps, after=check)
    return world


def summary_of(**keys: Any) -> dict[str, Any]:
    """Of such a run."""
    return run(**keys).statistics.summary()


def in_a_process(*arguments: str, hash_seed: str = "0") -> dict[str, Any]:
    """The summary of `swarm`, without what differs from run to run."""
    done = subprocess.run(
        [sys.executable, "-m", "rass_mav", "swarm", "--json", *arguments],
        env=environment(PYTHONHASHSEED=hash_seed), capture_output=True, text=True, check=True,
    )  # fmt: skip
    summary: dict[str, Any] = json.loads(done.stdout)
    assert min(summary.pop(key) for key in ("wall_s", "cpu_s", "robot_steps_per_s")) > 0
    return summary

"""How long a swarm takes: by the clock on the wall, and in processor time."""

from __future__ import annotations

import resource
import time
from typing import Any


class Stopwatch:
    """Runs from when it is made."""

    def __init__(self) -> None:
        self._wall = time.perf_counter()
        self._cpu = _processor_s()

    def figures(self, robot_steps: int) -> dict[str, Any]:
        """For the summary. `robot_steps`: how many steps of one node were taken."""
        wall = time.perf_counter() - self._wall
        cpu = _processor_s() - self._cpu
        return {
            "wall_s": round(wall, 3),
            "cpu_s": round(cpu, 3),
            "robot_steps_per_s": round(robot_steps / cpu) if cpu else 0,
        }


def _processor_s() -> float:
    """Of this process and of its children that have ended, and theirs, in user and system mode."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in used)

"""How long the estimate of sources takes: `python -m benchmarks.sources`."""

from __future__ import annotations

import math
import random
import time

from benchmarks.tables import spread, table
from rass_mav.ground.field import DEGREE_M
from rass_mav.ground.sources.estimate import estimate
from rass_mav.ground.sources.readings import MOST_READINGS, Sample

ROUNDS = 3
#: How many readings, and of how many sources.
CASES = [(300, 3), (3000, 0), (3000, 3), (3000, 5), (MOST_READINGS, 3), (MOST_READINGS, 5)]
_SOURCES = [
    (-120.0, 60.0, 3e3), (90.0, -110.0, 2e4), (150.0, 120.0, 8e3), (-60.0, -90.0, 5e3), (20.0, 40.0, 1e4),
]  # fmt: skip


def survey(readings: int, sources: int) -> list[Sample]:
    """Of twelve drones over 500 m x 400 m, at random places."""
    rng = random.Random(1)
    samples = []
    for n in range(readings):
        x, y = rng.uniform(-250.0, 250.0), rng.uniform(-200.0, 200.0)
        rate = 0.1 + sum(s / ((x - sx) ** 2 + (y - sy) ** 2 + 100.0) for sx, sy, s in _SOURCES[:sources])
        counts = round(max(0.0, rng.gauss(rate * 1.77, math.sqrt(rate * 1.77))))
        samples.append(Sample(n % 12, float(n // 12), y / DEGREE_M, x / DEGREE_M, 10.0, counts / 1.77, 3.0))
    return samples


def measure() -> dict[str, dict[str, list[float]]]:
    """Seconds of processor time of each estimate, and how many sources it found. numpy is loaded before."""
    found: dict[str, dict[str, list[float]]] = {}
    for readings, sources in CASES:
        samples = survey(readings, sources)
        for _ in range(ROUNDS):
            begin = time.process_time()
            estimated = estimate("usvh", samples)
            spent = round(time.process_time() - begin, 3)
            one = found.setdefault(f"{readings:,} | {sources}", {"found": [], "s": []})
            one["found"].append(len(estimated.sources))
            one["s"].append(spent)
    return found


def show(results: dict[str, dict[str, list[float]]]) -> str:
    """The table."""
    rows = [[name, f"{one['found'][0]:.0f}", spread(one["s"], 2)] for name, one in results.items()]
    return table(["readings | sources", "found", "processor time, s"], rows).replace("| --- |", "| --- | --- |", 1)


def main() -> None:
    """Measure and print."""
    print(show(measure()))


if __name__ == "__main__":
    main()

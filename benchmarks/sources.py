"""How long the estimate of sources takes: `python -m benchmarks.sources`."""

from __future__ import annotations

import math
import random
import time

from rass_mav.ground.field import DEGREE_M
from rass_mav.ground.sources.estimate import estimate
from rass_mav.ground.sources.readings import MOST_READINGS, Sample

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


def main() -> None:
    """Processor time and wall time of an estimate."""
    print("| readings | sources | found | processor, s | wall, s |\n| --- | --- | --- | --- | --- |")
    for readings in (300, 3000, MOST_READINGS):
        for sources in (0, 1, 3, 5):
            samples = survey(readings, sources)
            wall, processor = time.perf_counter(), time.process_time()
            found = estimate("usvh", samples)
            wall, processor = time.perf_counter() - wall, time.process_time() - processor
            print(f"| {readings} | {sources} | {len(found.sources)} | {processor:.2f} | {wall:.2f} |")


if __name__ == "__main__":
    main()

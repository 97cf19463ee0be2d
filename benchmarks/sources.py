"""How long the estimate of sources takes: `python -m benchmarks.sources`.

    python -m benchmarks.sources --page SECONDS     how soon the page shows what arrives, with five sources

For that a reading arrives every 0.6 s at a store with 9,800 of them, and the page of that store is asked for its
events.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import math
import random
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.tables import spread, table
from rass_mav.core.datum import Kind
from rass_mav.ground.field import DEGREE_M
from rass_mav.ground.sources.estimate import estimate
from rass_mav.ground.sources.readings import MOST_READINGS, Sample
from rass_mav.wire.measurement import Measurement, encode_measurement
from tests.ground.missions import Base
from tests.ground.page.serving import events, serving

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


async def on_page(seconds: float) -> None:
    """Print how long it took until an estimate with a reading was on the page."""
    samples = survey(MOST_READINGS, 5)
    before = MOST_READINGS - 200
    with TemporaryDirectory() as folder:
        base = Base(Path(folder) / "base.db", wall=time.time() - 30.0)

        def arrive(*numbers: int) -> None:
            base.arrive(
                *(
                    base.datum(2 + number % 12, number, Kind.MEASUREMENT, _payload(samples[number]))
                    for number in numbers
                )
            )

        arrive(*range(before))
        begun: dict[int, float] = {}

        async def fly() -> None:
            for number in range(before, before + min(199, int(seconds / 0.6))):
                base.wall = time.time()
                arrive(number)
                begun[number + 1] = time.monotonic()
                await asyncio.sleep(0.6)

        delays: list[float] = []
        async with serving(base.path) as (_, client):
            news = events(client.session, str(client.make_url("/api/events")))
            flight: asyncio.Task[None] | None = None
            async for kind, data in news:
                found = json.loads(data)["sources"]["estimate"] if kind == "sources" else None
                if found is None or found["readings"] < before:
                    continue
                flight = flight or asyncio.create_task(fly())
                now = time.monotonic()
                delays += [now - begun.pop(count) for count in list(begun) if count <= found["readings"]]
                if flight.done() and not begun:
                    break
            await news.aclose()
        base.close()
    delays.sort()
    middle, most = delays[len(delays) // 2], delays[len(delays) * 95 // 100]
    print(f"{len(delays)} readings on the page: median {middle:.2f} s, 95 % {most:.2f} s, worst {delays[-1]:.2f} s")


def _payload(sample: Sample) -> bytes:
    return encode_measurement(
        Measurement(sample.latitude, sample.longitude, sample.altitude, sample.value, 0.0, unit="usvh", error_m=6.0)
    )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--page", type=float, metavar="SECONDS", help="how soon the page shows what arrives")
    options = parser.parse_args()
    if options.page is not None:
        asyncio.run(on_page(options.page))
        return
    print(show(measure()))


if __name__ == "__main__":
    main()

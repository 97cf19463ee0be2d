"""How long a base takes to catch up with a drone that returns with a full store, on each radio of the mock swarm.

    python -m benchmarks.catch_up           the table in docs/how-to/capacity.md
    python -m benchmarks.catch_up --json    one JSON object
    python -m benchmarks.catch_up --five sik-64k 1    files of five drones, with another step

A base, and one drone or five beside it that come with data and create none. They have the product's defaults, and on
Wi-Fi `data: unicast`. Time is that of the mock swarm, so it is the same on every machine. A rate is counted from the
first datum that arrives: the time that a drone and a base take to find each other is left out.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from typing import Any, NamedTuple

from rass_mav.app.endurance import in_words
from rass_mav.config.loading import convert
from rass_mav.core.settings import StoreSettings
from rass_mav.lab.swarm.scenario import Scenario
from rass_mav.lab.swarm.world import World

READING_BYTES, PART_BYTES = 23, 32 * 1024
_UNICAST = {"mac": "unicast", "overhear": False}


class Case(NamedTuple):
    """A radio, and what the drones bring."""

    preset: str
    step_s: float
    """As in the scenarios of docs/evaluation/simulation.md."""
    bandwidth: int
    """`store.bandwidth_items`."""
    readings: int
    """Of each drone."""
    parts: int
    """Of files, of one drone; 0: not measured."""


CASES = (
    Case("wifi-6m", 1.0, 20, 1000, 64),
    Case("wifi-6m", 1.0, 200, 4000, 0),
    Case("wifi-1m", 1.0, 20, 1000, 64),
    Case("esp-now", 2.0, 20, 400, 8),
    Case("sik-250k", 2.0, 20, 400, 8),
    Case("sik-64k", 5.0, 20, 400, 8),
    Case("lora", 10.0, 20, 400, 8),
)
#: Data that a full store of the default size holds, and those of a day with the default interval.
FULL, DAY = StoreSettings().most_items, 8640
PICTURE_BYTES = 4_000_000
#: A run ends after so many steps, whatever has arrived.
MOST_STEPS = 1800


class Found(NamedTuple):
    """What has arrived at the base."""

    data: int
    steps: int
    """Until all had arrived, or the run ended."""
    rate: float
    """Data a second."""


def run(case: Case, drones: int, count: int, size: int) -> Found:
    """`drones` drones bring `count` data of `size` bytes each."""
    radio: dict[str, Any] = {"preset": case.preset, "range_m": 300.0}
    world = World(
        convert(
            {
                "nodes": drones + 1, "topology": "positions", "node": {"step_s": case.step_s},
                "mobility": {"positions": [[0, 0]] + [[10 * each, 10] for each in range(1, drones + 1)]},
                "radio": radio | (_UNICAST if case.preset.startswith("wifi") else {}),
                "radiation": {"sources": []}, "data": {"interval_steps": 0},
                "store": {"capacity_items": None, "bandwidth_items": case.bandwidth},
            },
            Scenario, "catch_up",
        )
    )  # fmt: skip
    for agent in world.agents[1:]:
        for _ in range(count):
            agent.node.put(b"\xff" * size, 0.0)
    arrived, steps, before, begun = world.ledger.arrived, 0, 0, 0
    while len(arrived) < count * drones and steps < MOST_STEPS:
        world.run(1)
        steps += 1
        if not before and arrived:
            before, begun = len(arrived), steps
    return Found(len(arrived), steps, (len(arrived) - before) / max(1, steps - begun) / case.step_s)


def measure(case: Case) -> dict[str, float | None]:
    """Readings a second of one drone and of five, and parts a second of one."""
    return {
        "readings": run(case, 1, case.readings, READING_BYTES).rate,
        "readings_of_five": run(case, 5, case.readings, READING_BYTES).rate,
        "parts": run(case, 1, case.parts, PART_BYTES).rate if case.parts else None,
    }


def two_digits(number: float) -> str:
    """Rounded for people."""
    return f"{float(f'{number:.2g}'):g}"


def row(case: Case, found: dict[str, float | None]) -> str:
    """A row of the table."""
    readings, five, parts = (found[key] for key in ("readings", "readings_of_five", "parts"))
    assert readings is not None
    assert five is not None
    radio = f"`{case.preset}`" + ("" if case.bandwidth == 20 else f", `bandwidth_items: {case.bandwidth}`")
    kilobytes = "" if parts is None else two_digits(parts * PART_BYTES / 1000)
    picture = "" if parts is None else in_words(PICTURE_BYTES / PART_BYTES / parts)
    cells = (
        radio, f"{case.step_s:g} s", two_digits(readings), two_digits(five), in_words(DAY / readings),
        in_words(FULL / readings), kilobytes, picture,
    )  # fmt: skip
    return f"| {' | '.join(cells)} |"


def main(arguments: Sequence[str] | None = None) -> int:
    """The program."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--json", action="store_true", help="one JSON object")
    parser.add_argument(
        "--five", nargs=2, metavar=("PRESET", "STEP"), help="eight parts of files of each of five drones"
    )
    options = parser.parse_args(arguments)
    if options.five:
        preset, step_s = options.five[0], float(options.five[1])
        five = run(Case(preset, step_s, 20, 0, 8), 5, 8, PART_BYTES)
        print(f"{five.data} of 40 parts arrived in {in_words(five.steps * step_s)}")
        return 0
    found = {case: measure(case) for case in CASES}
    if options.json:
        print(json.dumps({f"{case.preset}/{case.bandwidth}": each for case, each in found.items()}))
        return 0
    for case, each in found.items():
        print(row(case, each).replace("|  |", "| |").replace("|  |", "| |"))
    return 0


if __name__ == "__main__":
    sys.exit(main())

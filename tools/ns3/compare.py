"""The simulated Wi-Fi against ns-3: the same radios, the same frames at the same times, in both.

Each cell of the table is a place, how often each radio gets a frame, whether frames are for all or for one neighbour,
and what becomes of frames that overlap. `--ours` runs our half alone, without ns-3.
"""

from __future__ import annotations

import argparse
import random
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rass_mav.config.loading import convert
from rass_mav.core.messages import BROADCAST
from rass_mav.lab.medium.channel import Csma, Order, Timeline
from rass_mav.lab.medium.neighbours import Position, RangeGraph, Reach
from rass_mav.lab.medium.settings import RadioSection
from rass_mav.link.budget import FRAME_BYTES

RANGE_M, APART_M = 10.0, 9.0
#: What ns-3 does with frames that overlap, by our `radio.capture`.
OVERLAP = {"first": "physics", "none": "fragile"}
PACKAGES = ("ns3-wifi", "ns3-mobility", "ns3-network", "ns3-propagation", "ns3-core")


def line(nodes: int) -> list[Position]:
    """Each radio hears only the next ones: those on both sides of a radio are hidden from each other."""
    return [(APART_M * index, 0.0) for index in range(nodes)]


def grid(side: int) -> list[Position]:
    """Each radio hears up to four others."""
    return [(APART_M * x, APART_M * y) for x in range(side) for y in range(side)]


def crowd(nodes: int) -> list[Position]:
    """All hear each other."""
    return [(0.1 * index, 0.0) for index in range(nodes)]


#: By name: where the radios are, and for how long they get frames, seconds.
PLACES = {
    "line of 3": (line(3), 200.0),
    "line of 5": (line(5), 120.0),
    "grid of 10 x 10": (grid(10), 15.0),
    "10 in range": (crowd(10), 1.0),
    "20 in range": (crowd(20), 1.0),
}


@dataclass(frozen=True)
class Frame:
    """A frame that a radio gets to send."""

    at: float
    """Seconds."""
    sender: int
    target: int
    """BROADCAST: all."""
    hearers: Sequence[int]
    """Who should receive it."""


@dataclass(frozen=True)
class Cell:
    """What is compared."""

    place: str
    per_s: float | None
    """Frames a second and radio, in a Poisson process; None: each always has one that waits."""
    mac: str
    capture: str
    preset: str = "wifi-1m"

    def frames(self, seconds: float | None = None, seed: int = 1) -> list[Frame]:
        """The frames, by time. `seconds`: None: as long as the place says."""
        places, usual_s = PLACES[self.place]
        rng = random.Random(f"{self.place}:{self.per_s}:{seed}")
        times = [(at, sender) for sender in range(len(places)) for at in self._times(seconds or usual_s, rng)]
        neighbours = RangeGraph(places, RANGE_M).neighbours
        frames = []
        for at, sender in sorted(times):
            hearers = neighbours[sender]
            target = rng.choice(hearers) if self.mac == "unicast" else BROADCAST
            frames.append(Frame(at, sender, target, hearers if target == BROADCAST else [target]))
        return frames

    def _times(self, seconds: float, rng: random.Random) -> Iterator[float]:
        if self.per_s is None:
            # Not all at the same time, so that each has a datagram of its own.
            yield from (1e-7 * (number + rng.random()) for number in range(int(1000 * seconds)))
            return
        at = rng.expovariate(self.per_s)
        while at < seconds:
            yield at
            at += rng.expovariate(self.per_s)

    @property
    def queue(self) -> int:
        """Frames that may wait in a radio."""
        return 65536 // FRAME_BYTES if self.per_s is not None else 10**6


#: When frames arrive, by number of the frame and hearer, seconds.
Arrivals = dict[tuple[int, int], float]


def ours(cell: Cell, frames: Sequence[Frame]) -> Arrivals:
    """Send the frames in the simulated medium."""
    places, _ = PLACES[cell.place]
    keys: dict[str, Any] = {
        "range_m": RANGE_M, "preset": cell.preset, "mac": cell.mac, "capture": cell.capture, "overhear": False,
        "queue_bytes": FRAME_BYTES * cell.queue,
    }  # fmt: skip
    settings = convert(keys, RadioSection, "radio")
    reach = Reach(settings, 1)
    reach.update(RangeGraph(places, RANGE_M).neighbours, places)
    arrivals: Arrivals = {}

    def hear(hearers: Sequence[int], sender: int, frame: bytes, since: float, now: float) -> None:
        number = int.from_bytes(frame[:4], "big")
        arrivals.update(((number, hearer), now) for hearer in hearers)

    timeline = Timeline()
    medium = Csma(
        settings, timeline, reach, hear, stations=len(places), step_s=1.0, rng=random.Random(1), record=None
    )  # fmt: skip
    for number, frame in enumerate(frames):
        content = number.to_bytes(4, "big") + bytes(FRAME_BYTES - 4)

        def send(now: float, frame: Frame = frame, content: bytes = content) -> None:
            medium.send(frame.sender, content, now, now, frame.target)

        timeline.at(frame.at, Order.TURN, send)
    timeline.run(float("inf"))
    return arrivals


def build(folder: Path) -> Path:
    """Compile the program for ns-3 (Debian's packages libns3-dev, libgsl-dev and g++)."""
    program = folder / "air"
    flags = subprocess.run(
        ["pkg-config", "--cflags", "--libs", *PACKAGES], check=True, capture_output=True, text=True
    ).stdout
    source = Path(__file__).with_name("air.cc")
    subprocess.run(["g++", "-O2", "-std=c++17", str(source), "-o", str(program), *shlex.split(flags)], check=True)
    return program


def theirs(program: Path, cell: Cell, frames: Sequence[Frame]) -> Arrivals:
    """Send the frames in ns-3."""
    places, _ = PLACES[cell.place]
    told = [str(len(places)), *(f"{x} {y}" for x, y in places)]
    told += [f"{f.at:.9f} {f.sender} {-1 if f.target == BROADCAST else f.target} {FRAME_BYTES}" for f in frames]
    done = subprocess.run(
        [
            str(program), f"--phy={cell.preset.removeprefix('wifi-')}", f"--overlap={OVERLAP[cell.capture]}",
            f"--range={RANGE_M}", f"--queue={cell.queue}",
        ],
        input="\n".join(told), check=True, capture_output=True, text=True,
    )  # fmt: skip
    lines = (line.split() for line in done.stdout.splitlines())
    return {(int(number), int(hearer)): float(now) for number, hearer, now in lines}


@dataclass(frozen=True)
class Outcome:
    """How a cell ended."""

    received: float
    """The share of what should have been received, 0..1."""
    p95_s: float
    """The delay that 95 % of it do not exceed, from the time at which the radio got it, seconds."""


def outcome(*runs: tuple[Sequence[Frame], Arrivals]) -> Outcome:
    """Count what has arrived in all runs."""
    delays = sorted(now - frames[number].at for frames, arrivals in runs for (number, _), now in arrivals.items())
    due = sum(len(frame.hearers) for frames, _ in runs for frame in frames)
    return Outcome(len(delays) / due, delays[int(0.95 * len(delays))] if delays else float("inf"))


#: Frames a second and radio, where they come at random times.
RATES = (5.0, 10.0, 20.0, 40.0, 60.0)
MACS, CAPTURES = ("broadcast", "unicast"), ("first", "none")


def rows(macs: Sequence[str], captures: Sequence[str]) -> Iterator[list[Cell]]:
    """The rows of the table: frames at random times (`wifi-1m`), then radios that always have one (`wifi-6m`)."""
    for mac in macs:
        for capture in captures:
            for place in ("line of 3", "line of 5", "grid of 10 x 10"):
                yield [Cell(place, per_s, mac, capture) for per_s in RATES]
    for mac in macs:
        for place in ("10 in range", "20 in range"):
            yield [Cell(place, None, mac, "none", "wifi-6m")]


class Comparison:
    """Runs cells, and counts how near both halves are."""

    def __init__(self, program: Path | None, runs: int, seconds: float | None) -> None:
        """`program`: None: our half alone."""
        self._program = program
        self._runs = runs
        self._seconds = seconds
        self._beside = ThreadPoolExecutor(1)
        self.cells = self.near = self.close = 0
        """Cells; those with shares within .02, and with delays within 10 %."""

    def run(self, cell: Cell) -> list[Outcome]:
        """Ours, then that of ns-3."""
        runs = [cell.frames(self._seconds, seed) for seed in range(1, self._runs + 1)]
        program = self._program
        waiting = [self._beside.submit(theirs, program, cell, frames) for frames in runs if program is not None]
        outcomes = [outcome(*((frames, ours(cell, frames)) for frames in runs))]
        if waiting:
            outcomes.append(outcome(*((frames, here.result()) for frames, here in zip(runs, waiting, strict=True))))
            mine, other = outcomes
            self.cells += 1
            self.near += abs(mine.received - other.received) <= 0.02
            self.close += abs(mine.p95_s - other.p95_s) <= 0.1 * other.p95_s
        return outcomes


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--ours", action="store_true", help="our half alone")
    parser.add_argument("--mac", nargs="+", choices=MACS, default=MACS)
    parser.add_argument("--capture", nargs="+", choices=CAPTURES, default=CAPTURES)
    parser.add_argument("--seconds", type=float, help="for how long radios get frames")
    parser.add_argument("--runs", type=int, default=1, help="runs of each cell, which are counted together")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        program = None if options.ours else build(Path(folder))
        comparison = Comparison(program, options.runs, options.seconds)
        head = "| mac, capture | place | " + " | ".join(f"{per_s:g} a second" for per_s in RATES) + " |"
        head += "\n" + "|---" * (2 + len(RATES)) + "|"
        print(head)
        delays = [head]
        for row in rows(options.mac, options.capture):
            cell = row[0]
            outcomes = [comparison.run(cell) for cell in row]
            name = f"| {cell.mac}, {cell.capture} | {cell.place}" + (", saturated |" if cell.per_s is None else " |")
            empty = " |" * (len(RATES) - len(row))
            received = (" / ".join(f"{one.received:.3f}" for one in both) for both in outcomes)
            p95 = (" / ".join(f"{1000 * one.p95_s:.1f}" for one in both) for both in outcomes)
            print(name, " | ".join(received), "|" + empty, flush=True)
            delays.append(f"{name} {' | '.join(p95)} |{empty}")
        print("\nThe delay that 95 % do not exceed, ms:\n")
        print("\n".join(delays))
        if program is not None:
            print(f"\nReceived within .02 in {comparison.near} of {comparison.cells} cells,", end=" ")
            print(f"delay within 10 % in {comparison.close}.")
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Pictures over several hops of the mock swarm: how long they take, and what they do to everything else.

    python -m benchmarks.pictures                            20 pictures of 4 MB over 3 hops of wifi-6m
    python -m benchmarks.pictures --beside                   beacons and measurements beside pictures, on two radios
    python -m benchmarks.pictures --pictures 1 --bytes 6000000 --hops 4 --air wifi-1m --loss 0.1 --kill

A line of drones, and the base at its end. The drone at the other end has the pictures, each drone creates a measurement
in each step. The bound is what the air carries over one hop, divided by the hops that have to take turns: neighbours of
a hop that sends can neither send nor hear. Time is that of the mock swarm, so it is the same on every machine.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
from collections.abc import Iterable, Sequence
from itertools import islice, pairwise
from typing import Any

from rass_mav.core.datum import DatumId, Kind
from rass_mav.lab.medium.capacity import one_hop_bytes_s
from rass_mav.lab.swarm.scenario import Scenario, load_scenario
from rass_mav.lab.swarm.world import World
from rass_mav.wire.codec import BEACON, VERSION

PART_BYTES = 32 * 1024
#: Hops that cannot use the air at the same time.
IN_TURN = 3
#: A beacon's head, and where it and the sender are in a frame: behind MAVLink's header and TUNNEL's other fields.
_BEACON, _HEAD = VERSION << 4 | BEACON, 15
#: Steps without a picture before the first one, in which routes form; and for figures of an idle air.
WARM_STEPS, IDLE_STEPS = 20, 200
#: How long a relay that is killed is off, steps.
OFF_STEPS = 5
#: Airs on which everything else is measured beside pictures, and the length of their steps, seconds.
BESIDE = {"wifi-1m": 1.0, "sik-64k": 10.0}


def line(hops: int, air: str, step_s: float, loss: float, seed: int) -> Scenario:
    """The scenario."""
    return load_scenario(
        "demo",
        {
            "nodes": hops + 1, "topology": "line", "seed": seed, "radio.preset": air, "radio.loss": loss,
            "node.step_s": step_s, "data.interval_steps": 1, "radiation.corruption": False,
            "store.capacity_items": 100_000, "store.capacity_bytes": 1 << 30, "store.quota_bytes": 1 << 30,
            # So small that none comes by chance; `Line.kill` needs stores that survive.
            "failures.reboot_rate": 1e-300,
        },
    )  # fmt: skip


class Line(World):
    """Writes down when beacons are heard, and when data are created and arrive, seconds."""

    def __init__(self, scenario: Scenario, part_bytes: int = PART_BYTES) -> None:
        super().__init__(scenario)
        self.part_bytes = part_bytes
        self.sent: dict[int, list[float]] = {}
        """By sender: when a beacon had been sent."""
        self.heard: dict[tuple[int, int], list[float]] = {}
        """By sender and hearer: when a beacon was heard."""
        self.created: dict[DatumId, float] = {}
        self.arrived: dict[DatumId, float] = {}

    def _hear(self, hearers: Sequence[int], frame: bytes, now: float) -> None:
        if frame[_HEAD] == _BEACON:
            sender = int.from_bytes(frame[_HEAD + 1 : _HEAD + 3], "little")
            self.sent.setdefault(sender, []).append(now)
            for hearer in hearers:
                self.heard.setdefault((sender, hearer), []).append(now)
        super()._hear(hearers, frame, now)
        new = len(self.ledger.arrived) - len(self.arrived)
        for id in islice(reversed(self.ledger.arrived), new):
            self.arrived[id] = now

    def _take_turn(self, node_id: int, now: float) -> None:
        super()._take_turn(node_id, now)
        new = len(self.ledger.born) - len(self.created)
        for id in islice(reversed(self.ledger.born), new):
            self.created[id] = now

    def take_pictures(self, pictures: int, size: int) -> list[DatumId]:
        """The last drone takes pictures of random bytes. Returns all parts."""
        rng = random.Random(f"{self.seed}:pictures")
        node, now = self.agents[-1].node, self.t * self.step_s
        parts = []
        for _ in range(pictures):
            left = size
            while left:
                parts.append(node.put(rng.randbytes(min(left, self.part_bytes)), now, Kind.BYTES))
                left -= min(left, self.part_bytes)
        return parts

    def delays(self, begin: float, end: float) -> list[float]:
        """Of the measurements created in this time that arrived, ascending, seconds."""
        return sorted(
            self.arrived[id] - at
            for id, at in self.created.items()
            if begin <= at < end and id in self.arrived and len(self.ledger.payloads[id]) < PART_BYTES // 2
        )


def measure_time(
    scenario: Scenario, pictures: int, size: int, *, part_bytes: int = PART_BYTES, kill: bool, most_steps: int
) -> dict[str, Any]:
    """How long pictures take, against the bound. `kill`: each relay is off once, for `OFF_STEPS`, one after another."""
    hops = scenario.nodes - 1
    world = Line(scenario, part_bytes)
    world.run(WARM_STEPS)
    parts = set(world.take_pictures(pictures, size))
    capacity = one_hop_bytes_s(scenario.radio, PART_BYTES, nodes=min(hops, 2) + 1, step_s=scenario.node.step_s)
    bound_s = pictures * size / (capacity * (1.0 - scenario.radio.loss)) * min(hops, IN_TURN)
    began = world.t * world.step_s
    relays = list(range(1, hops)) if kill else []
    while world.t - WARM_STEPS < most_steps and not parts <= world.arrived.keys():
        if relays and len(parts & world.arrived.keys()) >= len(parts) * (hops - len(relays)) / (hops + 1):
            world.crash(relays.pop(0), world.t + OFF_STEPS)
        world.step()
    there = [world.arrived[id] for id in parts if id in world.arrived]
    took_s = max(there, default=began) - began
    return {
        "parts": len(parts), "arrived": len(there), "altered": world.ledger.altered, "bound_s": round(bound_s, 1),
        "took_s": round(took_s, 1), "ratio": round(took_s / bound_s, 3),
        "bytes_sent_per_byte_and_hop": round(world.air.tally.bytes_sent / (pictures * size * hops), 3),
        **world.air.figures(world.t * world.step_s),
    }  # fmt: skip


def _intervals(series: Iterable[list[float]], begin: float, end: float) -> list[float]:
    """Between two beacons, ascending, seconds."""
    return sorted(
        later - earlier for times in series for earlier, later in pairwise(times) if begin <= earlier and later <= end
    )


def _at(values: Sequence[float], share: float) -> float:
    return round(values[min(int(share * len(values)), len(values) - 1)], 3) if values else 0.0


def measure_beside(air: str, step_s: float, hops: int, seed: int) -> dict[str, dict[str, float]]:
    """Beacons and measurements on an idle air, and beside pictures that never end."""
    scenario = line(hops, air, step_s, 0.0, seed)
    capacity = one_hop_bytes_s(scenario.radio, PART_BYTES, nodes=min(hops, 2) + 1, step_s=step_s)
    results = {}
    for name in ("idle", "pictures"):
        world = Line(scenario)
        world.run(WARM_STEPS)
        if name == "pictures":
            world.take_pictures(1, int(2 * capacity * IDLE_STEPS * step_s))
        begin = (WARM_STEPS + 5) * step_s
        world.run(IDLE_STEPS)
        end = world.t * step_s
        sent = _intervals(world.sent.values(), begin, end)
        heard = _intervals(world.heard.values(), begin, end)
        delays = world.delays(begin, end - 20 * step_s)
        results[name] = {
            "sent_p50": _at(sent, 0.5), "sent_p99": _at(sent, 0.99), "heard_p99": _at(heard, 0.99),
            "delay_p50": _at(delays, 0.5), "delay_p95": _at(delays, 0.95), "measurements": len(delays),
            "goodput": round(sum(
                len(world.ledger.payloads[id]) for id, at in world.arrived.items() if begin <= at < end
            ) / (end - begin) / capacity, 3),
        }  # fmt: skip
    return results


def show_time(result: dict[str, Any]) -> None:
    """Print what `measure_time` has found."""
    print(
        f"{result['arrived']} of {result['parts']} parts there after {result['took_s']:g} s, the bound is "
        f"{result['bound_s']:g} s: {result['ratio']:.2f} times; {result['altered']} altered\n"
        f"bytes on the air for each byte and hop: {result['bytes_sent_per_byte_and_hop']:.2f}; "
        f"{100 * result['collided']:.1f} % of the frames collided"
    )


def show_beside(results: dict[str, dict[str, dict[str, float]]]) -> None:
    """Print what `measure_beside` has found, by radio."""
    print(
        f"{'':<20}{'beacons sent, s':>16}{'heard':>8}{'measurements, s':>17}{'':>8}{'of capacity':>13}\n"
        f"{'':<20}{'99 %':>16}{'99 %':>8}{'50 %':>17}{'95 %':>8}"
    )
    for air, rows in results.items():
        for name, row in rows.items():
            print(
                f"{air + ', ' + name:<20}{row['sent_p99']:>16.2f}{row['heard_p99']:>8.2f}{row['delay_p50']:>17.3f}"
                f"{row['delay_p95']:>8.3f}{row['goodput']:>13.2f}"
            )


def main(arguments: Sequence[str] | None = None) -> int:
    """The program."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--air", default="wifi-6m", help="a radio's preset (%(default)s)")
    parser.add_argument("--step", type=float, default=1.0, help="length of a step, seconds (%(default)s)")
    parser.add_argument("--hops", type=int, default=3, help="(%(default)s)")
    parser.add_argument("--loss", type=float, default=0.0, help="share of the frames, 0 to 1 (%(default)s)")
    parser.add_argument("--pictures", type=int, default=20, help="how many (%(default)s)")
    parser.add_argument("--bytes", type=int, default=4_000_000, help="of each (%(default)s)")
    parser.add_argument("--part-bytes", type=int, default=PART_BYTES, help="of each part, at most (%(default)s)")
    parser.add_argument("--steps", type=int, default=20_000, help="the most (%(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="(%(default)s)")
    parser.add_argument("--kill", action="store_true", help="each drone between is off once, in the middle")
    parser.add_argument("--beside", action="store_true", help="measure beacons and measurements beside pictures")
    parser.add_argument("--json", action="store_true", help="one JSON object")
    options = parser.parse_args(arguments)
    if options.beside:
        results = {air: measure_beside(air, step_s, options.hops, options.seed) for air, step_s in BESIDE.items()}
        print(json.dumps(results)) if options.json else show_beside(results)
        return 0
    scenario = line(options.hops, options.air, options.step, options.loss, options.seed)
    result = measure_time(
        scenario, options.pictures, options.bytes, part_bytes=options.part_bytes, kill=options.kill,
        most_steps=options.steps,
    )  # fmt: skip
    print(json.dumps(result)) if options.json else show_time(result)
    return 0


if __name__ == "__main__":
    sys.exit(main())

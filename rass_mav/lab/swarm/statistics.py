"""The figures of a run, and the summary that scripts read (docs/evaluation/simulation.md)."""

from __future__ import annotations

import resource
import time
from collections.abc import Sequence
from typing import Any, Protocol

from rass_mav.agent.agent import Agent
from rass_mav.core.alarms import Alarm
from rass_mav.core.datum import STORE_FAULTS
from rass_mav.core.messages import NO_ROUTE
from rass_mav.lab.disk.power import Power
from rass_mav.lab.hostile.band import Band
from rass_mav.lab.ledger import Ledger, outcome
from rass_mav.lab.medium.air import Air
from rass_mav.lab.swarm.failures import Failures
from rass_mav.lab.swarm.traffic import Load, Pictures


class Counted(Protocol):
    """The subject of the figures: a swarm in virtual time."""

    seed: int
    topology: str
    agents: list[Agent]
    ledger: Ledger
    loops: int
    failures: Failures | None
    power: Power | None
    hostile: Band | None
    air: Air
    step_s: float


def percentile(ordered: list[int], fraction: float) -> int | None:
    """Nearest-rank percentile of sorted values; None if there are none."""
    if not ordered:
        return None
    rank = max(1, -(-int(fraction * 1000) * len(ordered) // 1000))
    return ordered[min(rank, len(ordered)) - 1]


def spread(values: list[int]) -> dict[str, float | int | None]:
    """Mean, median and 95th percentile."""
    ordered = sorted(values)
    mean = round(sum(ordered) / len(ordered), 4) if ordered else None
    return {"mean": mean, "p50": percentile(ordered, 0.5), "p95": percentile(ordered, 0.95)}


def rate(bytes_sent: int, nodes: int, seconds: float) -> float:
    """Bytes that a node puts on the air in a second."""
    return round(bytes_sent / (nodes * seconds), 4) if seconds else 0.0


def count_loops(next_hops: Sequence[int | None]) -> int:
    """Cycles in the graph of next hops (each node has at most one). Nodes outside the swarm have none."""
    loops, nodes = 0, len(next_hops)
    state = [0] * nodes
    for start in range(nodes):
        if state[start]:
            continue
        node: int | None = start
        mark = start + 1
        while node is not None and node < nodes and not state[node]:
            state[node] = mark
            node = next_hops[node]
        if node is not None and node < nodes and state[node] == mark:
            loops += 1
    return loops


class Stopwatch:
    """How long a swarm takes: by the clock on the wall, and in processor time. It runs from when it is created."""

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


class Statistics:
    """Counts once a step, after the air is quiet."""

    def __init__(self, world: Counted, full_items: int | None = None) -> None:
        """`full_items`: how many data in a drone's store are 100 %; None: its capacity."""
        self._world = world
        self._full_items = full_items
        self._steps = 0
        self._stored = 0
        self._copies = 0
        self._waiting = 0
        # Of agents that no longer exist.
        self._received = 0
        self._malformed = 0
        self._sent_data = 0
        self.max_hop_count = 0
        self.load: Load | None = None
        """What the drones create, where the scenario asks for a load."""
        self.pictures: Pictures | None = None
        """Those that the drones take; None: there are none."""

    def count(self) -> None:
        """Record the figures of this step."""
        ledger = self._world.ledger
        self._steps += 1
        self._stored += ledger.stored
        self._copies += ledger.waiting_copies
        self._waiting += ledger.waiting
        for agent in self._world.agents:
            self._stored += len(agent.node.overheard)
            hops = agent.node.routing.hops
            if self.max_hop_count < hops != NO_ROUTE:
                self.max_hop_count = hops

    def retire(self, agent: Agent) -> None:
        """An agent's life ends, and another one replaces it: its counts still count."""
        self._received += agent.peers.received
        self._malformed += agent.peers.malformed + agent.peers.reader.malformed
        self._sent_data += agent.node.pace.sent

    def _false_losses(self) -> int:
        """How many losses the bases have recorded of data that no node created, or that are not lost, and of stores
        that were not damaged: no store is, unless there are disks."""
        ledger = self._world.ledger
        losses = {loss for agent in self._world.agents if agent.settings.base for loss in agent.store.losses()}
        return sum(self._world.power is None if fate in STORE_FAULTS else id not in ledger.lost for id, fate in losses)

    def summary(self) -> dict[str, Any]:
        """What `swarm --json` prints, except the wall times."""
        world = self._world
        settings = world.agents[0].settings
        ledger, radio = world.ledger, world.air.tally
        created = ledger.created
        bases = sum(agent.settings.base for agent in world.agents)
        drones = len(world.agents) - bases
        room = drones * self._steps * (self._full_items or settings.store.most_items)
        received = self._received + sum(agent.peers.received for agent in world.agents)
        malformed = self._malformed + sum(a.peers.malformed + a.peers.reader.malformed for a in world.agents)
        sent_data = self._sent_data + sum(agent.node.pace.sent for agent in world.agents)
        summary = {
            "nodes": len(world.agents),
            "bases": bases,
            "steps": self._steps,
            "seed": world.seed,
            "policy": settings.policy.name,
            "topology": world.topology,
            **outcome(created, len(ledger.arrived), ledger.held, ledger.losses(), ledger.altered),
            "delay_steps": spread(ledger.delays()),
            "hops": spread(ledger.hops),
            "memory_used_percent": round(100 * self._stored / room, 4) if room else 0.0,
            "copies_mean": round(self._copies / self._waiting, 4) if self._waiting else 0.0,
            "transmissions_per_datum": round(sent_data / created, 4) if created else 0.0,
            "frames": {"sent": radio.sent, "received": received, "dropped": radio.dropped, "malformed": malformed},
            "bytes_sent": radio.bytes_sent,
            "bytes_per_node_s": rate(radio.bytes_sent, len(world.agents), self._steps * settings.step_s),
            "air_sha256": radio.sha256,
            "routing": {"max_hop_count": self.max_hop_count, "loops": world.loops},
        }
        if air := world.air.figures(self._steps * world.step_s):
            summary["air"] = air
        if self.load is not None:
            summary["load"] = self.load._asdict()
        if self.pictures is not None and self.pictures.taken:
            summary["pictures"] = {"taken": len(self.pictures.taken), "whole": self.pictures.whole(ledger.arrived)}
        if world.failures is not None:
            summary["failures"] = dict(world.failures.counts)
            if world.failures.blast is not None:
                summary["blast"] = world.failures.blast.figures()
        if world.power is not None:
            summary["power"] = world.power.figures()
        if world.hostile is not None:
            summary["hostile"] = {
                "false_delivered": ledger.false_delivered,
                "false_losses": self._false_losses(),
                "alarms": {
                    alarm.name.lower(): sum(alarm in agent.node.alarms.counts for agent in world.agents)
                    for alarm in Alarm
                },
            }
        return summary

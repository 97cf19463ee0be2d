"""A flying swarm from start to end: the air, vehicles, pilot and nodes as processes, in real time.

docs/contribute/sitl-and-replay.md explains the wiring and the summary.
"""

from __future__ import annotations

import bisect
import csv
import logging
import math
import time
from collections import defaultdict
from collections.abc import Callable, Iterable
from math import inf
from pathlib import Path
from typing import Any

import msgspec

from rass_mav.app.clock import DateNote
from rass_mav.core.datum import Kind
from rass_mav.errors import ConfigError, SwarmError
from rass_mav.lab.fleet.children import Child, Children
from rass_mav.lab.fleet.fleet import START_S, Fleet
from rass_mav.lab.fleet.processes import MAX_NODES, AirAutopilots, conduct
from rass_mav.lab.medium.neighbours import Position
from rass_mav.lab.sitl.firmware import Firmware, prepare
from rass_mav.lab.sitl.pilot import CONNECT_S, OBEY_S, Flight, PilotOrder, PilotReport
from rass_mav.lab.sitl.scenario import FlightScenario
from rass_mav.lab.swarm.autopilot import to_arena
from rass_mav.lab.swarm.scenario import system_id
from rass_mav.link.settings import LinkSection
from rass_mav.store.reader import SqliteReader
from rass_mav.wire.measurement import decode_measurement


class Trajectories:
    """The vehicles' positions over time, from the file that the air has written."""

    def __init__(self, path: Path) -> None:
        """Read the file (columns `air.COLUMNS`)."""
        self._times: dict[int, list[float]] = defaultdict(list)
        self._places: dict[int, list[Position]] = defaultdict(list)
        with path.open(encoding="ascii", newline="") as file:
            for row in csv.DictReader(file):
                node = int(row["node"])
                self._times[node].append(float(row["time"]))
                self._places[node].append((float(row["x"]), float(row["y"])))

    def place(self, node: int, time: float) -> Position | None:
        """The last position before a time (seconds since 1970), metres; None: it had not been heard."""
        index = bisect.bisect_right(self._times[node], time) - 1
        return self._places[node][index] if index >= 0 else None


def measurements(stores: Iterable[Path], flown: Trajectories) -> dict[str, Any]:
    """Figures about the measurements in the bases' stores.

    `error_m`: distance between the position in a measurement and the vehicle's true position then, mean and largest.
    """
    seen = set()
    with_position = 0
    readings: list[float] = []
    errors: list[float] = []
    for path in stores:
        with SqliteReader(path) as store:
            offset = DateNote.of(store.meta()).offset_s
            for info in store.held():
                datum = store.get(info.id)
                if datum is None or datum.kind != Kind.MEASUREMENT or info.id in seen:
                    continue
                seen.add(info.id)
                m = decode_measurement(datum.payload)
                if m.reading is not None:
                    readings.append(m.reading)
                if m.latitude is None or m.longitude is None:
                    continue
                with_position += 1
                truth = flown.place(info.id.origin, info.created + offset)
                if truth is not None:
                    errors.append(math.dist(truth, to_arena(m.latitude, m.longitude)))
    return {
        "delivered": len(seen),
        "with_position": with_position,
        "with_reading": len(readings),
        "largest_reading": round(max(readings), 3) if readings else None,
        "error_m": {
            "mean": round(sum(errors) / len(errors), 2) if errors else None,
            "max": round(max(errors), 2) if errors else None,
        },
    }


log = logging.getLogger(__name__)


class Vehicle:
    """One vehicle: its process, and the progress of its mission."""

    def __init__(self, child: Child, items: int, begin: int, goal: int) -> None:
        """`items`: number of mission items. `begin`: the take-off item. `goal`: the item at which the mission counts as
        finished."""
        self.child = child
        self.items = items
        self.item = 0
        """The current item."""
        self.flying = False
        """Whether it has accepted the order to fly its mission."""
        self.killed_s: float | None = None
        """Seconds after take-off when its autopilot was killed; None: it is alive."""
        self._begin = begin
        self._goal = goal

    @property
    def mission(self) -> str:
        """The state of its mission."""
        if self.item >= self._goal:
            return "finished"
        return "unfinished" if self.item > self._begin else "not_flown"


class Sitl(AirAutopilots):
    """Autopilots of vehicles that fly, each a process; their air; and the pilot, which tells them what to do.

    Pilot and vehicles need no clean-up at the end: their parent kills them.
    """

    name = "sitl"
    module = "rass_mav.lab.sitl.air"

    def __init__(self, scenario: FlightScenario, firmware: Firmware, record: Path | None, *, through: bool) -> None:
        """`through`: whether frames between nodes go through the autopilots."""
        super().__init__(scenario, record)
        self._scenario = scenario
        self._firmware = firmware
        self._scripted = firmware.script is not None and len(scenario.sources) == 1
        self.order.through = through
        self.order.px4 = firmware.name == "px4"
        self.order.readings = not self._scripted
        self._vehicles: dict[int, Vehicle] = {}
        self._pilot: Child
        self._pilot_ready = False
        self._took_off = inf
        """As a time of `time.monotonic`."""

    def start(self, directory: Path, children: Children) -> None:
        """Start air and vehicles. Returns when all can fly."""
        self.order.trajectories = str(directory / "track.csv")
        super().start(directory, children)
        scenario = self._scenario
        flights = []
        home_first = self._firmware.name != "px4"
        for n in range(scenario.bases, scenario.nodes):
            items = scenario.mission(n, home_first=home_first)
            # The last item is the return. A vehicle without waypoints stays at the item before it.
            goal = len(items) - (1 if scenario.waypoints(n) else 2)
            own = directory / f"vehicle-{n}"
            arguments = prepare(self._firmware, scenario, self.ports, n, own, scripted=self._scripted)
            child = children.start(f"vehicle {n}", arguments, directory / f"vehicle-{n}.log")
            self._vehicles[n] = Vehicle(child, len(items), int(home_first), goal)
            flights.append(Flight(n, system_id(n), self.ports.station[n], items))
        self._pilot = self.process("pilot", "rass_mav.lab.sitl.pilot", PilotOrder(flights), self._pilot_heard)
        children.wait_for(lambda: [] if self._pilot_ready else ["the vehicles"], CONNECT_S + OBEY_S + START_S)

    def set_off(self) -> None:
        """Take off. Returns when all vehicles are flying their missions."""
        self._pilot.tell("start")
        self.children.wait_for(
            lambda: [vehicle.child.name for vehicle in self._vehicles.values() if not vehicle.flying], OBEY_S + START_S
        )
        self._took_off = time.monotonic()

    def url(self, node_id: int) -> str | None:
        """A base has no autopilot."""
        return None if node_id < self._scenario.bases else super().url(node_id)

    def link(self, node_id: int) -> LinkSection:
        """Its own radio, or its autopilot's."""
        if not self.order.through or node_id < self._scenario.bases:
            return super().link(node_id)
        # All autopilots of the swarm share one radio channel, so nodes that are heard are one hop away.
        return LinkSection(type="autopilot", one_hop=True)

    def _pilot_heard(self) -> None:
        self._pilot.read()
        while (line := self._pilot.next_line()) is not None:
            report = msgspec.json.decode(line, type=PilotReport)
            if report.event == "failed":
                raise SwarmError(report.text)
            if report.event == "ready":
                log.info("all vehicles are ready")
                self._pilot_ready = True
                continue
            log.info("vehicle %d: %s %s", report.node_id, report.event, report.text or report.item or "")
            vehicle = self._vehicles[report.node_id]
            if report.event == "text":
                vehicle.child.note(report.text)
            elif report.event == "flying":
                vehicle.flying = True
            elif report.event == "item":
                vehicle.item = report.item

    def tick(self, now: float) -> float:
        """Kill the autopilots that are due."""
        due = inf
        for node_id, after_s in self._scenario.failures.kill_autopilots:
            vehicle = self._vehicles[node_id]
            if vehicle.killed_s is not None:
                continue
            if now < self._took_off + after_s:
                due = min(due, self._took_off + after_s)
                continue
            log.info("killing the autopilot of vehicle %d", node_id)
            vehicle.killed_s = round(now - self._took_off, 1)
            self.children.kill(vehicle.child)
            self.tell(f"down {node_id}")
        return due

    def summary(self, fleet: Fleet) -> dict[str, Any]:
        """The part `sitl` (docs/contribute/sitl-and-replay.md)."""
        counted = self.figures
        vehicles = [
            {
                "node_id": n,
                "system_id": system_id(n),
                "item": min(vehicle.item, vehicle.items - 1),
                "items": vehicle.items,
                "finished": vehicle.mission == "finished",
                "killed_s": vehicle.killed_s,
                "flew_m": round(counted.flew_m[n], 1),
                "farthest_m": round(counted.farthest_m[n], 1),
                "highest_m": round(counted.highest_m[n], 1),
                "true_positions": counted.truth[n],
            }
            for n, vehicle in self._vehicles.items()
        ]
        missions: dict[str, list[int]] = {"finished": [], "unfinished": [], "not_flown": []}
        for n, vehicle in self._vehicles.items():
            missions[vehicle.mission].append(n)
        flown = Trajectories(Path(self.order.trajectories))
        return {
            "sitl": {
                "firmware": self._firmware.name,
                "wiring": "through-autopilots" if self.order.through else "beside-autopilots",
                "readings": "script" if self._scripted else "injected",
                "telemetry_frames": counted.telemetry,
                "missions": missions,
                "vehicles": vehicles,
                "measurements": measurements([base.store for base in fleet.bases], flown),
            }
        }


def run(
    scenario: FlightScenario,
    firmware: Firmware,
    *,
    through: bool = False,
    keep: Path | None = None,
    record: Path | None = None,
    progress: Callable[[int], None] | None = None,
) -> dict[str, Any]:
    """Fly a scenario, in real time, and return its summary.

    It takes `steps` * `node.step_s` seconds from take-off, some minutes before that with real firmware (until the
    autopilot trusts its GPS), and some seconds at the end until all data have arrived. No process outlives the call:
    Ctrl-C and SIGTERM (in the main thread) end all processes, and so does SIGKILL on Linux.

    `through`: frames between nodes go through the autopilots. `keep`: a new or empty directory for all files; None: a
    temporary one. `record`: a .tlog of all frames on the air. `progress` is called with the step.

    Raises `ConfigError` for a scenario that cannot be flown, or without MAVSDK; `SwarmError` if a process ends, or if a
    vehicle is not heard or does not obey; `StoreError` for a store that cannot be read.
    """
    if scenario.nodes > MAX_NODES:
        raise ConfigError(f"nodes: expected at most {MAX_NODES}, got {scenario.nodes}")
    for key in scenario.failures.of_robots:
        raise ConfigError(
            f"failures.{key}: not for flying vehicles, which support only failures.kill_every_s and kill_autopilots"
        )
    if scenario.disk is not None:
        raise ConfigError("disk: not for flying vehicles; their stores are on this machine's disk")

    return conduct(scenario, Sitl(scenario, firmware, record, through=through), keep, progress)

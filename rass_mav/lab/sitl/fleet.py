"""A flying swarm from start to end: the air, vehicles, pilot and nodes as processes, in real time.

docs/sitl.md explains the wiring and the summary.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec

from rass_mav.agent.settings import AgentSettings
from rass_mav.errors import ConfigError, SwarmError
from rass_mav.lab.fleet.air_server import Figures, Ports
from rass_mav.lab.fleet.children import Child, Children
from rass_mav.lab.fleet.processes import MAX_NODES, START_S, NodeProcess, ProcessSwarm, conduct
from rass_mav.lab.sitl.air import FlightFigures, FlightOrder, FlightPorts
from rass_mav.lab.sitl.firmware import Firmware, prepare
from rass_mav.lab.sitl.pilot import CONNECT_S, OBEY_S, Flight, PilotOrder, PilotReport, need_mavsdk
from rass_mav.lab.sitl.scenario import FlightScenario
from rass_mav.lab.sitl.track import Track, measurements
from rass_mav.lab.swarm.scenario import system_id
from rass_mav.link.settings import LinkSection

log = logging.getLogger(__name__)


class FlightNode(NodeProcess):
    """A node on a vehicle, or a base on the ground."""

    def __init__(self, node_id: int, directory: Path, socket: Path, *, through: bool) -> None:
        """See `NodeProcess`. `through`: whether its frames go through its autopilot."""
        super().__init__(node_id, directory, socket)
        self._through = through

    def _wiring(self, settings: AgentSettings, ports: Ports) -> tuple[str | None, LinkSection]:
        vehicle, beside = super()._wiring(settings, ports)
        if settings.base:
            return None, beside
        # All autopilots of the swarm share one radio channel, so nodes that are heard are one hop away.
        return vehicle, LinkSection(type="autopilot", one_hop=True) if self._through else beside


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


class FlownSwarm(ProcessSwarm):
    """A swarm of processes on flying vehicles. `run` uses it and explains it.

    Pilot and vehicles need no clean-up at the end: their parent kills them.
    """

    _figures_kind = FlightFigures
    _scenario: FlightScenario

    def __init__(
        self,
        scenario: FlightScenario,
        directory: Path,
        sockets: Path,
        children: Children,
        firmware: Firmware,
        *,
        through: bool,
    ) -> None:
        """`directory`: the folder for all files. `sockets`: the folder for control sockets."""
        self._firmware = firmware
        self._through = through
        super().__init__(scenario, directory, sockets, children)
        self._scripted = firmware.script is not None and len(scenario.sources) == 1
        self._vehicles: dict[int, Vehicle] = {}
        self._pilot_ready = False

    def _node(self, node_id: int, directory: Path, socket: Path) -> NodeProcess:
        return FlightNode(node_id, directory, socket, through=self._through)

    def _surround(self, record: str | None) -> None:
        """Start air and vehicles. Returns when all can fly."""
        order = FlightOrder(
            scenario=self._scenario, record=record, through=self._through, px4=self._firmware.name == "px4",
            readings=not self._scripted, track=str(self._track),
        )  # fmt: skip
        self._ports = ports = self._start_radio("rass_mav.lab.sitl.air", order, FlightPorts)
        flights = []
        home_first = self._firmware.name != "px4"
        for drone in self._drones:
            n = drone.node_id
            items = self._scenario.mission(n, home_first=home_first)
            # The last item is the return. A vehicle without waypoints stays at the item before it.
            goal = len(items) - (1 if self._scenario.waypoints(n) else 2)
            self._vehicles[n] = Vehicle(self._start_vehicle(n, ports), len(items), int(home_first), goal)
            flights.append(Flight(n, system_id(n), ports.station[n], items))
        self._world = self._process("pilot", "rass_mav.lab.sitl.pilot", PilotOrder(flights), self._pilot_heard)
        self._await(lambda: [] if self._pilot_ready else ["the vehicles"], CONNECT_S + OBEY_S + START_S)

    def _set_off(self) -> None:
        """Take off. Returns when all vehicles are flying their missions."""
        super()._set_off()
        self._await(
            lambda: [vehicle.child.name for vehicle in self._vehicles.values() if not vehicle.flying], OBEY_S + START_S
        )

    def _start_vehicle(self, node_id: int, ports: FlightPorts) -> Child:
        name = f"vehicle-{node_id}"
        directory = self._directory / name
        arguments = prepare(self._firmware, self._scenario, ports, node_id, directory, scripted=self._scripted)
        return self._children.start(f"vehicle {node_id}", arguments, self._directory / f"{name}.log")

    def _pilot_heard(self) -> None:
        self._world.read()
        while (line := self._world.next_line()) is not None:
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

    def _fail(self, now: float) -> float:
        """Also kill the autopilots that are due."""
        due = super()._fail(now)
        for node_id, after_s in self._scenario.failures.kill_autopilots:
            vehicle = self._vehicles[node_id]
            if vehicle.killed_s is not None:
                continue
            if now < self._begun + after_s:
                due = min(due, self._begun + after_s)
                continue
            log.info("killing the autopilot of vehicle %d", node_id)
            vehicle.killed_s = round(now - self._begun, 1)
            self._children.kill(vehicle.child)
            self._radio.tell(f"down {node_id}")
        return due

    @property
    def _track(self) -> Path:
        return self._directory / "track.csv"

    def summary(self, radio: Figures) -> dict[str, Any]:
        """What `sitl --json` prints, except for the wall times (docs/sitl.md)."""
        assert isinstance(radio, FlightFigures)
        summary = super().summary(radio)
        summary["transport"]["name"] = "sitl"
        vehicles = [
            {
                "node_id": n,
                "system_id": system_id(n),
                "item": min(vehicle.item, vehicle.items - 1),
                "items": vehicle.items,
                "finished": vehicle.mission == "finished",
                "killed_s": vehicle.killed_s,
                "flew_m": round(radio.flew_m[n], 1),
                "farthest_m": round(radio.farthest_m[n], 1),
                "highest_m": round(radio.highest_m[n], 1),
                "true_positions": radio.truth[n],
            }
            for n, vehicle in self._vehicles.items()
        ]
        missions: dict[str, list[int]] = {"finished": [], "unfinished": [], "not_flown": []}
        for n, vehicle in self._vehicles.items():
            missions[vehicle.mission].append(n)
        stores = [node.store for node in self._nodes[: self._scenario.bases]]
        summary["sitl"] = {
            "firmware": self._firmware.name,
            "wiring": "through-autopilots" if self._through else "beside-autopilots",
            "readings": "script" if self._scripted else "injected",
            "telemetry_frames": radio.telemetry,
            "missions": missions,
            "vehicles": vehicles,
            "measurements": measurements(stores, Track(self._track)),
        }
        return summary


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
    need_mavsdk()
    if scenario.nodes > MAX_NODES:
        raise ConfigError(f"nodes: expected at most {MAX_NODES}, got {scenario.nodes}")
    for key in scenario.failures.of_robots:
        raise ConfigError(
            f"failures.{key}: not for flying vehicles, which support only failures.kill_every_s and kill_autopilots"
        )
    if scenario.disk is not None:
        raise ConfigError("disk: not for flying vehicles; their stores are on this machine's disk")

    def make(directory: Path, sockets: Path, children: Children) -> FlownSwarm:
        return FlownSwarm(scenario, directory, sockets, children, firmware, through=through)

    return conduct(scenario, make, keep, record, progress)

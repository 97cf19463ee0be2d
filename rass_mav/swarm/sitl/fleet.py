"""A flown swarm from start to end: the air, vehicles, pilot and nodes as processes, in real time.

docs/sitl.md says what is wired to what, and what the summary says.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec

from rass_mav.agent.settings import AgentSettings
from rass_mav.errors import ConfigError, SwarmError
from rass_mav.link.settings import LinkSection
from rass_mav.swarm.children import Child, Children, wait_any
from rass_mav.swarm.processes import MAX_NODES, NodeProcess, ProcessSwarm, conduct
from rass_mav.swarm.scenario import system_id
from rass_mav.swarm.sitl.air import AirFigures, AirOrder, AirPorts
from rass_mav.swarm.sitl.firmware import Firmware, prepare
from rass_mav.swarm.sitl.pilot import CONNECT_S, OBEY_S, Flight, PilotOrder, PilotReport, need_mavsdk
from rass_mav.swarm.sitl.scenario import FlightScenario
from rass_mav.swarm.sitl.track import Track, measurements
from rass_mav.swarm.udp_radio import Figures, Ports

log = logging.getLogger(__name__)

# Until a process has to be ready, seconds.
_START_S = 20.0


class FlightNode(NodeProcess):
    """A node on a vehicle, or a base on the ground."""

    def __init__(self, node_id: int, directory: Path, socket: Path, *, through: bool) -> None:
        """See `NodeProcess`. `through`: its frames go through its autopilot."""
        super().__init__(node_id, directory, socket)
        self._through = through

    def _wiring(self, settings: AgentSettings, ports: Ports) -> tuple[str | None, LinkSection]:
        vehicle, beside = super()._wiring(settings, ports)
        if settings.base:
            return None, beside
        # All autopilots of the swarm are on one radio channel: who is heard is one hop away.
        return vehicle, LinkSection(type="autopilot", one_hop=True) if self._through else beside


class FlownSwarm(ProcessSwarm):
    """A swarm of processes on vehicles that fly. `run` does it all; see there."""

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
        """`directory`: where everything is written. `sockets`: where control sockets are."""
        super().__init__(scenario, directory, sockets, children)
        self._flown = scenario
        self._firmware = firmware
        self._through = through
        self._scripted = firmware.script is not None and len(scenario.sources) == 1
        self._nodes = [FlightNode(n, directory, sockets / f"{n}.sock", through=through) for n in range(scenario.nodes)]
        self._drones = self._nodes[scenario.bases :]
        self._vehicles: dict[int, Child] = {}
        self._items: dict[int, int] = {}
        """How many mission items each vehicle has."""
        self._item: dict[int, int] = {}
        """Which one it flies."""
        self._pilot: Child
        self._pilot_ready = False

    # -- the phases ----------------------------------------------------------------------------------------------------

    def start(self, record: Path | None) -> None:
        """Start air and vehicles; once all can fly, the nodes, and then the missions."""
        order = AirOrder(
            self._flown,
            through=self._through,
            px4=self._firmware.name == "px4",
            readings=not self._scripted,
            track=str(self._track),
            record=None if record is None else str(record.absolute()),
        )
        self._radio = self._process("radio", "rass_mav.swarm.sitl.air_process", order)
        self._ports = ports = msgspec.json.decode(self._radio.wait_line(_START_S), type=AirPorts)
        for node in self._drones:
            self._start_vehicle(node.node_id, ports)
        flights = []
        for node in self._drones:
            items = self._flown.mission(node.node_id, home_first=self._firmware.name != "px4")
            self._items[node.node_id] = len(items)
            self._item[node.node_id] = 0
            flights.append(Flight(node.node_id, system_id(node.node_id), ports.station[node.node_id], items))
        self._pilot = self._process("pilot", "rass_mav.swarm.sitl.pilot", PilotOrder(flights))
        self._await(lambda: self._pilot_ready, CONNECT_S + OBEY_S + _START_S, "the vehicles")
        until = self._until_step()
        for process in self._nodes:
            process.configure(self._flown, ports, until)
            process.start(self._children)
        self._started = True
        self._await(lambda: all(node.ready for node in self._nodes), _START_S + 2.0 * len(self._nodes), "the nodes")
        self._pilot.tell("start")
        self._begun = time.monotonic()

    def stop(self) -> AirFigures:
        """End the nodes with SIGTERM, then the air, and read the ledger. Raises `SwarmError` for who does not.

        Pilot and vehicles have nothing to put in order: they are killed.
        """
        self._ask_all()
        self.hang_up()
        for node in self._nodes:
            node.child.terminate()
        for node in self._nodes:
            node.child.wait_stopped()
        self._radio.tell("stop")
        figures = msgspec.json.decode(self._radio.wait_line(_START_S), type=AirFigures)
        self._radio.wait_stopped()
        for child in (self._pilot, *self._vehicles.values()):
            self._children.kill(child)
        self._census.close(self._clock.now())
        return figures

    # -- meanwhile -----------------------------------------------------------------------------------------------------

    _started = False

    def _start_vehicle(self, node_id: int, ports: AirPorts) -> None:
        name = f"vehicle {node_id}"
        directory = self._directory / f"vehicle-{node_id}"
        arguments = prepare(self._firmware, self._flown, ports, node_id, directory, scripted=self._scripted)
        self._vehicles[node_id] = self._children.start(name, arguments, self._directory / f"vehicle-{node_id}.log")

    def _process(self, name: str, module: str, order: msgspec.Struct) -> Child:
        path = self._directory / f"{name}.json"
        path.write_bytes(msgspec.json.encode(order))
        return self._children.start(name, ["-m", module, str(path)], self._directory / f"{name}.log")

    def _await(self, done: Callable[[], bool], within_s: float, whom: str) -> None:
        deadline = time.monotonic() + within_s
        while not done():
            if time.monotonic() > deadline:
                raise SwarmError(f"{whom}: not ready within {within_s:g} s")
            self._wait(deadline)

    def _wait(self, until: float) -> None:
        """Until a time of `time.monotonic`, or until a process says something. Raises `SwarmError` if one ended."""
        files = {node.child.file: node.heard for node in self._nodes} if self._started else {}
        files |= {child.file: _watcher(child) for child in self._vehicles.values()}
        files |= {self._pilot.file: self._pilot_heard, self._radio.file: _watcher(self._radio)}
        wait_any(files, until - time.monotonic())

    def _pilot_heard(self) -> None:
        if not self._pilot.read():
            raise self._pilot.failed()
        while (line := self._pilot.next_line()) is not None:
            report = msgspec.json.decode(line, type=PilotReport)
            log.info("vehicle %d: %s %d", report.node_id, report.event, report.item)
            if report.event == "failed":
                raise SwarmError(report.text)
            self._pilot_ready = self._pilot_ready or report.event == "ready"
            if report.event == "item":
                self._item[report.node_id] = report.item

    @property
    def _track(self) -> Path:
        return self._directory / "track.csv"

    # -- the end -------------------------------------------------------------------------------------------------------

    def summary(self, radio: Figures) -> dict[str, Any]:
        """What `sitl --json` prints, but for the wall times (docs/sitl.md)."""
        assert isinstance(radio, AirFigures)
        summary = super().summary(radio)
        summary["transport"]["name"] = "sitl"
        vehicles = [
            {
                "node_id": n,
                "system_id": system_id(n),
                "item": min(self._item[n], self._items[n] - 1),
                "items": self._items[n],
                # The last item is the way home.
                "finished": self._item[n] >= self._items[n] - 1,
                "flew_m": radio.flew_m[n],
                "farthest_m": radio.farthest_m[n],
                "highest_m": radio.highest_m[n],
                "true_positions": radio.truth[n],
            }
            for n in self._vehicles
        ]
        stores = [node.store for node in self._nodes[: self._flown.bases]]
        summary["sitl"] = {
            "firmware": self._firmware.name,
            "wiring": "through-autopilots" if self._through else "beside-autopilots",
            "readings": "script" if self._scripted else "injected",
            "telemetry_frames": radio.telemetry,
            "vehicles": vehicles,
            "measurements": measurements(stores, Track(self._track)),
        }
        return summary


def _watcher(child: Child) -> Callable[[], None]:
    """For a process that has nothing to say while it runs."""

    def heard() -> None:
        if not child.read():
            raise child.failed()

    return heard


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

    Takes `steps` * `node.step_s` seconds from take-off, some minutes before with real firmware (until its GPS is
    believed), and at the end some seconds until all data have arrived. No process outlives the call: Ctrl-C and
    SIGTERM (in the main thread) end all, and so does SIGKILL on Linux.

    `through`: frames between nodes go through the autopilots. `keep`: a directory, new or empty, for everything that is
    written; None: a temporary one. `record`: a .tlog of all frames put on the air. `progress` is called with the step.

    Raises `ConfigError`: what cannot be flown, or no MAVSDK; `SwarmError`: a process that ended, a vehicle that is not
    heard or does not obey; `StoreError`: a store that cannot be read.
    """
    need_mavsdk()
    if scenario.nodes > MAX_NODES:
        raise ConfigError(f"nodes: expected at most {MAX_NODES}, got {scenario.nodes}")
    if through and firmware.name == "px4":
        raise ConfigError("--through-autopilots: expected ArduCopter or the mock; PX4's simulator has no serial ports")
    for key in scenario.failures.of_robots:
        raise ConfigError(f"failures.{key}: not for vehicles that fly; they know failures.kill_every_s only")

    def make(directory: Path, sockets: Path, children: Children) -> FlownSwarm:
        return FlownSwarm(scenario, directory, sockets, children, firmware, through=through)

    return conduct(scenario, make, keep, record, progress)

"""The air between flying vehicles: their true positions determine which nodes hear each other.

In addition to the two sockets of each node, it binds these for each vehicle, on 127.0.0.1 (with PX4, PX4's own ports):

    serial0    the USB port, where the simulator reports the true position
    serial1    TELEM1, the telemetry radio
    serial2    TELEM2, which is wired to the node
    station    where a ground station talks to serial0

There are two wirings. Beside the autopilot, each node has its own radio. Through the autopilots, TELEM1 is on the air:
everything that an autopilot sends there is heard on TELEM1 of the vehicles in range, and by a base.

If the firmware does not provide readings itself, they are injected in the autopilot's name: NAMED_VALUE_FLOAT to the
node, once a second, as a script on the autopilot would send it.
"""

from __future__ import annotations

import csv
import math
import sys
import time

from rass_mav.lab.fleet.air_server import Air, AirOrder, Ports, main
from rass_mav.lab.fleet.wires import whole_frames
from rass_mav.lab.medium.neighbours import RangeGraph
from rass_mav.lab.sitl.scenario import FlightScenario
from rass_mav.lab.swarm.autopilot import ORIGIN, to_arena
from rass_mav.lab.swarm.scenario import system_id
from rass_mav.mavlink.frames import Frame, FrameWriter
from rass_mav.mavlink.identity import AUTOPILOT_COMPONENT
from rass_mav.mavlink.messages import NAMED_VALUE_FLOAT, TUNNEL, named_value_float_payload, set_message_interval

from .mission import MISSION_CURRENT, SIM_STATE, true_place

#: Base of the fixed ports of PX4's instances: for companions and ground stations; for true positions; for the radio. Of
#: the links that PX4 opens in simulation, that one has the rate of a radio, 4000 bytes/s (it is meant for a camera).
PX4_API_PORT, PX4_TRUTH_PORT, PX4_RADIO_PORT = 14540, 19410, 14030
#: Columns of the file of trajectories: wall time in seconds; metres from the arena's centre and above the take-off
#: position; the radiation there, without noise.
COLUMNS = ("time", "node", "x", "y", "height", "level")
# Seconds between two updates of the vehicles' positions, and between two readings.
_LOOK_S = 0.1
_READING_S = 1.0
# The true position and the current mission item are requested repeatedly, because nothing confirms the request.
_ASK_FIRST_S, _ASK_S = 0.5, 5.0
_WANTED = {SIM_STATE: 0.1, MISSION_CURRENT: 0.5}
# Ids for these requests: a ground station that is neither a node nor MAVSDK's (245).
_ASKER = (254, 190)


class FlightAir(Air):
    """The vehicles' positions and cables, and the messages sent in their name."""

    def __init__(self, order: AirOrder[FlightScenario]) -> None:
        """See `Air`."""
        scenario = self._scenario = order.scenario
        n = scenario.nodes
        graph = RangeGraph(scenario.places, scenario.radio.range_m)
        super().__init__(order, graph)
        counted = self.counted
        counted.truth = [0] * n
        counted.flew_m, counted.farthest_m, counted.highest_m = [0.0] * n, [0.0] * n, [0.0] * n
        self._through, self._makes_readings = order.through, order.readings
        vehicles = self._vehicles = list(range(scenario.bases, n))
        """Vehicles whose autopilot is alive."""
        self.places = [(x, y, 0.0) for x, y in scenario.places]
        """True position of each node: metres east and north of the arena's centre, and above its take-off position."""
        self._voices = {node: FrameWriter(system_id(node), AUTOPILOT_COMPONENT) for node in vehicles}
        self._asker = FrameWriter(*_ASKER)
        new = self.wires.new
        self._station = {node: new(self._hear_station, node) for node in vehicles}
        if order.px4:
            # One port for everything that is wired to the vehicle.
            self._serial0 = {node: new(self._hear_px4, node, PX4_API_PORT + node) for node in vehicles}
            self._serial1, self._serial2 = {}, self._serial0
            if self._through:
                self._serial1 = {node: new(self._hear_serial1, node, PX4_RADIO_PORT + node) for node in vehicles}
            for node in vehicles:
                new(self._hear_truth, node, PX4_TRUTH_PORT + node)
        else:
            self._serial0 = {node: new(self._hear_serial0, node) for node in vehicles}
            self._serial1 = {node: new(self._hear_serial1, node) for node in vehicles}
            self._serial2 = {node: new(self._hear_serial2, node) for node in vehicles}
        if self._through:
            self._ears = [self._serial1.get(node, wire) for node, wire in enumerate(self._air)]
        self._trajectories = csv.writer(self._opened(order.trajectories, "w"), lineterminator="\n")
        self._trajectories.writerow(COLUMNS)
        self._moved: set[int] = set()
        self._next_reading = self._next_ask = 0.0

    @property
    def ports(self) -> Ports:
        """All ports."""
        nodes, of_nodes = range(self._scenario.nodes), super().ports
        serial0, serial1, serial2, station = (
            [wires[node].port if node in wires else 0 for node in nodes]
            for wires in (self._serial0, self._serial1, self._serial2, self._station)
        )
        return Ports(of_nodes.air, of_nodes.vehicle, serial0, serial1, serial2, station)

    def look(self, now: float) -> float:
        """Update the vehicles' positions, and send what is due."""
        if self._moved:
            self._graph.update([(x, y) for x, y, _ in self.places])
            wall = round(time.time(), 3)
            for node in sorted(self._moved):
                x, y, height = self.places[node]
                level = self._scenario.level(x, y, height)
                self._trajectories.writerow([wall, node, round(x, 3), round(y, 3), round(height, 3), round(level, 6)])
            self._moved.clear()
        if self._makes_readings and now >= self._next_reading:
            self._next_reading = now + _READING_S
            self._say_readings(now)
        if now >= self._next_ask:
            truth = self.counted.truth
            self._next_ask = now + (_ASK_S if all(truth[node] for node in self._vehicles) else _ASK_FIRST_S)
            self._ask()
        return now + _LOOK_S

    def down(self, node: int) -> None:
        """The autopilot of a node is dead. The vehicle now lies on the ground below its last position."""
        for wires in (self._serial0, self._serial1, self._serial2):
            if node in wires:
                wires[node].forget()
        self._vehicles.remove(node)
        self.places[node] = (*self.places[node][:2], 0.0)
        self._moved.add(node)

    # -- the cables ----------------------------------------------------------------------------------------------------

    def _hear_serial1(self, node: int, data: bytes) -> None:
        """TELEM1: on the air, if it is the radio between the nodes. Other messages of a vehicle are telemetry.

        In simulation all ports of PX4 forward, so its ground station's messages come too. They are left out.
        """
        if not self._through:
            return
        for raw, frame in whole_frames(data, self._serial1[node].reader):
            if frame.message_id == TUNNEL:
                self._hear_frame(node, raw)
            elif frame.system_id == system_id(node):
                self.counted.telemetry += 1
                self._put_on_air(node, raw)

    def _hear_companion(self, node: int, data: bytes) -> None:
        """Frames from a node to its autopilot. A base has none."""
        super()._hear_companion(node, data)
        if node in self._serial2:
            self._serial2[node].send(data)

    def _hear_serial2(self, node: int, data: bytes) -> None:
        self._companion[node].send(data)

    def _hear_station(self, node: int, data: bytes) -> None:
        self._serial0[node].send(data)

    def _hear_serial0(self, node: int, data: bytes) -> None:
        """Frames from a vehicle to its ground station: only its own, because it may forward those of others."""
        for raw, frame in whole_frames(data, self._serial0[node].reader):
            if frame.system_id == system_id(node):
                self._station[node].send(raw)
                self._believe(node, frame)

    def _hear_px4(self, node: int, data: bytes) -> None:
        """One port for ground station and companion."""
        self._hear_serial0(node, data)
        self._companion[node].send(data)

    def _hear_truth(self, node: int, data: bytes) -> None:
        for _, frame in whole_frames(data, self._serial0[node].reader):
            self._believe(node, frame)

    def _believe(self, node: int, frame: Frame) -> None:
        place = true_place(frame)
        if place is None:
            return
        latitude, longitude, altitude = place
        x, y = to_arena(latitude, longitude)
        height = altitude - ORIGIN[2]
        before = self.places[node]
        self.places[node] = (x, y, height)
        self._moved.add(node)
        counted = self.counted
        counted.truth[node] += 1
        # Between two updates it moves in a straight line. While it stands still, rounding must not add up.
        step = math.hypot(x - before[0], y - before[1])
        if step >= 0.01:
            counted.flew_m[node] += step
        counted.farthest_m[node] = max(counted.farthest_m[node], math.dist((x, y), self._scenario.places[node]))
        counted.highest_m[node] = max(counted.highest_m[node], height)

    # -- requests to the vehicles, and readings in their name ----------------------------------------------------------

    def _ask(self) -> None:
        for node in self._vehicles:
            for message_id, interval_s in _WANTED.items():
                message = set_message_interval(
                    message_id, interval_s, target_system=system_id(node), target_component=AUTOPILOT_COMPONENT
                )
                self._serial0[node].send(self._asker.message(message))

    def _say_readings(self, now: float) -> None:
        scenario = self._scenario
        for node in self._vehicles:
            reading = scenario.level(*self.places[node]) + self._noise_rng.gauss(0.0, scenario.radiation.noise)
            payload = named_value_float_payload(scenario.mavlink.reading_name, reading, int(now * 1000))
            self._companion[node].send(self._voices[node].frame(NAMED_VALUE_FLOAT, payload))


if __name__ == "__main__":
    sys.exit(main(FlightAir, FlightScenario, sys.argv[1:]))

"""The air between vehicles that fly: who hears whom follows from where the vehicles truly are.

It binds all UDP ports, on 127.0.0.1, so that none can be in use (PX4's own numbers excepted):

    for each node      air        what it says to its neighbours, and where it hears them
                       companion  its autopilot, that is the vehicle's TELEM2
    for each vehicle   serial0    its USB port; the simulator's truth comes from here
                       serial1    TELEM1, the telemetry radio
                       serial2    TELEM2
                       station    where a ground station talks to serial0

There are two ways of wiring. Beside the autopilot, a node has a radio of its own: `air` is on the air. Through the
autopilots, TELEM1 is: all that an autopilot sends there is heard on TELEM1 of the vehicles in range, and by a base.

Where the firmware does not measure radiation itself, readings are said for the autopilot: NAMED_VALUE_FLOAT to the
node, once a second, as a script on the autopilot would.
"""

from __future__ import annotations

import csv
import math
import random
import time
from collections.abc import Callable
from typing import TextIO

import msgspec

from rass_mav.mavlink.frames import Frame, FrameWriter
from rass_mav.mavlink.identity import AUTOPILOT_COMPONENT
from rass_mav.mavlink.messages import (
    HEARTBEAT,
    NAMED_VALUE_FLOAT,
    TUNNEL,
    named_value_float_payload,
    set_message_interval,
)
from rass_mav.mavlink.mission import MISSION_CURRENT, SIM_STATE, true_place, whole_frames
from rass_mav.swarm.air_counts import AirCounts
from rass_mav.swarm.autopilot import ORIGIN
from rass_mav.swarm.neighbours import RangeGraph
from rass_mav.swarm.radio import Radio, Record
from rass_mav.swarm.scenario import system_id
from rass_mav.swarm.sitl.scenario import FlightScenario, to_arena
from rass_mav.swarm.sitl.wires import Wires
from rass_mav.swarm.udp_radio import Figures, Ports

#: Where PX4's instance k sends, always: what is for companions and ground stations; the truth of its own simulator.
PX4_API_PORT, PX4_TRUTH_PORT = 14540, 19410
#: Columns of the track file: wall time in seconds; metres from the arena's centre and above the take-off place; the
#: radiation there, without noise.
TRACK = ("time", "node", "x", "y", "height", "level")
_READING_S = 1.0
# The simulator's truth and the item being flown are asked for again and again: nothing says that it was understood.
_ASK_FIRST_S, _ASK_S = 0.5, 5.0
_WANTED = {SIM_STATE: 0.1, MISSION_CURRENT: 0.5}
# Who asks: a ground station that is no node, and not MAVSDK's (245).
_ASKER = (254, 190)


class AirOrder(msgspec.Struct):
    """What the air is made of."""

    scenario: FlightScenario
    through: bool
    """Frames between nodes go through the autopilots."""
    px4: bool
    """The vehicles' ports are those of PX4."""
    readings: bool
    """Whether readings are made here."""
    track: str
    """A CSV file for the vehicles' true places."""
    record: str | None = None
    """A .tlog file for every frame put on the air; None: none."""


class AirPorts(Ports):
    """Where all listen on 127.0.0.1, by node id; 0 where there is no such port.

    `vehicle`: where a node finds its autopilot.
    """

    serial0: list[int]
    serial1: list[int]
    serial2: list[int]
    station: list[int]


class AirFigures(Figures):
    """What was counted. Lists are by node id; metres are over ground."""

    telemetry: int
    """Frames on the air that the nodes have not sent; part of `sent`."""
    truth: list[int]
    """How often each node's true place was heard."""
    flew_m: list[float]
    farthest_m: list[float]
    """How far from the take-off place it was at most."""
    highest_m: list[float]
    """How far above the take-off place it was at most."""


class Air:
    """Sockets, places and the radio. `poll`, `step` and `turn` do all the work; the caller brings the time."""

    def __init__(self, order: AirOrder, *, track: TextIO, record: Record | None = None) -> None:
        """`track` gets the true places; `record` is called with every frame put on the air. Raises `LinkError`."""
        scenario = self._scenario = order.scenario
        nodes = range(scenario.nodes)
        self._through, self._makes_readings = order.through, order.readings
        self._vehicles = nodes[scenario.bases :]
        self._radio = Radio(scenario.radio, random.Random(f"{scenario.seed}:radio"), record=record)
        self._noise = random.Random(f"{scenario.seed}:noise")
        self.places = [(x, y, 0.0) for x, y in scenario.places]
        """Where each node truly is: metres east and north of the arena's centre, metres above its take-off place."""
        self._graph = RangeGraph(scenario.places, scenario.radio.range_m)
        self._voices = {node: FrameWriter(system_id(node), AUTOPILOT_COMPONENT) for node in self._vehicles}
        self._asker = FrameWriter(*_ASKER)
        self.wires = wires = Wires()
        self._air = [wires.new(self._hear_node, node) for node in nodes]
        self._companion = [wires.new(self._hear_companion, node) for node in nodes]
        self._station = {node: wires.new(self._hear_station, node) for node in self._vehicles}
        if order.px4:
            # One port for all who talk to the vehicle.
            self._serial0 = {node: wires.new(self._hear_px4, node, PX4_API_PORT + node) for node in self._vehicles}
            self._serial1, self._serial2 = {}, self._serial0
            for node in self._vehicles:
                wires.new(self._hear_truth, node, PX4_TRUTH_PORT + node)
        else:
            self._serial0 = {node: wires.new(self._hear_serial0, node) for node in self._vehicles}
            self._serial1 = {node: wires.new(self._hear_serial1, node) for node in self._vehicles}
            self._serial2 = {node: wires.new(self._hear_serial2, node) for node in self._vehicles}
        self._track = csv.writer(track, lineterminator="\n")
        self._track.writerow(TRACK)
        self._step = 0
        self._moved: set[int] = set()
        self._next_reading = self._next_ask = 0.0
        self._received = self._unsent = self._telemetry = self._heartbeats = 0
        self._counts = AirCounts(scenario.mavlink.payload_type)
        self.late_steps = 0
        self._truth = [0] * scenario.nodes
        self._flew = [0.0] * scenario.nodes
        self._farthest = [0.0] * scenario.nodes
        self._highest = [0.0] * scenario.nodes

    @property
    def ports(self) -> AirPorts:
        """Where everything listens."""
        nodes = range(self._scenario.nodes)
        serial0, serial1, serial2, station = (
            [wires[node].port if node in wires else 0 for node in nodes]
            for wires in (self._serial0, self._serial1, self._serial2, self._station)
        )
        return AirPorts(
            air=[wire.port for wire in self._air],
            vehicle=[wire.port for wire in self._companion],
            serial0=serial0,
            serial1=serial1,
            serial2=serial2,
            station=station,
        )

    def watch(self, file: int, ready: Callable[[], None]) -> None:
        """Let `poll` call `ready` when there is something to read from a file descriptor."""
        self.wires.watch(file, ready)

    def poll(self, timeout_s: float) -> None:
        """Pass on what has been sent; wait for it at most so long."""
        self.wires.poll(timeout_s)

    def step(self) -> None:
        """A step later: frames that were late arrive."""
        self._step += 1
        self._radio.begin_step(self._step)
        self._deliver()

    def turn(self, now: float) -> None:
        """Look where the vehicles are, and say what is due. `now`: seconds since the start."""
        if self._moved:
            self._graph.update([(x, y) for x, y, _ in self.places])
            wall = round(time.time(), 3)
            for node in sorted(self._moved):
                x, y, height = self.places[node]
                level = self._scenario.level(x, y, height)
                self._track.writerow([wall, node, *(round(value, 3) for value in (x, y, height)), round(level, 6)])
            self._moved.clear()
        if self._makes_readings and now >= self._next_reading:
            self._next_reading = now + _READING_S
            self._say_readings(now)
        if now >= self._next_ask:
            self._next_ask = now + (_ASK_S if all(self._truth[node] for node in self._vehicles) else _ASK_FIRST_S)
            self._ask()

    def off(self, node: int) -> None:
        """The process of a node is dead. It hears nothing until its successor speaks."""
        self._air[node].forget()
        self._companion[node].forget()

    def figures(self) -> AirFigures:
        """What has been counted so far."""
        radio = self._radio
        ears = [*self._air, *self._serial1.values()]
        malformed = sum(wire.reader.malformed for wire in self._serial1.values())
        return AirFigures(
            sent=radio.sent,
            received=self._received,
            dropped=radio.dropped + self._unsent + sum(wire.overrun for wire in ears),
            malformed=self._counts.malformed + malformed,
            bytes_sent=radio.bytes_sent,
            sha256=radio.sha256,
            data_sent=self._counts.data_sent,
            max_hop_count=self._counts.max_hop_count,
            heartbeats=self._heartbeats,
            late_steps=self.late_steps,
            telemetry=self._telemetry,
            truth=self._truth,
            flew_m=[round(metres, 1) for metres in self._flew],
            farthest_m=[round(metres, 1) for metres in self._farthest],
            highest_m=[round(metres, 1) for metres in self._highest],
        )

    def close(self) -> None:
        """Release the sockets."""
        self.wires.close()

    # -- the radio -----------------------------------------------------------------------------------------------------

    def _hear_node(self, node: int, data: bytes) -> None:
        """What a node says to its neighbours, a frame a datagram."""
        self._put_on_air(node, data)

    def _hear_serial1(self, node: int, data: bytes) -> None:
        """TELEM1: on the air, if that is the radio between the nodes. What else an autopilot says is telemetry."""
        if not self._through:
            return
        for raw, frame in whole_frames(data, self._serial1[node].reader):
            self._put_on_air(node, raw, frame)

    def _put_on_air(self, node: int, raw: bytes, frame: Frame | None = None) -> None:
        if frame is not None and frame.message_id != TUNNEL:
            self._telemetry += 1
        else:
            self._counts.count(raw)
        self._radio.send(node, raw, self._step)
        self._deliver()

    def _deliver(self) -> None:
        for _, hearer, frame in self._radio.arrivals(self._step, self._graph.neighbours):
            wire = self._serial1[hearer] if self._through and hearer in self._serial1 else self._air[hearer]
            if wire.peer is None:
                continue
            if wire.send(frame):
                self._received += 1
            else:
                self._unsent += 1

    # -- the cables ----------------------------------------------------------------------------------------------------

    def _hear_companion(self, node: int, data: bytes) -> None:
        """What a node says to its autopilot. A base has none."""
        for frame in self._companion[node].reader.feed(data):
            self._heartbeats += frame.message_id == HEARTBEAT
        if node in self._serial2:
            self._serial2[node].send(data)

    def _hear_serial2(self, node: int, data: bytes) -> None:
        self._companion[node].send(data)

    def _hear_station(self, node: int, data: bytes) -> None:
        self._serial0[node].send(data)

    def _hear_serial0(self, node: int, data: bytes) -> None:
        """What a vehicle says to its ground station: its own words only, for it may repeat what it hears of others."""
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
        self._truth[node] += 1
        self._moved.add(node)
        # Between two looks it goes straight; while it stands, rounding must not add up.
        step = math.hypot(x - before[0], y - before[1])
        if step >= 0.01:
            self._flew[node] += step
        self._farthest[node] = max(self._farthest[node], math.dist((x, y), self._scenario.places[node]))
        self._highest[node] = max(self._highest[node], height)

    # -- what the vehicles are told, and are made to say ---------------------------------------------------------------

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
            reading = scenario.level(*self.places[node]) + self._noise.gauss(0.0, scenario.radiation.noise)
            payload = named_value_float_payload(scenario.mavlink.reading_name, reading, int(now * 1000))
            self._companion[node].send(self._voices[node].frame(NAMED_VALUE_FLOAT, payload))

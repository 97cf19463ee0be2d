"""The air between vehicles that fly: range between true places, cables, readings."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from rass_mav.errors import LinkError
from rass_mav.lab.fleet.air_server import AirOrder
from rass_mav.lab.medium.settings import RadioSection
from rass_mav.lab.sitl.air import FlightAir
from rass_mav.lab.sitl.mission import SIM_STATE, sim_state
from rass_mav.lab.sitl.scenario import FlightScenario
from rass_mav.lab.swarm.autopilot import ORIGIN, autopilot_heartbeat, to_arena, to_earth
from rass_mav.lab.swarm.scenario import MobilitySection, RadiationSection, system_id
from rass_mav.mavlink.dialect import common
from rass_mav.mavlink.frames import FrameWriter
from rass_mav.mavlink.messages import HEARTBEAT, NAMED_VALUE_FLOAT, TUNNEL, companion_heartbeat, parse
from rass_mav.mavlink.telemetry import Telemetry
from tests.some import some
from tests.telemetry import global_position_int

from .ends import End

#: A base and two drones; nobody is in range of anybody.
SCENARIO = FlightScenario(
    nodes=3,
    topology="positions",
    arena_m=1000,
    mobility=MobilitySection(positions=[(0, 0), (100, 0), (0, 100)]),
    radio=RadioSection(range_m=50),
    radiation=RadiationSection(sources=[(100, 30, 200)], decay=0.01, noise=0.0),
)


class Wiring:
    """The air, and all that is wired to it."""

    def __init__(self, air: FlightAir, track: Path) -> None:
        self.air = air
        self.track = track
        ports = air.ports
        ids = {node: system_id(node) for node in range(SCENARIO.nodes)}
        self.node = {n: End(ids[n], 191, ports.air[n]) for n in ids}
        self.companion = {n: End(ids[n], 191, ports.vehicle[n]) for n in (1, 2)}
        self.station = {n: End(245, 190, ports.station[n]) for n in (1, 2)}
        self.serial = {
            (n, number): End(ids[n], 1, of[n])
            for n in (1, 2)
            for number, of in enumerate((ports.serial0, ports.serial1, ports.serial2))
        }
        for n in (1, 2):
            self.station[n].say(companion_heartbeat())
            self.companion[n].say(companion_heartbeat())
            for number in range(3):
                self.serial[n, number].say(autopilot_heartbeat())
        for end in self.node.values():
            end.tunnel(text=b"")
        self.settle()
        for end in self.ends:
            end.heard()

    @property
    def ends(self) -> list[End]:
        wired = (self.node, self.companion, self.station, self.serial)
        return [end for ends in wired for end in ends.values()]

    def settle(self) -> None:
        """What has been sent on this machine's own network lies in the sockets already: handle all of it."""
        for _ in range(3):
            self.air.wires.poll(0.0)

    def fly(self, node: int, x: float, y: float, height: float = 10.0) -> None:
        place = to_earth(x, y)
        self.serial[node, 0].say(sim_state(*place, ORIGIN[2] + height, (0.0, 0.0, 0.0)))
        self.settle()
        self.air.look(0.0)


@pytest.fixture
def wire_up(tmp_path: Path) -> Iterator[Callable[..., Wiring]]:
    made: list[Wiring] = []

    def make(*, through: bool = False, readings: bool = False) -> Wiring:
        track = tmp_path / f"track-{len(made)}.csv"
        order = AirOrder(SCENARIO, through=through, readings=readings, trajectories=str(track))
        made.append(Wiring(FlightAir(order), track))
        return made[-1]

    yield make
    for one in made:
        one.air.close()
        for end in one.ends:
            end.close()


def test_range_is_that_between_true_places(wire_up: Callable[..., Wiring]) -> None:
    d = wire_up()
    # It believes to be at the base; the simulator knows better.
    d.serial[1, 0].say(global_position_int(*to_earth(0.0, 0.0), ORIGIN[2], 0.0, 1000))
    d.fly(1, 51.0, 0.0)
    d.node[1].tunnel()
    d.settle()
    assert d.node[0].tunnels() == []
    d.fly(1, 49.9, 0.0)
    d.node[1].tunnel()
    d.node[0].tunnel()
    d.settle()
    assert d.node[0].tunnels() == [system_id(1)]
    assert d.node[1].tunnels() == [system_id(0)]
    assert d.node[2].tunnels() == []
    d.fly(2, 49.0, 49.0)
    d.node[1].tunnel()
    d.settle()
    assert [d.node[n].tunnels() for n in (0, 1, 2)] == [[system_id(1)], [], [system_id(1)]]
    figures = d.air.figures()
    assert (figures.sent, figures.received, figures.telemetry) == (4 + 3, 1 + 1 + 2, 0)


def test_the_track_holds_true_places_and_levels(wire_up: Callable[..., Wiring]) -> None:
    d = wire_up()
    d.fly(1, 100.0, 20.0, 10.0)
    d.fly(1, 100.0, 30.0, 20.0)
    figures = d.air.figures()
    d.air.close()
    with d.track.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["node"]) for row in rows] == [1, 1]
    places = [[float(row[axis]) for axis in ("x", "y", "height")] for row in rows]
    # Degrees times 1e7 are good to a centimetre.
    assert places[0] == pytest.approx([100.0, 20.0, 10.0], abs=0.02)
    assert places[1] == pytest.approx([100.0, 30.0, 20.0], abs=0.02)
    # 200 / (1 + 0.01 d^2), the height counted in: 10 m beside and 10 m up, and 20 m straight up.
    assert [float(row["level"]) for row in rows] == pytest.approx([200 / 3, 200 / 5], rel=1e-3)
    flew = (figures.flew_m[1], figures.farthest_m[1], figures.highest_m[1])
    assert flew == pytest.approx((30.0, 30.0, 20.0), abs=0.05)
    assert figures.truth == [0, 2, 0]


def test_readings_come_as_the_autopilots_own(wire_up: Callable[..., Wiring]) -> None:
    d = wire_up(readings=True)
    d.fly(1, 100.0, 30.0, 10.0)  # the first look of all says the readings too
    d.companion[1].heard()
    d.air.look(1.5)
    frames = d.companion[1].heard()
    assert [frame.message_id for frame in frames] == [NAMED_VALUE_FLOAT]
    node = Telemetry(system_id(1))
    assert node.handle(frames[0], 0.0)
    assert some(node.reading).value == pytest.approx(200 / 2, rel=1e-3)
    d.air.look(1.6)  # once a second
    assert d.companion[1].heard() == []
    quiet = wire_up(readings=False)
    quiet.air.look(1.5)
    assert quiet.companion[1].heard() == []


def test_cables_carry_everything_verbatim(wire_up: Callable[..., Wiring]) -> None:
    d = wire_up()
    for one, other in (
        (d.companion[1], d.serial[1, 2]),
        (d.serial[1, 2], d.companion[1]),
        (d.station[1], d.serial[1, 0]),
        (d.serial[1, 0], d.station[1]),
    ):
        one.say(autopilot_heartbeat())
        d.settle()
        assert [frame.message_id for frame in other.heard()] == [HEARTBEAT]
    assert not any(end.heard() for end in d.ends)
    # What a vehicle repeats of others is not for its ground station: that has a wire to each.
    d.serial[1, 0].writer = FrameWriter(system_id(2), 1)
    d.serial[1, 0].say(autopilot_heartbeat())
    d.settle()
    assert d.station[1].heard() == []


def test_through_the_autopilots_telem1_is_the_radio(wire_up: Callable[..., Wiring]) -> None:
    d = wire_up(through=True)
    d.fly(1, 30.0, 0.0)
    d.fly(2, 0.0, 30.0)
    d.serial[1, 1].writer = FrameWriter(system_id(1), 191)
    raw = d.serial[1, 1].writer.tunnel(b"one", payload_type=SCENARIO.mavlink.payload_type)
    # An autopilot puts several frames into one datagram.
    d.serial[1, 1].put(raw + FrameWriter(system_id(1), 1).message(autopilot_heartbeat()))
    d.settle()
    for end in (d.serial[2, 1], d.node[0]):
        assert [(f.message_id, f.component_id) for f in end.heard()] == [(TUNNEL, 191), (HEARTBEAT, 1)]
    assert not any(end.heard() for end in (d.node[1], d.node[2], d.serial[1, 1], d.companion[2]))
    d.node[0].tunnel()
    d.settle()
    assert [d.serial[n, 1].tunnels() for n in (1, 2)] == [[system_id(0)]] * 2
    # The heartbeats at the start were on the air as well.
    assert d.air.figures().telemetry == 1 + 2
    d.fly(2, 0.0, 90.0)
    d.serial[1, 1].put(raw)
    d.settle()
    assert d.serial[2, 1].tunnels() == []


def test_beside_the_autopilots_telem1_is_not_on_the_air(wire_up: Callable[..., Wiring]) -> None:
    d = wire_up()
    d.fly(1, 30.0, 0.0)
    before = d.air.figures().sent
    d.serial[1, 1].tunnel()
    d.settle()
    assert d.air.figures().sent == before
    assert d.node[0].heard() == []


def test_it_asks_for_the_truth_until_it_is_heard(wire_up: Callable[..., Wiring]) -> None:
    d = wire_up()
    d.air.look(0.0)
    asked = [parse(frame) for frame in d.serial[1, 0].heard()]
    assert (common.MAV_CMD_SET_MESSAGE_INTERVAL, SIM_STATE) in {(m.command, int(m.param1)) for m in asked}
    assert {m.target_system for m in asked} == {system_id(1)}


def test_px4_has_ports_of_its_own(tmp_path: Path) -> None:
    order = AirOrder(SCENARIO, px4=True, trajectories=str(tmp_path / "track.csv"))
    try:
        air = FlightAir(order)
    except LinkError as error:
        pytest.skip(f"PX4's ports are in use here: {error}")
    try:
        ports = air.ports
        assert ports.serial0 == ports.serial2 == [0, 14541, 14542]
        vehicle = End(system_id(1), 1, 14541)
        truth = End(system_id(1), 1, 19411)
        companion = End(system_id(1), 191, ports.vehicle[1])
        station = End(245, 190, ports.station[1])
        for end in (companion, station):
            end.say(companion_heartbeat())
        vehicle.say(autopilot_heartbeat())
        latitude, longitude = to_earth(20.0, 10.0)
        place = round(latitude * 1e7), round(longitude * 1e7), round((ORIGIN[2] + 5) * 1000)
        still = [0] * 8
        truth.say(common.MAVLink_hil_state_quaternion_message(0, [1.0, 0, 0, 0], 0, 0, 0, *place, *still))
        for _ in range(3):
            air.wires.poll(0.0)
        assert [end.heard()[0].message_id for end in (companion, station)] == [HEARTBEAT, HEARTBEAT]
        assert air.places[1] == pytest.approx((20.0, 10.0, 5.0), abs=0.02)
        for end in (vehicle, truth, companion, station):
            end.close()
    finally:
        air.close()


def test_px4s_radio_is_a_link_of_its_own(tmp_path: Path) -> None:
    """It repeats on it what others say to it, also its ground station. That is not on the air."""
    near = replace(SCENARIO, radio=RadioSection(range_m=500))
    order = AirOrder(near, through=True, px4=True, trajectories=str(tmp_path / "track.csv"))
    try:
        air = FlightAir(order)
    except LinkError as error:
        pytest.skip(f"PX4's ports are in use here: {error}")
    try:
        ports = air.ports
        assert ports.serial1 == [0, 14031, 14032]
        assert ports.serial0 == ports.serial2 == [0, 14541, 14542]
        radios = [End(system_id(node), 1, 14030 + node) for node in (1, 2)]
        base = End(system_id(0), 191, ports.air[0])
        ends = [*radios, base]

        def heard() -> list[list[tuple[int, int]]]:
            for _ in range(3):
                air.wires.poll(0.0)
            return [[(frame.system_id, frame.message_id) for frame in end.heard()] for end in ends]

        for end in ends:
            end.say(companion_heartbeat())
        heard()
        first = system_id(1)
        radios[0].say(autopilot_heartbeat())
        assert heard() == [[], [(first, HEARTBEAT)], [(first, HEARTBEAT)]]
        radios[0].tunnel()
        assert heard() == [[], [(first, TUNNEL)], [(first, TUNNEL)]]
        radios[0].put(FrameWriter(245, 190).message(companion_heartbeat()))
        assert heard() == [[], [], []]
        for end in ends:
            end.close()
    finally:
        air.close()


def test_arena_and_earth_are_inverse() -> None:
    for x, y in ((0.0, 0.0), (123.4, -567.8), (-5000.0, 4000.0)):
        assert to_arena(*to_earth(x, y)) == pytest.approx((x, y), abs=1e-6)

"""The mock of ArduCopter's SITL binary: it flies missions, and passes frames on as ArduPilot was measured to do."""

from __future__ import annotations

import math
from collections.abc import Iterator

import pytest

from rass_mav.errors import ConfigError
from rass_mav.lab.sitl.mission import (
    CMD_ARM,
    CMD_RETURN,
    CMD_SET_MODE,
    CMD_SPEED,
    CMD_START,
    CMD_TAKEOFF,
    CMD_WAYPOINT,
    FRAME_GLOBAL,
    FRAME_NO_PLACE,
    FRAME_RELATIVE,
    SIM_STATE,
    MissionItem,
    true_place,
)
from rass_mav.lab.sitl.mock_copter import (
    AUTO,
    CLIMB_M_S,
    FIX_S,
    GUIDED,
    LOITER,
    MAX_ROUTES,
    STABILIZE,
    MockCopter,
    MockFlight,
    SerialPort,
    mode_after_boot,
    read_defaults,
)
from rass_mav.mavlink.dialect import common
from rass_mav.mavlink.frames import FrameWriter
from rass_mav.mavlink.messages import (
    COMMAND_ACK,
    GLOBAL_POSITION_INT,
    HEARTBEAT,
    TUNNEL,
    companion_heartbeat,
    parse,
    set_message_interval,
)

from .ends import End

HOME = (45.0, -73.0, 100.0)
NORTH_100_M = 100 / 111_319.5
OWN = 2
MISSION_REQUEST_INT = common.MAVLINK_MSG_ID_MISSION_REQUEST_INT
ACCEPTED, REJECTED = common.MAV_RESULT_ACCEPTED, common.MAV_RESULT_TEMPORARILY_REJECTED

ITEMS = [
    MissionItem(CMD_WAYPOINT, FRAME_GLOBAL, *HOME),
    MissionItem(CMD_TAKEOFF, FRAME_RELATIVE, *HOME[:2], 10.0),
    MissionItem(CMD_SPEED, FRAME_NO_PLACE, param1=1.0, param2=10.0),
    MissionItem(CMD_WAYPOINT, FRAME_RELATIVE, HOME[0] + NORTH_100_M, HOME[1], 10.0, param1=3.0),
    MissionItem(CMD_RETURN, FRAME_NO_PLACE),
]


# -- how it flies ------------------------------------------------------------------------------------------------------


def under_way() -> MockFlight:
    flight = MockFlight(HOME, mode=GUIDED)
    flight.load(ITEMS)
    assert flight.arm()
    assert flight.start()
    return flight


def test_a_mission_takes_as_long_as_its_ways_at_their_speeds() -> None:
    flight = under_way()
    reached: dict[int, int] = {}
    for tick in range(1, 2000):
        for number in flight.fly(0.05):
            reached[number] = tick
        assert 0 <= flight.height <= 10 + 1e-6
        assert -1e-6 <= flight.y <= 100 + 1e-6
        assert abs(flight.x) < 1e-6
    up, out, stay = 10 / CLIMB_M_S, 100 / 10, 3
    expected = {1: up, 2: up, 3: up + out + stay, 4: up + out + stay + out + up}
    assert {n: tick * 0.05 for n, tick in reached.items()} == pytest.approx(expected, abs=0.11)
    assert (flight.y, flight.height, flight.armed, flight.current) == (0.0, 0.0, False, len(ITEMS) - 1)


def test_long_and_short_turns_lead_to_the_same_place() -> None:
    coarse, fine = under_way(), under_way()
    coarse.fly(9.0)
    for _ in range(900):
        fine.fly(0.01)
    assert (coarse.y, coarse.height) == pytest.approx((fine.y, fine.height), abs=1e-3)
    assert coarse.y == pytest.approx((9.0 - 10 / CLIMB_M_S) * 10.0, abs=1e-3)


def test_the_velocity_is_that_of_the_last_turn() -> None:
    flight = under_way()
    flight.fly(2.0)
    assert flight.velocity == pytest.approx((0.0, 0.0, -CLIMB_M_S))
    flight.fly(4.0)
    flight.fly(1.0)
    assert flight.velocity == pytest.approx((10.0, 0.0, 0.0), abs=1e-6)


def test_it_stays_on_the_ground_until_it_is_told_to_start() -> None:
    flight = MockFlight(HOME, mode=STABILIZE)
    assert not flight.set_mode(AUTO)  # no mission
    flight.load(ITEMS)
    assert not flight.start()  # not armed
    assert flight.set_mode(AUTO)
    assert not flight.arm()  # not in this mode
    assert flight.set_mode(LOITER)
    assert flight.arm()
    assert flight.set_mode(AUTO)
    flight.fly(10.0)
    assert flight.height == 0.0
    assert flight.start()
    flight.fly(1.0)
    assert flight.height == pytest.approx(CLIMB_M_S)


# -- what it says ------------------------------------------------------------------------------------------------------


class Copter:
    """A vehicle and who is at its three ports, all of whom have heard its first heartbeat."""

    def __init__(self, closed: tuple[int, ...]) -> None:
        """`closed`: the ports that do not forward."""
        self.ends = [End(255, 190) for _ in range(3)]
        self.ground, self.radio, self.companion = self.ends
        ports = [SerialPort(n, end.address, OWN, n not in closed) for n, end in enumerate(self.ends)]
        self.mock = MockCopter(OWN, MockFlight(HOME, mode=GUIDED), ports)
        self.mock.tick(0.0)
        for end in self.ends:
            assert [frame.message_id for frame in end.heard()] == [HEARTBEAT]

    def listen(self) -> None:
        for port in self.mock.ports:
            self.mock.hear(port)

    def command(self, command: int, *params: float) -> None:
        """From the ground station."""
        self.ground.say(common.MAVLink_command_long_message(OWN, 1, command, 0, *params, *[0.0] * (7 - len(params))))

    def answers(self) -> list[tuple[int, int]]:
        """To the ground station."""
        return [(m.command, m.result) for m in map(parse, self.ground.heard()) if m.get_msgId() == COMMAND_ACK]

    def close(self) -> None:
        for end in self.ends:
            end.close()
        for port in self.mock.ports:
            port.sock.close()


@pytest.fixture
def closed() -> tuple[int, ...]:
    """The ports that do not forward."""
    return ()


@pytest.fixture
def copter(closed: tuple[int, ...]) -> Iterator[Copter]:
    copter = Copter(closed)
    yield copter
    copter.close()


def test_it_takes_a_mission_item_by_item(copter: Copter) -> None:
    copter.ground.say(common.MAVLink_mission_count_message(OWN, 1, 2))
    copter.listen()
    for number in (0, 1):
        (asked,) = map(parse, copter.ground.heard())
        assert (asked.get_msgId(), asked.seq) == (MISSION_REQUEST_INT, number)
        assert (asked.target_system, asked.target_component) == (255, 190)
        item = ITEMS[number]
        place = round(item.latitude * 1e7), round(item.longitude * 1e7), item.altitude
        copter.ground.say(
            common.MAVLink_mission_item_int_message(OWN, 1, number, item.frame, item.command, 0, 1, 0, 0, 0, 0, *place)
        )
        copter.listen()
    (done,) = map(parse, copter.ground.heard())
    assert (done.get_msgId(), done.type) == (common.MAVLINK_MSG_ID_MISSION_ACK, common.MAV_MISSION_ACCEPTED)
    assert [item.command for item in copter.mock.flight.items] == [CMD_WAYPOINT, CMD_TAKEOFF]
    assert copter.mock.flight.items[1].altitude == 10.0


def test_it_arms_only_with_a_position(copter: Copter) -> None:
    copter.mock.flight.load(ITEMS)
    copter.ground.say(set_message_interval(GLOBAL_POSITION_INT, 0.5, target_system=OWN, target_component=1))
    copter.command(CMD_ARM, 1.0)
    copter.listen()
    copter.mock.tick(FIX_S / 2)
    heard = copter.ground.heard()
    acks = [(m.command, m.result) for m in map(parse, heard) if m.get_msgId() == COMMAND_ACK]
    assert acks == [(511, ACCEPTED), (CMD_ARM, REJECTED)]
    (before,) = (parse(frame) for frame in heard if frame.message_id == GLOBAL_POSITION_INT)
    assert (before.lat, before.lon) == (0, 0)
    copter.mock.tick(FIX_S)
    copter.ground.heard()
    copter.command(CMD_ARM, 1.0)
    copter.command(CMD_SET_MODE, 1.0, AUTO)
    copter.command(CMD_START)
    copter.command(12345)
    copter.listen()
    expected = [(c, ACCEPTED) for c in (CMD_ARM, CMD_SET_MODE, CMD_START)]
    assert copter.answers() == [*expected, (12345, common.MAV_RESULT_UNSUPPORTED)]
    assert copter.mock.flight.armed


def test_rates_are_those_that_were_asked_for_on_that_port(copter: Copter) -> None:
    copter.ground.say(set_message_interval(SIM_STATE, 0.1, target_system=OWN, target_component=1))
    copter.listen()
    for tick in range(1, 41):
        copter.mock.tick(tick * 0.05)
    said = [frame for frame in copter.ground.heard() if frame.message_id == SIM_STATE]
    assert len(said) == pytest.approx(20, abs=1)
    assert true_place(said[-1]) == pytest.approx(HOME, abs=1e-6)
    assert {frame.message_id for frame in copter.companion.heard()} == {HEARTBEAT}


# -- what it passes on -------------------------------------------------------------------------------------------------


def test_broadcasts_go_to_ports_that_were_heard_and_never_back(copter: Copter) -> None:
    copter.companion.writer = FrameWriter(OWN, 191)
    copter.companion.tunnel()
    copter.listen()
    assert [end.tunnels() for end in copter.ends] == [[], [], []]  # nobody else has spoken yet
    copter.radio.writer = FrameWriter(3, 1)
    copter.radio.say(companion_heartbeat())
    copter.listen()
    raw = copter.companion.tunnel()
    copter.listen()
    (frame,) = (frame for frame in copter.radio.heard() if frame.message_id == TUNNEL)
    # Verbatim: the sender's own sequence, too.
    assert (frame.system_id, frame.component_id, frame.sequence) == (OWN, 191, raw[4])
    assert [end.tunnels() for end in (copter.ground, copter.companion)] == [[], []]


def test_targeted_frames_go_where_the_target_was_heard(copter: Copter) -> None:
    copter.radio.writer, copter.companion.writer = FrameWriter(3, 191), FrameWriter(OWN, 191)
    for end in copter.ends:
        end.say(companion_heartbeat())
    copter.listen()
    for end in copter.ends:
        end.heard()
    copter.companion.tunnel(3, 191)
    copter.companion.tunnel(9, 191)  # never heard
    copter.companion.tunnel(OWN, 1)  # the autopilot keeps it
    copter.radio.tunnel(OWN, 191)
    copter.listen()
    assert [end.tunnels() for end in copter.ends] == [[], [OWN], [3]]


@pytest.mark.parametrize("closed", [(0,)])
def test_a_port_may_be_left_out(copter: Copter) -> None:
    for end in copter.ends:
        end.say(companion_heartbeat())
    copter.listen()
    for end in copter.ends:
        end.heard()
    copter.ground.tunnel()
    copter.companion.tunnel()
    copter.listen()
    assert [len(end.tunnels()) for end in copter.ends] == [0, 1, 0]


def test_it_remembers_twenty_senders(copter: Copter) -> None:
    for system in range(10, 10 + MAX_ROUTES + 1):
        copter.radio.writer = FrameWriter(system, 191)
        copter.radio.say(companion_heartbeat())
    copter.companion.say(companion_heartbeat())
    copter.listen()
    copter.radio.heard()
    copter.companion.tunnel(10 + MAX_ROUTES - 1, 191)
    copter.companion.tunnel(10 + MAX_ROUTES, 191)
    copter.listen()
    assert len(copter.radio.tunnels()) == 1


def test_garbage_does_no_harm(copter: Copter) -> None:
    good = copter.companion.tunnel()
    for data in (b"", b"\xfd", b"\x00" * 300, good[:-1], good[:5] + bytes([good[5] ^ 1]) + good[6:], b"junk" + good):
        copter.companion.put(data)
        copter.listen()
    assert copter.ground.heard() == []
    copter.mock.tick(math.nextafter(1.0, 2.0))
    assert HEARTBEAT in {frame.message_id for frame in copter.companion.heard()}


def test_without_a_position_a_mission_does_not_begin(copter: Copter) -> None:
    copter.mock.flight.load(ITEMS)
    assert copter.mock.flight.set_mode(STABILIZE)
    for command, params, result in [
        (CMD_SET_MODE, (1, AUTO), REJECTED),
        (CMD_SET_MODE, (1, GUIDED), REJECTED),
        (CMD_SET_MODE, (1, STABILIZE), ACCEPTED),
        (CMD_ARM, (1,), ACCEPTED),
        (CMD_START, (), REJECTED),
    ]:
        copter.command(command, *params)
        copter.listen()
        assert copter.answers() == [(command, result)]
    copter.mock.tick(FIX_S)
    copter.command(CMD_START)
    copter.listen()
    assert (CMD_START, ACCEPTED) in copter.answers()


@pytest.mark.parametrize(
    ("values", "mode"),
    [
        ({}, STABILIZE),
        # The switch of the simulated radio control.
        ({"INITIAL_MODE": GUIDED}, STABILIZE),
        ({"INITIAL_MODE": GUIDED, "FLTMODE_CH": 5}, STABILIZE),
        ({"INITIAL_MODE": GUIDED, "FLTMODE_CH": 0}, GUIDED),
    ],
)
def test_the_mode_switch_overrules_the_mode_after_power_up(values: dict[str, float], mode: int) -> None:
    assert mode_after_boot(values) == mode


def test_the_defaults_file(tmp_path: object) -> None:
    path = f"{tmp_path}/some.parm"
    with open(path, "w", encoding="utf-8") as file:
        file.write("# of us\nMAV_SYSID 7\nINITIAL_MODE\t4 # guided\n\nFOO,1.5\n")
    assert read_defaults(path) == {"MAV_SYSID": 7.0, "INITIAL_MODE": 4.0, "FOO": 1.5}
    with open(path, "a", encoding="utf-8") as file:
        file.write("BAR many\n")
    with pytest.raises(ConfigError, match="line 6: expected a name and a number"):
        read_defaults(path)

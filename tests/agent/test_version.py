"""The autopilot's version: when it is asked for, and what is not said by way of a firmware that would drop it."""

from __future__ import annotations

from typing import Any

import pytest

from rass_mav.lab.swarm.autopilot import autopilot_heartbeat
from rass_mav.mavlink import component as mav
from rass_mav.mavlink.dialect import common
from rass_mav.mavlink.firmware import ARDUPILOT, PX4, Firmware
from rass_mav.mavlink.frames import FrameWriter
from rass_mav.mavlink.messages import COMMAND_ACK, COMMAND_LONG, parse
from rass_mav.mavlink.signing import Signer
from rass_mav.station.version import VersionQuestion
from tests.agent.build import make, to_vehicle
from tests.telemetry import global_position_int

from .conversation import Conversation, kinds


def told_version(version: tuple[int, int, int]) -> Any:
    number = int.from_bytes([*version, 255], "big")
    return common.MAVLink_autopilot_version_message(0, number, 0, 0, 0, bytes(8), bytes(8), bytes(8), 0, 0, 0)


class Flight:
    """An agent, and an autopilot that speaks once a second."""

    def __init__(self) -> None:
        self.agent = make(3)
        self.agent.services.append(VersionQuestion(self.agent))
        self.writer = FrameWriter(7, 1)
        self.now = 0.0

    def say(self, message: Any) -> None:
        self.agent.vehicle_bytes(self.writer.message(message), self.now)

    def asked(self, seconds: int) -> list[float]:
        """When the version was asked for in so many seconds, in which the autopilot's heart beats."""
        times = []
        for _ in range(seconds):
            self.now += 1.0
            self.say(autopilot_heartbeat())
            for frame in to_vehicle(self.agent.step(self.now)):
                if frame.message_id == COMMAND_LONG:
                    command = parse(frame)
                    assert (command.command, command.param1) == (mav.CMD_REQUEST_MESSAGE, mav.AUTOPILOT_VERSION)
                    assert (command.target_system, command.target_component) == (7, 1)
                    times.append(self.now)
        return times


def test_it_is_asked_for_more_and_more_seldom_until_it_is_told() -> None:
    flight = Flight()
    assert to_vehicle(flight.agent.step(0.5))[1:] == []
    assert flight.asked(20) == [1.0, 2.0, 4.0, 8.0, 16.0]
    assert flight.agent.telemetry.firmware == Firmware(ARDUPILOT)
    flight.say(told_version((4, 6, 3)))
    assert flight.asked(300) == []
    assert str(flight.agent.telemetry.firmware) == "ArduPilot 4.6.3"


def test_after_a_restart_and_when_signatures_begin_it_is_asked_for_again() -> None:
    flight = Flight()
    flight.say(autopilot_heartbeat())
    flight.say(told_version((4, 6, 3)))
    flight.say(global_position_int(45.0, -73.0, 100.0, 10.0, 100_000))
    flight.asked(1)
    flight.say(told_version((4, 6, 3)))
    assert flight.asked(9) == []
    flight.say(global_position_int(45.0, -73.0, 100.0, 10.0, 10))
    assert len(flight.asked(1)) == 1
    flight.say(told_version((4, 8, 0)))
    assert flight.asked(9) == []
    flight.writer.signer = Signer(bytes(32), link_id=0, timestamp=1)
    assert len(flight.asked(3)) == 2
    assert flight.agent.telemetry.signed
    assert flight.agent.telemetry.version is None


@pytest.mark.parametrize(
    ("firmware", "error", "computer"),
    [
        (Firmware(ARDUPILOT), False, False),
        (Firmware(ARDUPILOT, (4, 6, 3)), False, False),
        (Firmware(ARDUPILOT, (4, 7, 0)), True, False),
        (Firmware(ARDUPILOT, (4, 8, 0)), True, True),
        (Firmware(PX4), True, True),
        (None, True, True),
    ],
)
def test_what_the_autopilot_would_drop_is_not_said_to_it(
    firmware: Firmware | None, error: bool, computer: bool
) -> None:
    c = Conversation(ground={"computer_s": 10.0})
    c.ground.computer = lambda: mav.ComputerStatus(5.0)
    if firmware is not None:
        autopilot = FrameWriter(7, 1)
        heartbeat = common.MAVLink_heartbeat_message(2, firmware.autopilot, 0, 0, 3, 3)
        c.agent.vehicle_bytes(autopilot.message(heartbeat), 0.0)
        if any(firmware.version):
            c.agent.vehicle_bytes(autopilot.message(told_version(firmware.version)), 0.0)

    def said(name: str, until: float, *, direct: bool = False) -> bool:
        return name in kinds(c.hear(until, direct=direct))

    assert said("ONBOARD_COMPUTER_STATUS", 5.0) is computer
    assert said("ONBOARD_COMPUTER_STATUS", 15.0, direct=True)
    for command in (mav.CMD_REQUEST_MESSAGE, mav.CMD_SET_MESSAGE_INTERVAL, mav.CMD_GET_MESSAGE_INTERVAL):
        (ack,) = [m for m in c.command(command, mav.ONBOARD_COMPUTER_STATUS, 10e6) if m.get_msgId() == COMMAND_ACK]
        assert (ack.result == mav.ACCEPTED) is computer, "what never comes is not promised"
    if mav.PARAM_ERROR is not None:
        for direct in (False, True):
            c.ask(common.MAVLink_param_request_read_message(7, 191, b"NOT_MINE", -1), direct=direct)
            assert said("PARAM_ERROR", c.now + 1.0, direct=direct) is (error or direct)

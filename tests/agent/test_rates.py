"""What the autopilot is asked for, and when again."""

from __future__ import annotations

from typing import Any

import pytest

from rass_mav.errors import ConfigError
from rass_mav.lab.swarm.autopilot import autopilot_heartbeat
from rass_mav.mavlink.dialect import common
from rass_mav.mavlink.frames import FrameWriter
from rass_mav.mavlink.messages import COMMAND_LONG, parse
from rass_mav.station.rates import MessageRates, message_ids
from tests.agent.build import make, to_vehicle
from tests.telemetry import global_position_int

GLOBAL, LOCAL = 33, 32


class Flight:
    """An autopilot that does what it is asked, step by step."""

    def __init__(self) -> None:
        self.agent = make(3)
        self.rates = MessageRates(self.agent, message_ids({"GLOBAL_POSITION_INT": 0.5, "LOCAL_POSITION_NED": 1.0}))
        self.agent.listeners.append(self.rates)
        self.agent.services.append(self.rates)
        self.writer = FrameWriter(7, 1)
        self.now = 0.0
        self.booted = 0.0
        self.granted: dict[int, float] = {}
        self.asked: list[int] = []
        self.answers = True
        self.result = common.MAV_RESULT_ACCEPTED

    def say(self, message: Any, writer: FrameWriter | None = None) -> None:
        self.agent.vehicle_bytes((writer or self.writer).message(message), self.now)

    def reboot(self) -> None:
        self.booted = self.now
        self.granted.clear()

    def second(self, *, heartbeat: bool = True) -> None:
        self.now += 1.0
        if heartbeat:
            self.say(autopilot_heartbeat())
            if GLOBAL in self.granted:
                boot_ms = int(1000 * (self.now - self.booted)) + 1
                self.say(global_position_int(45.0, -73.0, 100.0, 10.0, boot_ms))
        said = self.agent.step(self.now)
        for _ in range(5):  # an answer brings the next request
            for frame in to_vehicle(said):
                if frame.message_id == COMMAND_LONG:
                    self.hear(parse(frame))
            said, _ = self.agent.tend(self.now)

    def hear(self, request: Any) -> None:
        assert (request.command, request.target_system, request.target_component) == (511, 7, 1)
        self.asked.append(int(request.param1))
        if self.answers:
            if self.result == common.MAV_RESULT_ACCEPTED:
                self.granted[int(request.param1)] = request.param2 / 1e6
            self.say(common.MAVLink_command_ack_message(511, self.result, 0, 0, 7, 191))


def test_it_asks_when_the_autopilot_is_there_and_once() -> None:
    flight = Flight()
    flight.second(heartbeat=False)
    assert flight.asked == []
    for _ in range(4):
        flight.second()
    assert flight.asked == [GLOBAL, LOCAL]
    assert flight.granted == {GLOBAL: 0.5, LOCAL: 1.0}


def test_it_asks_again_after_a_reboot_that_shows_in_the_boot_time() -> None:
    flight = Flight()
    for _ in range(20):
        flight.second()
    flight.asked.clear()
    flight.booted = flight.now  # it goes on saying what it was asked for; only its clock tells
    flight.second()
    flight.second()
    assert flight.asked[:2] == [GLOBAL, LOCAL]


@pytest.mark.parametrize("silent_s", [0, 10])
def test_it_asks_again_after_a_reboot_that_shows_in_nothing_but_silence(silent_s: int) -> None:
    flight = Flight()
    for _ in range(20):
        flight.second()
    flight.asked.clear()
    flight.reboot()
    for _ in range(silent_s):
        flight.second(heartbeat=False)
    for _ in range(8):
        flight.second()
    assert GLOBAL in flight.granted
    assert GLOBAL in flight.asked


def test_without_an_answer_it_repeats_ever_more_seldom() -> None:
    flight = Flight()
    flight.answers = False
    for _ in range(300):
        flight.second()
    assert 9 <= len(flight.asked) <= 20
    assert set(flight.asked) == {GLOBAL}
    flight.answers = True
    for _ in range(40):
        flight.second()
    assert flight.granted == {GLOBAL: 0.5, LOCAL: 1.0}


def test_a_refusal_is_accepted_until_the_next_reboot() -> None:
    flight = Flight()
    flight.result = common.MAV_RESULT_UNSUPPORTED
    for _ in range(60):
        flight.second()
    assert flight.asked == [GLOBAL, LOCAL]
    assert flight.rates.refused == {GLOBAL, LOCAL}


def test_a_message_that_never_comes_is_asked_for_seldom() -> None:
    flight = Flight()
    for _ in range(600):
        flight.second()
    # The local position never comes; the other one does.
    assert flight.asked.count(GLOBAL) == 1
    assert 10 <= flight.asked.count(LOCAL) <= 25


def test_answers_of_others_and_to_others_count_for_nothing() -> None:
    flight = Flight()
    flight.answers = False
    flight.second()
    flight.say(common.MAVLink_command_ack_message(511, 0, 0, 0, 7, 191), FrameWriter(8, 1))
    flight.say(common.MAVLink_command_ack_message(511, 0, 0, 0, 99, 191))
    flight.say(common.MAVLink_command_ack_message(400, 0, 0, 0, 7, 191))
    flight.second()
    flight.second()
    assert set(flight.asked) == {GLOBAL}


def test_an_unknown_name_is_said() -> None:
    with pytest.raises(ConfigError, match="GLOBAL_POSITON: not a message"):
        message_ids({"GLOBAL_POSITON": 1.0})

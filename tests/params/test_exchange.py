"""Asking for parameters in virtual time: pace, retries, silence, encodings. And what the encodings are on the wire."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common

from rass_mav.errors import MalformedError
from rass_mav.lab.swarm.autopilot import autopilot_heartbeat
from rass_mav.mavlink.firmware import ARDUPILOT, PX4
from rass_mav.mavlink.frames import Frame, FrameReader, FrameWriter
from rass_mav.mavlink.messages import COMMAND_LONG, companion_heartbeat
from rass_mav.mavlink.vehicle_parameters import (
    ParameterValue,
    fits,
    is_bytewise,
    param_set,
    read_value,
    same,
)
from rass_mav.params.exchange import Autopilot, Exchange, Introduction, Patience, Question, reading, setting

INT32, REAL32 = 6, 9
PATIENCE = Patience(answer_s=1.0, tries=3, window=2)
_parser = common.MAVLink(None)


def frame_of(message: object, system_id: int = 1, component_id: int = 1) -> Frame:
    (frame,) = FrameReader().feed(FrameWriter(system_id, component_id).message(message))
    return frame


def value_frame(name: str, value: float, kind: int = REAL32, system_id: int = 1) -> Frame:
    return frame_of(common.MAVLink_param_value_message(name.encode(), value, kind, 10, 0), system_id)


def asked(questions: list[Question]) -> list[str]:
    """The names in questions, as pymavlink reads them."""
    names = []
    for question in questions:
        (message,) = _parser.parse_buffer(FrameWriter(1, 191).frame(*question))
        names.append(message.param_id)
    return names


def three(autopilot: Autopilot) -> Exchange:
    return Exchange(autopilot, {name: reading(autopilot, name) for name in ("A", "B", "C")}, PATIENCE)


def test_questions_leave_a_few_at_a_time_and_are_repeated_only_when_unanswered() -> None:
    talk = three(Autopilot(1, ARDUPILOT, armed=False))
    assert asked(talk.say(0.0)) == ["A", "B"]
    assert talk.say(0.5) == []
    talk.hear(value_frame("A", 1.5), 0.6)
    assert talk.next_at == 0.6
    assert asked(talk.say(0.6)) == ["C"]
    assert talk.next_at == 1.0
    assert asked(talk.say(1.0)) == ["B"]
    talk.hear(value_frame("C", 2.0), 1.1)
    assert asked(talk.say(2.0)) == ["B"]
    assert not talk.done
    assert talk.say(3.0) == []
    assert talk.done
    assert talk.silent == ["B"]
    assert talk.values == {"A": ("A", 1.5, REAL32), "C": ("C", 2.0, REAL32)}


def test_answers_of_others_and_answers_to_nothing_are_passed_over() -> None:
    talk = three(Autopilot(1, ARDUPILOT, armed=False))
    talk.say(0.0)
    talk.hear(value_frame("A", 1.0, system_id=2), 0.1)
    talk.hear(frame_of(common.MAVLink_param_value_message(b"A", 1.0, REAL32, 1, 0), 1, 191), 0.1)
    talk.hear(value_frame("Z", 1.0), 0.1)
    talk.hear(value_frame("A", 1.0, kind=99), 0.1)
    assert talk.values == {}
    talk.hear(frame_of(common.MAVLink_param_error_message(1, 191, b"A", -1, 1)), 0.2)
    assert talk.refused == {"A": 1}


def test_nothing_to_ask_is_done_at_once() -> None:
    assert Exchange(Autopilot(1, ARDUPILOT, armed=False), {}, PATIENCE).done


def test_an_autopilot_that_takes_a_new_id_is_known_by_it() -> None:
    autopilot = Autopilot(1, ARDUPILOT, armed=False)
    question = setting(autopilot, ParameterValue("SYSID_THISMAV", 7, 4))
    talk = Exchange(autopilot, {"SYSID_THISMAV": question}, PATIENCE, new_system_id=7)
    talk.say(0.0)
    talk.hear(value_frame("SYSID_THISMAV", 7.0, 4, system_id=7), 0.1)
    assert talk.done
    assert autopilot.system_id == 7


def test_introduction_waits_for_the_autopilot_that_is_meant() -> None:
    talk = Introduction(3, PATIENCE)
    assert talk.say(0.0) == []
    talk.hear(frame_of(companion_heartbeat(), 3, 191), 0.1)
    talk.hear(frame_of(companion_heartbeat(), 3, 1), 0.1)
    talk.hear(frame_of(autopilot_heartbeat(), 2), 0.2)
    assert (talk.autopilot, talk.others) == (None, {2})
    talk.hear(frame_of(autopilot_heartbeat(armed=True), 3), 0.3)
    assert talk.autopilot is not None
    assert (talk.autopilot.system_id, talk.autopilot.type, talk.autopilot.armed) == (3, ARDUPILOT, True)
    assert [question.message_id for question in talk.say(0.3)] == [COMMAND_LONG]
    number = int.from_bytes([4, 7, 1, 255], "big")
    rest = (0, 0, 0, bytes(8), bytes(8), bytes(8), 0, 0, 0)
    talk.hear(frame_of(common.MAVLink_autopilot_version_message(131072, number, *rest), 3), 0.4)
    assert talk.done
    assert talk.autopilot.version.version == (4, 7, 1)


def test_an_autopilot_that_does_not_tell_its_version_is_taken_as_it_is() -> None:
    talk = Introduction(0, PATIENCE)
    talk.hear(frame_of(autopilot_heartbeat(), 9), 0.0)
    sent = [len(talk.say(at)) for at in (0.0, 1.0, 2.0, 3.0)]
    assert sent == [1, 1, 1, 0]
    assert talk.done
    assert talk.autopilot is not None
    assert talk.autopilot.version.version == (0, 0, 0)
    assert not talk.autopilot.bytewise


@pytest.mark.parametrize(
    ("capabilities", "autopilot", "bytewise"),
    [
        (0, ARDUPILOT, False), (0, PX4, True), (131072, PX4, False), (2, PX4, False), (16, ARDUPILOT, True),
        (0, 0, False),
    ],
)  # fmt: skip
def test_capabilities_decide_how_whole_numbers_travel_and_then_the_heartbeat(
    capabilities: int, autopilot: int, bytewise: bool
) -> None:
    assert is_bytewise(capabilities, autopilot) is bytewise


@given(st.integers(-(2**31), 2**31 - 1))
def test_whole_numbers_of_px4_travel_bit_for_bit(value: int) -> None:
    payload = param_set("MAV_1_RATE", value, INT32, bytewise=True, target_system=1, target_component=1)
    assert payload[:4] == struct.pack("<i", value)
    (message,) = _parser.parse_buffer(FrameWriter(1, 191).frame(23, payload))
    assert (message.param_id, message.param_type, message.target_component) == ("MAV_1_RATE", INT32, 1)
    # And back: the same four bytes in a PARAM_VALUE, whose name is a neighbour of the value on the wire.
    payload = struct.pack("<iHH16sB", value, 100, 1, b"MAV_1_RATE", INT32)
    (frame,) = FrameReader().feed(FrameWriter(1, 1).frame(22, payload))
    assert read_value(frame, bytewise=True) == ("MAV_1_RATE", value, INT32)


@given(st.floats(width=32, allow_nan=False, allow_infinity=False), st.booleans())
def test_floats_travel_alike_with_both(value: float, bytewise: bool) -> None:
    payload = param_set("X", value, REAL32, bytewise=bytewise, target_system=1, target_component=1)
    (message,) = _parser.parse_buffer(FrameWriter(1, 191).frame(23, payload))
    assert message.param_value == value
    assert read_value(value_frame("X", value), bytewise=bytewise).value == value


def test_ardupilot_casts() -> None:
    payload = param_set("SERIAL2_BAUD", 921, 4, bytewise=False, target_system=1, target_component=1)
    (message,) = _parser.parse_buffer(FrameWriter(1, 191).frame(23, payload))
    assert (message.param_value, message.param_type) == (921.0, 4)
    assert read_value(value_frame("SERIAL2_BAUD", 921.0, 4), bytewise=False) == ("SERIAL2_BAUD", 921, 4)
    with pytest.raises(MalformedError):
        read_value(value_frame("SERIAL2_BAUD", float("nan"), 4), bytewise=False)


def test_floats_are_compared_as_32_bits_hold_them() -> None:
    single = struct.unpack("<f", struct.pack("<f", 0.1))[0]
    assert single != 0.1
    assert same(0.1, single, REAL32, bytewise=True)
    assert not same(0.1, 0.2, REAL32, bytewise=True)
    # Bit for bit where the wire carries all bits; where it casts, nobody can tell these two apart.
    assert not same(16_777_217, 16_777_216, INT32, bytewise=True)
    assert same(16_777_217, 16_777_216, INT32, bytewise=False)


@pytest.mark.parametrize(
    ("value", "kind", "good"),
    [(255, 1, True), (256, 1, False), (-1, 1, False), (-128, 2, True), (1.5, INT32, False), (1.5, REAL32, True),
     (2**31, INT32, False), (1e39, REAL32, False)],
)  # fmt: skip
def test_what_a_type_can_hold(value: float, kind: int, good: bool) -> None:
    assert fits(value, kind) is good

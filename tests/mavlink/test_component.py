"""What a component says: packed here, read by pymavlink's own parser."""

from __future__ import annotations

import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.mavlink import component as mav
from rass_mav.mavlink.dialect import common
from rass_mav.mavlink.frames import FrameWriter
from rass_mav.mavlink.messages import COMMAND_ACK
from tests.some import some


def heard(message_id: int, payload: bytes) -> Any:
    """What pymavlink makes of a frame with this payload."""
    [message] = common.MAVLink(None).parse_buffer(FrameWriter(7, 191).frame(message_id, payload))
    return message


@given(st.floats(width=32, allow_nan=False), st.integers(1, 16), st.integers(0, 30))
def test_a_parameter_keeps_its_name_and_value(value: float, size: int, index: int) -> None:
    name = "RASS_RISK_STALEX"[:size]
    message = heard(mav.PARAM_VALUE, mav.param_value(name, value, 31, index))
    assert (message.param_id, message.param_value) == (name, value)
    assert (message.param_type, message.param_count, message.param_index) == (mav.REAL32, 31, index)


def test_an_acknowledgement_and_a_ping_name_who_asked() -> None:
    ack = heard(COMMAND_ACK, mav.command_ack(512, mav.DENIED, target_system=255, target_component=190))
    assert (ack.command, ack.result, ack.target_system, ack.target_component) == (512, mav.DENIED, 255, 190)
    ping = heard(mav.PING, mav.ping(123456789012, 5, target_system=255, target_component=190))
    assert (ping.time_usec, ping.seq, ping.target_system, ping.target_component) == (123456789012, 5, 255, 190)


def file_transfer(sequence: int, session: int, opcode: int, name: bytes = b"") -> bytes:
    """The payload of a request, as https://mavlink.io/en/services/ftp.html has it."""
    return struct.pack("<HBBBBBBI", sequence, session, opcode, len(name), 0, 0, 0, 0) + name.ljust(239, b"\0")


def test_a_refused_file_transfer_says_which_request_it_answers() -> None:
    request = file_transfer(0xFFFF, 3, common.MAV_FTP_OPCODE_OPENFILERO, b"@PARAM/param.pck")
    payload = some(mav.file_transfer_refusal(request, target_system=255, target_component=190))
    message = heard(mav.FILE_TRANSFER_PROTOCOL, payload)
    assert (message.target_network, message.target_system, message.target_component) == (0, 255, 190)
    said = bytes(message.payload)
    # The next number, the same session, one byte of data: the error.
    assert struct.unpack_from("<HBBBBBBI", said) == (0, 3, common.MAV_FTP_OPCODE_NAK, 1, 4, 0, 0, 0)
    assert said[12:] == bytes([common.MAV_FTP_ERR_UNKNOWNCOMMAND]).ljust(239, b"\0")


@pytest.mark.parametrize("opcode", [common.MAV_FTP_OPCODE_ACK, common.MAV_FTP_OPCODE_NAK])
def test_an_answer_of_a_file_transfer_is_not_refused(opcode: int) -> None:
    assert mav.file_transfer_refusal(file_transfer(1, 0, opcode), target_system=255, target_component=190) is None


@pytest.mark.skipif(mav.PARAM_ERROR is None, reason="this pymavlink has no PARAM_ERROR")
def test_a_refusal_says_why() -> None:
    payload = mav.param_error("NOT_MINE_AND_TOO_LONG", -1, mav.DOES_NOT_EXIST, target_system=255, target_component=1)
    error = heard(some(mav.PARAM_ERROR), payload)
    assert (error.param_id, error.param_index, error.error) == ("NOT_MINE_AND_TOO", -1, mav.DOES_NOT_EXIST)
    names = {value: entry.name for value, entry in common.enums["MAV_PARAM_ERROR"].items()}
    assert names[mav.VALUE_OUT_OF_RANGE].endswith("VALUE_OUT_OF_RANGE")
    assert names[mav.PERMISSION_DENIED].endswith("PERMISSION_DENIED")
    assert names[mav.READ_ONLY].endswith("READ_ONLY")


@pytest.mark.parametrize(("interval", "micros"), [(1.0, 1_000_000), (0.5, 500_000), (0.0, -1), (None, 0)])
def test_an_interval(interval: float | None, micros: int) -> None:
    message = heard(mav.MESSAGE_INTERVAL, mav.message_interval(251, interval))
    assert (message.message_id, message.interval_us) == (251, micros)


def test_the_version_says_one_encoding_of_parameters() -> None:
    version = heard(mav.AUTOPILOT_VERSION, mav.autopilot_version("1.2.3.dev4"))
    assert version.flight_sw_version == 0x01020300
    encodings = (
        common.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST | common.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
    )
    assert version.capabilities & encodings == common.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST


def test_a_computer_that_tells_nothing_is_unknown_all_over() -> None:
    status = heard(mav.ONBOARD_COMPUTER_STATUS, mav.onboard_computer_status(mav.ComputerStatus(0.0)))
    assert (status.ram_usage, status.ram_total) == (2**32 - 1,) * 2
    assert set(status.storage_usage + status.storage_total) == {2**32 - 1}
    assert set(status.cpu_cores) == {255}
    assert set(status.temperature_core) == {127}


@given(
    st.builds(
        mav.ComputerStatus,
        st.floats(),
        st.lists(st.floats(), max_size=12).map(tuple),
        *[st.none() | st.floats(allow_nan=False, allow_infinity=False)] * 5,
    )
)
def test_any_state_of_the_computer_fits_its_message(status: mav.ComputerStatus) -> None:
    message = heard(mav.ONBOARD_COMPUTER_STATUS, mav.onboard_computer_status(status))
    assert len(message.cpu_cores) == 8
    assert all(0 <= core <= 100 or core == 255 for core in message.cpu_cores)


def test_a_computer_as_it_is() -> None:
    about = mav.ComputerStatus(12.5, (3.4, 99.6), 48.7, 200.2, 430.0, 1000.0, 30000.0)
    status = heard(mav.ONBOARD_COMPUTER_STATUS, mav.onboard_computer_status(about))
    assert (status.time_usec, status.uptime, status.cpu_cores[:3]) == (12_500_000, 12500, [3, 100, 255])
    assert (status.temperature_core[0], status.ram_usage, status.ram_total) == (49, 200, 430)
    assert (status.storage_usage[0], status.storage_total[0]) == (1000, 30000)

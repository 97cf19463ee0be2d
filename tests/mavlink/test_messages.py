"""Builders and parser of the messages that we use."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common

from rass_mav.errors import MalformedError
from rass_mav.lab.swarm import autopilot
from rass_mav.mavlink import messages
from rass_mav.mavlink.dialect import FORMATS, MavlinkMessage, payload_of
from rass_mav.mavlink.frames import Frame, FrameReader, FrameWriter
from rass_mav.mavlink.identity import addressed_to


def over_the_wire(message: MavlinkMessage) -> MavlinkMessage:
    [frame] = FrameReader().feed(FrameWriter(1, 1).message(message))
    return messages.parse(frame)


def test_heartbeats_tell_companion_from_autopilot() -> None:
    companion = over_the_wire(messages.companion_heartbeat())
    assert companion.type == common.MAV_TYPE_ONBOARD_CONTROLLER
    assert companion.autopilot == common.MAV_AUTOPILOT_INVALID
    assert companion.system_status == common.MAV_STATE_ACTIVE
    copter = over_the_wire(autopilot.autopilot_heartbeat(armed=True, custom_mode=4))
    assert copter.type == common.MAV_TYPE_QUADROTOR
    assert copter.autopilot == common.MAV_AUTOPILOT_ARDUPILOTMEGA
    assert copter.base_mode & common.MAV_MODE_FLAG_SAFETY_ARMED
    assert copter.custom_mode == 4
    assert not autopilot.autopilot_heartbeat(armed=False).base_mode & common.MAV_MODE_FLAG_SAFETY_ARMED
    # What pymavlink's own senders put there.
    assert companion.mavlink_version == copter.mavlink_version == 3


@given(
    latitude=st.floats(-90, 90),
    longitude=st.floats(-180, 180),
    altitude=st.floats(-500, 9000),
    relative=st.floats(-500, 9000),
    velocity=st.tuples(*[st.floats(-300, 300)] * 3),
    time_boot_ms=st.integers(0, 2**40),
)
def test_position_keeps_its_units(
    latitude: float,
    longitude: float,
    altitude: float,
    relative: float,
    velocity: tuple[float, float, float],
    time_boot_ms: int,
) -> None:
    arguments = (latitude, longitude, altitude, relative, time_boot_ms)
    payload = autopilot.global_position_int_payload(*arguments, velocity=velocity)
    message = messages.parse(Frame(messages.GLOBAL_POSITION_INT, 0, 1, 1, payload, False))
    assert message.time_boot_ms == time_boot_ms % 2**32
    assert message.lat / 1e7 == pytest.approx(latitude, abs=0.6e-7)
    assert message.lon / 1e7 == pytest.approx(longitude, abs=0.6e-7)
    assert message.alt / 1e3 == pytest.approx(altitude, abs=0.6e-3)
    assert message.relative_alt / 1e3 == pytest.approx(relative, abs=0.6e-3)
    assert (message.vx / 100, message.vy / 100, message.vz / 100) == pytest.approx(velocity, abs=0.6e-2)
    assert message.hdg == 65535
    assert payload.rstrip(b"\0") == payload_of(message).rstrip(b"\0")


@given(value=st.floats(width=32), time_boot_ms=st.integers(0, 2**40))
def test_named_value(value: float, time_boot_ms: int) -> None:
    payload = messages.named_value_float_payload("RAD", value, time_boot_ms)
    theirs = common.MAVLink_named_value_float_message(time_boot_ms % 2**32, b"RAD", value)
    assert payload.rstrip(b"\0") == payload_of(theirs).rstrip(b"\0")
    parsed = over_the_wire(theirs)
    assert parsed.name == "RAD"
    assert parsed.value == pytest.approx(value, nan_ok=True, rel=0)
    assert parsed.time_boot_ms == time_boot_ms % 2**32


@pytest.mark.parametrize("name", ["", "elevenchars", "R\0D"])
def test_names_that_do_not_fit_are_our_mistake(name: str) -> None:
    with pytest.raises(ValueError, match="1 to 10 ASCII"):
        messages.named_value_float_payload(name, 1.0, 0)


@pytest.mark.parametrize("place", [(90.1, 0.0), (0.0, -180.1), (float("nan"), 0.0)])
def test_places_that_are_not_on_earth_are_our_mistake(place: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match="not a place"):
        autopilot.home_position(*place, 0.0)
    with pytest.raises(ValueError, match="not a place"):
        autopilot.global_position_int_payload(*place, 0.0, 0.0, 0)


def test_other_builders() -> None:
    local = over_the_wire(autopilot.local_position_ned(1.5, -2.5, -10.0, 99, velocity=(0.5, 0.0, -0.5)))
    assert (local.x, local.y, local.z, local.vx, local.vz, local.time_boot_ms) == (1.5, -2.5, -10.0, 0.5, -0.5, 99)
    home = over_the_wire(autopilot.home_position(-35.25, 149.5, 584.0))
    assert (home.latitude, home.longitude, home.altitude, home.q) == (-352500000, 1495000000, 584000, [1, 0, 0, 0])
    command = over_the_wire(messages.set_message_interval(33, 0.2, target_system=1, target_component=1))
    assert command.command == common.MAV_CMD_SET_MESSAGE_INTERVAL == 511
    assert (command.target_system, command.target_component, command.param1, command.param2) == (1, 1, 33, 200_000)


def reassembled(pieces: list[MavlinkMessage]) -> str:
    """As a ground station puts pieces together: by number, the last has a zero within its 50 bytes."""
    assert [piece.chunk_seq for piece in pieces] == list(range(len(pieces)))
    assert all(len(piece.text) == 50 for piece in pieces[:-1])
    assert len(pieces[-1].text) < 50
    assert len({piece.id for piece in pieces}) == 1
    return "".join(piece.text for piece in pieces)


@given(text=st.text(max_size=399))
def test_a_text_arrives_whole_in_pieces(text: str) -> None:
    pieces = [over_the_wire(piece) for piece in messages.statustext(4, text, text_id=77)]
    expected = text.replace("\0", " ").encode("ascii", errors="replace").decode()
    if len(expected) <= 50:
        [only] = pieces
        assert (only.text, only.id, only.severity) == (expected, 0, 4)
    else:
        assert pieces[0].id == 77
        assert reassembled(pieces) == expected


@pytest.mark.parametrize(("length", "count"), [(50, 1), (51, 2), (100, 3), (400, 9), (401, 9), (5000, 9)])
def test_a_text_of_whole_pieces_gets_an_end_and_a_long_one_is_cut(length: int, count: int) -> None:
    pieces = messages.statustext(6, "x" * length)
    assert len(pieces) == count
    if count > 1:
        assert reassembled(pieces) == "x" * min(length, 400)


@given(message_id=st.sampled_from(sorted(common.mavlink_map)), payload=st.binary(max_size=255))
def test_any_payload_of_any_message_parses_or_is_malformed(message_id: int, payload: bytes) -> None:
    try:
        message = messages.parse(Frame(message_id, 3, 4, 5, payload, False))
    except MalformedError:
        return
    assert (message.get_msgId(), message.get_srcSystem(), message.get_srcComponent()) == (message_id, 4, 5)


def test_an_unknown_message_is_malformed() -> None:
    with pytest.raises(MalformedError, match="60000"):
        messages.parse(Frame(60000, 0, 1, 1, b"", False))


def test_crc_extra() -> None:
    assert FORMATS[messages.TUNNEL].crc_extra == bytes((147,))
    assert FORMATS[messages.HEARTBEAT].crc_extra == bytes((50,))
    assert 60000 not in FORMATS


@pytest.mark.parametrize(
    ("target", "expected"),
    [((0, 0), True), ((0, 55), True), ((7, 0), True), ((7, 191), True), ((7, 1), False), ((8, 0), False)],
)
def test_who_is_addressed(target: tuple[int, int], expected: bool) -> None:
    assert addressed_to(*target, 7, 191) is expected

"""What is believed of what an autopilot says, and what is not."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.errors import ConfigError
from rass_mav.lab.swarm import autopilot
from rass_mav.mavlink import messages
from rass_mav.mavlink.dialect import MavlinkMessage, payload_of
from rass_mav.mavlink.frames import Frame
from rass_mav.mavlink.telemetry import MOST_IGNORED, Accuracy, Date, LocalPosition, Position, Reading, Telemetry
from tests.telemetry import global_position_int, gps_raw_int, named_value_float, system_time


def frame(message: MavlinkMessage, system: int = 7, component: int = 1) -> Frame:
    return Frame(message.get_msgId(), 0, system, component, payload_of(message), False)


def reading(value: float = 3.5, *, name: str = "RAD", boot_ms: int = 1000) -> MavlinkMessage:
    return named_value_float(name, value, boot_ms)


def test_state_follows_the_autopilot() -> None:
    telemetry = Telemetry(7)
    assert telemetry.handle(frame(autopilot.autopilot_heartbeat(armed=True)), 10.0)
    assert telemetry.handle(frame(global_position_int(-35.5, 149.25, 590.5, 6.5, 1234)), 11.0)
    assert telemetry.handle(frame(autopilot.local_position_ned(1.0, 2.0, -3.0, 1300)), 12.0)
    assert telemetry.handle(frame(autopilot.home_position(-35.25, 149.5, 584.0)), 13.0)
    assert telemetry.handle(frame(reading(3.5, boot_ms=1400)), 14.0)
    assert (telemetry.heartbeat_at, telemetry.armed) == (10.0, True)
    assert telemetry.position == Position(-35.5, 149.25, 590.5, 11.0)
    assert telemetry.local == LocalPosition(1.0, 2.0, -3.0, 12.0)
    assert telemetry.home == Position(-35.25, 149.5, 584.0, 13.0)
    assert telemetry.reading == Reading(3.5, 14.0)
    assert telemetry.boot_ms == 1400
    assert telemetry.handle(frame(autopilot.autopilot_heartbeat(armed=False)), 15.0)
    assert (telemetry.heartbeat_at, telemetry.armed) == (15.0, False)
    assert (telemetry.reboots, telemetry.rejected, telemetry.ignored) == (0, 0, {})


def test_before_a_fix_there_is_no_position() -> None:
    telemetry = Telemetry(7)
    assert not telemetry.handle(frame(global_position_int(0.0, 0.0, 0.0, 0.0, 500)), 1.0)
    assert not telemetry.handle(frame(autopilot.home_position(0.0, 0.0, 0.0)), 1.0)
    # The barometer may give an altitude before there is a fix.
    assert not telemetry.handle(frame(global_position_int(0.0, 0.0, 12.5, 1.0, 500)), 1.0)
    assert telemetry.position is None
    assert telemetry.home is None
    assert telemetry.boot_ms == 500
    # A fix that was there is not overwritten by one that is lost.
    telemetry.handle(frame(global_position_int(1.0, 2.0, 3.0, 4.0, 600)), 2.0)
    telemetry.handle(frame(global_position_int(0.0, 0.0, 0.0, 0.0, 700)), 3.0)
    assert telemetry.position == Position(1.0, 2.0, 3.0, 2.0)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_readings_that_are_no_numbers_are_rejected(value: float) -> None:
    telemetry = Telemetry(7)
    telemetry.handle(frame(reading(2.0)), 1.0)
    assert not telemetry.handle(frame(reading(value)), 2.0)
    assert telemetry.reading == Reading(2.0, 1.0)
    assert telemetry.rejected == 1
    assert not telemetry.handle(frame(autopilot.local_position_ned(0.0, value, 0.0, 5)), 2.0)
    assert telemetry.local is None
    assert telemetry.rejected == 2


def test_negative_readings_are_valid() -> None:
    telemetry = Telemetry(7)
    assert telemetry.handle(frame(reading(-0.25)), 1.0)
    assert telemetry.reading == Reading(-0.25, 1.0)


@pytest.mark.parametrize(("lat", "lon"), [(900_000_001, 0), (-900_000_001, 5), (5, 1_800_000_001), (0, -(2**31))])
def test_places_that_are_not_on_earth_are_rejected(lat: int, lon: int) -> None:
    telemetry = Telemetry(7)
    message = global_position_int(1.0, 1.0, 1.0, 1.0, 1)
    message.lat, message.lon = lat, lon
    assert not telemetry.handle(frame(message), 1.0)
    assert telemetry.position is None
    assert telemetry.rejected == 1


def test_the_accuracy_of_the_position() -> None:
    telemetry = Telemetry(7)
    assert telemetry.handle(frame(gps_raw_int(1500)), 1.0)
    assert telemetry.accuracy == Accuracy(1.5, 1.0)
    assert telemetry.position is None, "the position comes from the autopilot's filter"
    # It no longer reports it: 0 and MAVLink 1, which has no such field; and the fix is lost.
    old = frame(gps_raw_int(1500))
    for said in (frame(gps_raw_int(0)), old._replace(payload=old.payload[:30]), frame(gps_raw_int(1500, fix=1))):
        telemetry.handle(frame(gps_raw_int(1500)), 2.0)
        telemetry.handle(said, 3.0)
        assert telemetry.accuracy is None


def test_the_date() -> None:
    telemetry = Telemetry(7)
    assert not telemetry.handle(frame(system_time(0)), 1.0)
    assert telemetry.boot_ms == 1000
    assert (telemetry.date, telemetry.rejected) == (None, 0), "not known yet is no error"
    assert telemetry.handle(frame(system_time(1_800_000_000_500_000)), 2.0)
    assert telemetry.date == Date(1_800_000_000.5, 2.0)


@pytest.mark.parametrize(
    ("time_us", "plausible"),
    [
        (1, False),
        (1_704_067_199_999_999, False),
        (1_704_067_200_000_000, True),
        (4_102_444_799_000_000, True),
        (4_102_444_800_000_000, False),
        (2**64 - 1, False),
    ],
)
def test_dates_that_cannot_be_are_rejected(time_us: int, plausible: bool) -> None:
    telemetry = Telemetry(7)
    telemetry.handle(frame(system_time(1_800_000_000_000_000)), 1.0)
    assert telemetry.handle(frame(system_time(time_us)), 2.0) is plausible
    assert telemetry.rejected == (not plausible)
    assert telemetry.date == (Date(time_us / 1e6, 2.0) if plausible else Date(1.8e9, 1.0))


@pytest.mark.parametrize(("system", "component"), [(8, 1), (7, 191), (7, 0), (0, 1)])
def test_others_are_not_believed(system: int, component: int) -> None:
    telemetry = Telemetry(7)
    before = vars(telemetry).copy()
    others = [
        autopilot.autopilot_heartbeat(),
        global_position_int(1.0, 2.0, 3.0, 4.0, 999),
        autopilot.local_position_ned(1.0, 2.0, 3.0, 999),
        autopilot.home_position(1.0, 2.0, 3.0),
        gps_raw_int(1500),
        system_time(1_800_000_000_000_000),
        reading(),
    ]
    assert not any(telemetry.handle(frame(message, system, component), 1.0) for message in others)
    assert vars(telemetry) == {**before, "ignored": {(system, component, "RAD"): (1, 1.0)}}


def test_only_our_name_is_a_reading() -> None:
    telemetry = Telemetry(7, reading_name="GEIGER")
    for name in ("RAD", "GEIGER2", "GEIGE", "geiger"):
        assert not telemetry.handle(frame(reading(name=name)), 1.0)
        assert not telemetry.handle(frame(reading(name=name), system=9), 1.0)
    assert telemetry.reading is None
    # Of the vehicle, so that a person sees under which name its readings come. Others' values are nobody's business.
    assert telemetry.ignored == {(7, 1, name): (1, 1.0) for name in ("RAD", "GEIGER2", "GEIGE", "geiger")}
    assert telemetry.handle(frame(reading(name="GEIGER")), 2.0)


def test_a_component_of_the_vehicle_that_a_setting_names_sends_the_reading() -> None:
    telemetry = Telemetry(7, reading_component=158)
    telemetry.handle(frame(reading(1.0, boot_ms=90_000)), 1.0)
    assert telemetry.handle(frame(reading(2.5, boot_ms=5), component=158), 2.0)
    # The time since its own boot says nothing about the autopilot.
    assert (telemetry.reading, telemetry.boot_ms, telemetry.reboots) == (Reading(2.5, 2.0), 90_000, 0)
    for system, component in ((8, 158), (7, 1), (7, 159)):
        assert not telemetry.handle(frame(reading(9.0), system, component), 3.0)
    assert telemetry.reading == Reading(2.5, 2.0)
    assert telemetry.ignored == {(7, 1, "RAD"): (2, 3.0), (8, 158, "RAD"): (1, 3.0), (7, 159, "RAD"): (1, 3.0)}


def test_a_vehicle_that_sends_a_thousand_names_fills_no_memory() -> None:
    telemetry = Telemetry(7)
    for n in range(1000):
        telemetry.handle(frame(reading(name=f"N{n}")), float(n))
    telemetry.handle(Frame(messages.NAMED_VALUE_FLOAT, 0, 7, 1, b"\0" * 8 + b"\xff\x1b[2J", False), 1000.0)
    assert len(telemetry.ignored) == MOST_IGNORED
    assert (7, 1, "N999") in telemetry.ignored


def test_a_name_ends_at_its_zero() -> None:
    telemetry = Telemetry(7)
    untidy = payload_of(reading(4.0)).ljust(18, b"\0")[:8] + b"RAD\0junk\0x"
    assert telemetry.handle(Frame(messages.NAMED_VALUE_FLOAT, 0, 7, 1, untidy, False), 1.0)
    assert telemetry.reading == Reading(4.0, 1.0)


def test_a_name_of_ten_characters_fills_the_field() -> None:
    telemetry = Telemetry(7, reading_name="TENLETTERS")
    assert telemetry.handle(frame(reading(name="TENLETTERS")), 1.0)


@pytest.mark.parametrize("name", ["", "elevenchars", "µSv"])
def test_a_configured_name_that_does_not_fit_is_an_error_of_the_configuration(name: str) -> None:
    with pytest.raises(ConfigError, match="1 to 10 ASCII"):
        Telemetry(7, reading_name=name)


def test_system_0_latches_onto_the_first_autopilot() -> None:
    telemetry = Telemetry(0)
    # No autopilot has spoken yet: a companion, a camera, a reading and a position do not latch.
    assert not telemetry.handle(frame(messages.companion_heartbeat(), 5, 191), 1.0)
    assert not telemetry.handle(frame(messages.companion_heartbeat(), 5, 1), 1.0)
    assert not telemetry.handle(frame(autopilot.autopilot_heartbeat(), 5, 100), 1.0)
    assert not telemetry.handle(frame(autopilot.autopilot_heartbeat(), 0, 1), 1.0)
    assert not telemetry.handle(frame(reading(), 6, 1), 1.0)
    assert not telemetry.handle(frame(reading(), 0, 1), 1.0)
    assert (telemetry.system_id, telemetry.heartbeat_at, telemetry.reading) == (0, None, None)
    assert telemetry.handle(frame(autopilot.autopilot_heartbeat(), 6, 1), 2.0)
    assert (telemetry.system_id, telemetry.heartbeat_at) == (6, 2.0)
    # From now on only that one.
    assert not telemetry.handle(frame(autopilot.autopilot_heartbeat(), 5, 1), 3.0)
    assert not telemetry.handle(frame(reading(9.0), 5, 1), 3.0)
    assert telemetry.handle(frame(reading(1.0), 6, 1), 4.0)
    assert (telemetry.system_id, telemetry.heartbeat_at) == (6, 2.0)
    assert telemetry.reading == Reading(1.0, 4.0)
    assert telemetry.ignored == {(5, 1, "RAD"): (1, 3.0)}


def test_a_reboot_is_seen_by_the_time_since_boot() -> None:
    telemetry = Telemetry(7)
    for boot_ms in (20_000, 20_200, 15_200, 20_400):  # overtaken on the way by up to 5 s: no reboot
        telemetry.handle(frame(reading(boot_ms=boot_ms)), 1.0)
    assert telemetry.reboots == 0
    telemetry.handle(frame(global_position_int(1.0, 2.0, 3.0, 4.0, 900)), 2.0)
    assert (telemetry.reboots, telemetry.boot_ms) == (1, 900)
    telemetry.handle(frame(autopilot.local_position_ned(1.0, 2.0, 3.0, 1100)), 2.0)
    assert telemetry.reboots == 1


def test_a_script_that_leaves_the_time_at_zero_is_no_reboot() -> None:
    telemetry = Telemetry(7)
    telemetry.handle(frame(global_position_int(1.0, 2.0, 3.0, 4.0, 60_000)), 1.0)
    assert telemetry.handle(frame(reading(boot_ms=0)), 2.0)
    assert (telemetry.reboots, telemetry.boot_ms) == (0, 60_000)


@given(
    message_id=st.sampled_from([0, 32, 33, 242, 251, 385, 70_000]),
    payload=st.binary(max_size=255),
    system=st.sampled_from([0, 7, 8]),
    configured=st.sampled_from([0, 7]),
)
def test_any_payload_is_survived(message_id: int, payload: bytes, system: int, configured: int) -> None:
    telemetry = Telemetry(configured)
    used = telemetry.handle(Frame(message_id, 0, system, 1, payload, False), 1.0)
    known = (telemetry.position, telemetry.local, telemetry.home, telemetry.reading, telemetry.heartbeat_at)
    assert used is any(value is not None for value in known)
    if telemetry.reading is not None:
        assert math.isfinite(telemetry.reading.value)

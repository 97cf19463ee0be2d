from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.errors import MalformedError
from rass_mav.wire.measurement import (
    MEASUREMENT_BYTES,
    MOST_READING,
    UNITS,
    Measurement,
    decode_measurement,
    encode_measurement,
    shortest,
)

GOLDEN = Measurement(47.5, -8.25, 412.5, 0.75, 1.0)
#: Its bytes.
PLAIN = "0103c0ec4f1c602615fb544b06000000403fffff"
positions = st.tuples(st.floats(-90, 90), st.floats(-180, 180), st.floats(-2e6, 2e6))


@given(st.none() | positions, st.none() | st.floats(width=32, allow_nan=False, allow_infinity=False), st.floats(0, 1))
def test_round_trip(position: tuple[float, float, float] | None, reading: float | None, risk: float) -> None:
    lat, lon, alt = position or (None, None, None)
    payload = encode_measurement(Measurement(lat, lon, alt, reading, risk))
    assert len(payload) == MEASUREMENT_BYTES == 20
    back = decode_measurement(payload)
    assert back.reading == reading
    assert back.risk == pytest.approx(risk, abs=1 / 65535)
    if position is None:
        assert (back.latitude, back.longitude, back.altitude) == (None, None, None)
    else:
        assert back.latitude == pytest.approx(lat, abs=1e-7)
        assert back.longitude == pytest.approx(lon, abs=1e-7)
        assert back.altitude == pytest.approx(alt, abs=1e-3)


@pytest.mark.parametrize("reading", [math.nan, math.inf, 1e39, -1e39, None])
def test_a_reading_that_cannot_be_said_is_unknown(reading: float | None) -> None:
    assert decode_measurement(encode_measurement(Measurement(1.0, 2.0, 3.0, reading, 0.5))).reading is None


@pytest.mark.parametrize("bits", [b"\x00\x00\xc0\x7f", b"\x00\x00\x80\x7f"])
def test_a_reading_on_the_wire_that_is_no_number_is_unknown(bits: bytes) -> None:
    payload = encode_measurement(Measurement(None, None, None, 1.0, 0.5))
    assert decode_measurement(payload[:14] + bits + payload[18:]).reading is None


def test_bytes_behind_a_measurement_are_padding() -> None:
    m = encode_measurement(Measurement(1.0, 2.0, 3.0, 4.0, 0.5))
    assert decode_measurement(m + b"padding") == decode_measurement(m)


@pytest.mark.parametrize(("flags", "expected"), [(0, 20), (8, 21), (16, 22), (24, 23)])
def test_a_measurement_that_is_too_short_says_how_short(flags: int, expected: int) -> None:
    payload = bytes([1, flags]) + bytes(expected - 3)
    with pytest.raises(MalformedError, match=f"{expected - 1} bytes, expected at least {expected}$"):
        decode_measurement(payload)


@given(st.floats(0, MOST_READING, width=32))
def test_the_shortest_number_is_the_same_reading(reading: float) -> None:
    assert struct.pack("<f", shortest(reading)) == struct.pack("<f", reading)


@given(st.integers(0, 999_999), st.integers(-12, 12))
def test_what_a_sensor_shows_comes_back(digits: int, exponent: int) -> None:
    shown = float(f"{digits}e{exponent}")
    stored = decode_measurement(encode_measurement(Measurement(None, None, None, shown, 0.5))).reading
    assert stored is not None
    assert shortest(stored) == shown


@given(st.binary(max_size=30))
def test_any_bytes_are_a_measurement_or_malformed(payload: bytes) -> None:
    try:
        m = decode_measurement(payload)
    except MalformedError:
        assert len(payload) < MEASUREMENT_BYTES + 3 or payload[0] != 1
    else:
        assert 0.0 <= m.risk <= 1.0


@given(st.tuples(*[st.floats(-2e6, 2e6)] * 3))
def test_a_local_position(local: tuple[float, float, float]) -> None:
    back = decode_measurement(encode_measurement(Measurement(None, None, None, 1.0, 0.5, local)))
    assert (back.latitude, back.longitude, back.altitude) == (None, None, None)
    assert back.local == pytest.approx(local, abs=1e-3)
    # A position on Earth says more.
    assert decode_measurement(encode_measurement(Measurement(1.0, 2.0, 3.0, 1.0, 0.5, local))).local is None


@pytest.mark.parametrize(
    ("unit", "error_m", "flags", "more"),
    [
        (None, None, 3, ""),
        ("usvh", None, 11, "01"),
        ("counts", None, 11, "04"),
        (None, 0.0, 19, "0000"),
        (None, 2.51, 19, "1a00"),
        (None, 6553.5, 19, "ffff"),
        (None, 6553.6, 3, ""),
        (None, math.inf, 3, ""),
        (None, math.nan, 3, ""),
        ("cpm", 12.8, 27, "028000"),
    ],
)
def test_golden_bytes(unit: str | None, error_m: float | None, flags: int, more: str) -> None:
    payload = encode_measurement(GOLDEN._replace(unit=unit, error_m=error_m))
    assert payload.hex() == f"01{flags:02x}{PLAIN[4:]}{more}"
    # A reader that does not know the two sees what it has always seen.
    assert decode_measurement(bytes((1, payload[1] & 7)) + payload[2:]) == GOLDEN


@given(
    st.none() | positions,
    st.none() | st.floats(width=32, allow_nan=False, allow_infinity=False),
    st.none() | st.sampled_from(sorted(UNITS)),
    st.none() | st.floats(0.0, 7000.0),
    st.binary(max_size=5),
)
def test_unit_and_error_round_trip(
    position: tuple[float, float, float] | None,
    reading: float | None,
    unit: str | None,
    error_m: float | None,
    padding: bytes,
) -> None:
    lat, lon, alt = position or (None, None, None)
    payload = encode_measurement(Measurement(lat, lon, alt, reading, 0.5, None, unit, error_m))
    back = decode_measurement(payload + padding)
    assert back.unit == (None if reading is None else unit)
    if position is None or error_m is None or error_m > 6553.5:
        assert back.error_m is None
    else:
        assert back.error_m is not None
        assert back.error_m == pytest.approx(error_m, abs=0.11)
        assert back.error_m >= error_m - 1e-9, "it is a bound"
    for size in range(len(payload)):
        with pytest.raises(MalformedError):
            decode_measurement(payload[:size])


def test_a_unit_of_a_later_version_is_unknown_and_a_wrong_one_is_not_sent() -> None:
    payload = bytearray(encode_measurement(GOLDEN._replace(unit="cps", error_m=1.0)))
    payload[20] = 200
    assert decode_measurement(bytes(payload)) == GOLDEN._replace(error_m=1.0)
    with pytest.raises(ValueError, match="expected a unit, one of usvh, cpm, cps, counts, got 'Sv'"):
        encode_measurement(GOLDEN._replace(unit="Sv"))

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.errors import MalformedError
from rass_mav.wire.measurement import MEASUREMENT_BYTES, Measurement, decode_measurement, encode_measurement

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


@given(st.binary(max_size=30))
def test_any_bytes_are_a_measurement_or_malformed(payload: bytes) -> None:
    try:
        m = decode_measurement(payload)
    except MalformedError:
        assert len(payload) < MEASUREMENT_BYTES or payload[0] != 1
    else:
        assert 0.0 <= m.risk <= 1.0


@given(st.tuples(*[st.floats(-2e6, 2e6)] * 3))
def test_a_local_position(local: tuple[float, float, float]) -> None:
    back = decode_measurement(encode_measurement(Measurement(None, None, None, 1.0, 0.5, local)))
    assert (back.latitude, back.longitude, back.altitude) == (None, None, None)
    assert back.local == pytest.approx(local, abs=1e-3)
    # A position on Earth says more.
    assert decode_measurement(encode_measurement(Measurement(1.0, 2.0, 3.0, 1.0, 0.5, local))).local is None

"""What the sections `sensor` and `risk` make of readings."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.config.loading import convert
from rass_mav.core.settings import RiskSettings
from rass_mav.errors import ConfigError
from rass_mav.sensor.playback import PlaybackSensor
from rass_mav.sensor.serial_sensor import SerialSensor
from rass_mav.sensor.settings import SensorSettings
from tests.some import some

POSITIVE = st.floats(1e-3, 1e3)


def settings(**keys: Any) -> SensorSettings:
    made: SensorSettings = convert(keys, SensorSettings, "test")
    made.check()
    return made


def never() -> float:
    raise AssertionError("not started")


def test_the_autopilot_is_the_default_and_no_sensor_of_ours() -> None:
    assert settings().open(never) is None


@pytest.mark.parametrize(
    ("kind", "name"),
    [("mightyohm", "tty:9600"), ("gmc", "tty:115200"), ("radpro", "tty:115200"), ("bgeigie", "tty:57600")],
)  # fmt: skip
def test_counters_have_the_rate_of_the_factory(kind: str, name: str) -> None:
    sensor = settings(type=kind, port="tty").open(never)
    assert isinstance(sensor, SerialSensor)
    assert sensor.name == name
    other = some(settings(type=kind, port="tty", baud=1200).open(never))
    assert other.name == "tty:1200"


def test_a_log_is_opened_at_once(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"^sensor\.path: .*none\.LOG: no such file"):
        settings(type="log", path=str(tmp_path / "none.LOG")).open(never)
    path = tmp_path / "a.LOG"
    path.write_text("$BNRDD,204,2012-09-20T15:13:40Z,11,2,11,V,5218.7185,N,445.6503,E,4.80,A,132,6*64\n")
    assert isinstance(settings(type="log", path=str(path)).open(never), PlaybackSensor)


def test_the_tube_of_each_counter() -> None:
    def tube(**keys: Any) -> tuple[float, float, bool]:
        meter = settings(port="tty", **keys).meter()
        return meter.cpm_per_usvh, meter.dead_time_us, meter.believe_device

    assert tube(type="mightyohm") == (106.0, 190.0, True)
    assert tube(type="mightyohm", tube="lnd-7317") == (253.0, 40.0, False)
    assert tube(type="mightyohm", cpm_per_usvh=120, dead_time_us=0) == (120.0, 0.0, False)
    assert tube(type="bgeigie") == (334.0, 0.0, True)
    # A Rad Pro corrects by itself, unless somebody says which tube it has.
    assert tube(type="radpro")[1:] == (0.0, True)
    assert tube(type="radpro", tube="sbm-20") == (106.0, 190.0, False)
    assert tube(type="radpro", dead_time_us=50)[1:] == (50.0, True)


@given(st.floats(-1e3, 1e3), POSITIVE, st.floats(-1e3, 1e3), st.floats(-1e6, 1e6))
def test_the_linear_scale(low: float, span: float, background: float, reading: float) -> None:
    risk = RiskSettings(low=low, high=low + span, background=background)
    if risk.high - risk.low > 1e-9:
        assert risk.normalised(background + low) == pytest.approx(0.0, abs=1e-3)
        assert risk.normalised(background + risk.high) == pytest.approx(1.0, abs=1e-3)
        assert risk.normalised(reading) == pytest.approx(
            ((reading - background) - low) / (risk.high - low), rel=1e-9, abs=1e-9
        )


@given(POSITIVE, st.floats(1.01, 1e6), st.floats(0, 10), st.lists(st.floats(-1e4, 1e9), min_size=2, max_size=10))
def test_the_logarithmic_scale(low: float, ratio: float, background: float, readings: list[float]) -> None:
    risk = RiskSettings(scale="logarithmic", low=low, high=low * ratio, background=background)
    values = [risk.normalised(reading) for reading in sorted(readings)]
    assert values == sorted(values), "more radiation is never less risk"
    assert all(map(math.isfinite, values)), "what is not finite would be no reading"


def test_the_logarithmic_scale_in_numbers() -> None:
    risk = RiskSettings(scale="logarithmic", low=0.2, high=200.0, background=0.1)
    assert risk.normalised(0.3) == pytest.approx(0.0, abs=1e-12)
    assert risk.normalised(200.1) == pytest.approx(1.0)
    assert risk.normalised(2.1) == pytest.approx(1 / 3)
    # Each doubling the same, unclipped beyond high.
    assert risk.normalised(400.1) - risk.normalised(200.1) == pytest.approx(risk.normalised(0.5) - risk.normalised(0.3))
    # Below low a line: background itself, and noise on both sides of it, have values that average out.
    below = [risk.normalised(0.1 + x) for x in (-0.1, 0.0, 0.1)]
    assert below[1] == pytest.approx(-1 / math.log(1000))
    assert below[0] + below[2] == pytest.approx(2 * below[1])
    # No kink at low.
    slopes = [(risk.normalised(0.3 + x) - risk.normalised(0.3)) / x for x in (-1e-6, 1e-6)]
    assert slopes[0] == pytest.approx(slopes[1], rel=1e-4)

"""A recorded log as sensor, in virtual time."""

from __future__ import annotations

import io

import pytest

from rass_mav.sensor.base import MAX_WAITING
from rass_mav.sensor.bgeigie_log import read_bgeigie
from rass_mav.sensor.dose import TUBES, DoseMeter
from rass_mav.sensor.playback import PlaybackSensor

from .sentences import sentence


def never() -> None:
    raise AssertionError("the driver looks by itself")


def playback(lines: list[bytes], clock: list[float], speed: float = 1.0) -> PlaybackSensor:
    log = read_bgeigie(io.BytesIO(b"\n".join(lines) + b"\n"))
    return PlaybackSensor("a.LOG", log, DoseMeter(TUBES["safecast"]), lambda: clock[0], speed=speed)


LINES = [
    sentence(time=b"2012-09-20T15:13:40Z", cpm=5, valid=b"V"),
    sentence(time=b"2012-09-20T15:13:45Z", cpm=334),
    b"damaged",
    sentence(time=b"2012-09-20T15:13:55Z", cpm=668),
]


def test_readings_come_in_the_rhythm_of_the_log() -> None:
    clock = [100.0]
    sensor = playback(LINES, clock)
    assert sensor.receive() == []
    assert not sensor.state().connected
    sensor.start(never)
    assert sensor.receive() == []
    clock[0] = 104.9
    assert sensor.receive() == []
    clock[0] = 105.5
    assert sensor.receive() == [(1.0, 105.0)]
    clock[0] = 200.0
    assert sensor.receive() == [(2.0, 115.0)], "its age is that of the log"
    assert sensor.receive() == []
    state = sensor.state()
    assert (state.readings, state.malformed, state.trouble) == (2, 1, "the log has ended")
    sensor.close()


def test_a_log_can_go_faster() -> None:
    clock = [0.0]
    sensor = playback(LINES, clock, speed=10.0)
    sensor.start(never)
    clock[0] = 0.5
    [reading] = sensor.receive()
    assert reading == pytest.approx((1.0, 0.5))


def test_a_driver_that_comes_late_gets_the_last_readings() -> None:
    lines = [sentence(time=b"2012-09-20T15:%02d:%02dZ" % divmod(n, 60), cpm=n) for n in range(100)]
    clock = [0.0]
    sensor = playback(lines, clock)
    sensor.start(never)
    clock[0] = 1000.0
    readings = sensor.receive()
    assert len(readings) == MAX_WAITING
    assert readings[-1].at == 99.0
    state = sensor.state()
    assert (state.readings, state.dropped) == (MAX_WAITING, 100 - MAX_WAITING)

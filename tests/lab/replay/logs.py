"""Logs made by hand: what autopilots say, written by our own FrameWriter."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from pathlib import Path

from rass_mav.lab.medium.tlog import TlogWriter
from rass_mav.lab.swarm.autopilot import (
    METRES_PER_DEGREE,
    autopilot_heartbeat,
    global_position_int_payload,
    home_position,
)
from rass_mav.mavlink.frames import FrameWriter
from rass_mav.mavlink.messages import (
    GLOBAL_POSITION_INT,
    NAMED_VALUE_FLOAT,
    companion_heartbeat,
    named_value_float_payload,
)

#: Time of the first record of a log, seconds since 1970.
START = 1_700_000_000.0
#: Where x = y = 0 is, degrees, and metres above sea level.
LATITUDE, LONGITUDE, GROUND = -35.0, 149.0, 500.0

#: (seconds since 1970, frame)
Said = tuple[float, bytes]


def place(x: float, y: float) -> tuple[float, float]:
    """Latitude and longitude of a point, metres east and north."""
    east = x / (METRES_PER_DEGREE * math.cos(math.radians(LATITUDE)))
    return LATITUDE + y / METRES_PER_DEGREE, LONGITUDE + east


def vehicle(
    system_id: int,
    seconds: int,
    *,
    x: float = 0.0,
    y: float = 0.0,
    height: float = 10.0,
    reading: Callable[[int], float | None] = lambda t: 2.0 + t,
    home: tuple[float, float] | None = None,
    fix_after: int = 0,
    unfixed_altitude: float = 0.0,
    begin: int = 0,
) -> list[Said]:
    """Heartbeat, position and reading once a second at (x, y), metres; `home` (x, y) once, after a second.

    Before `fix_after` latitude and longitude are 0, and the altitude is `unfixed_altitude`. Before `begin` nothing is
    said.
    """
    writer = FrameWriter(system_id, 1)
    said: list[Said] = []
    for t in range(begin, seconds):
        at = START + t
        said.append((at, writer.message(autopilot_heartbeat())))
        latitude, longitude, altitude = 0.0, 0.0, unfixed_altitude
        if t >= fix_after:
            latitude, longitude, altitude = *place(x, y), GROUND + height
        payload = global_position_int_payload(latitude, longitude, altitude, height, t * 1000)
        said.append((at + 0.1, writer.frame(GLOBAL_POSITION_INT, payload)))
        if home is not None and t == begin + 1:
            said.append((at + 0.15, writer.message(home_position(*place(*home), GROUND))))
        value = reading(t)
        if value is not None:
            payload = named_value_float_payload("RAD", value, t * 1000)
            said.append((at + 0.2, writer.frame(NAMED_VALUE_FLOAT, payload)))
    return said


def ground_station(seconds: int) -> list[Said]:
    """Heartbeats of a ground station: no vehicle."""
    writer = FrameWriter(255, 190)
    return [(START + t, writer.message(companion_heartbeat())) for t in range(seconds)]


def write(path: Path, *said: Iterable[Said]) -> str:
    """A log of what several said, in order of time. Returns its name."""
    with path.open("wb") as file:
        writer = TlogWriter(file)
        for at, frame in sorted((s for one in said for s in one), key=lambda s: s[0]):
            writer.record(frame, at)
    return str(path)

"""A mission of some drones near Zurich, written into a base's store as it would arrive."""

from __future__ import annotations

import math
from pathlib import Path
from random import Random

from rass_mav.core.datum import Datum, DatumId, Fate, Kind
from rass_mav.wire.measurement import Measurement
from rass_mav.wire.nodestatus import NodeStatus, encode_status
from tests.ground.missions import EPOCH, Base

#: Where the base is: latitude and longitude, degrees.
HOME = (47.37, 8.54)
DEGREE_M = 111_320.0
#: Sources of radiation: metres north and east of the base, and uSv/h at 1 m.
SOURCES = ((260.0, 180.0, 40_000.0), (120.0, -300.0, 12_000.0))
#: Seconds between two measurements and between two statuses of a drone.
MEASURE_S, STATUS_S = 5, 60
BASE_ID = 1


def place(north_m: float, east_m: float) -> tuple[float, float]:
    """Latitude and longitude, degrees."""
    return HOME[0] + north_m / DEGREE_M, HOME[1] + east_m / DEGREE_M / math.cos(math.radians(HOME[0]))


def dose(north_m: float, east_m: float) -> float:
    """Microsieverts per hour."""
    return 0.1 + sum(s / (25.0 + (north_m - n) ** 2 + (east_m - e) ** 2) for n, e, s in SOURCES)


class Flight:
    """Drones 2, 3, ... fly lanes north of the base. The last one stays away after some time; one datum in 25 is lost on
    its way, and one in 60 is reported lost."""

    def __init__(self, path: Path, drones: int = 10, seed: int = 1) -> None:
        self.base = Base(path)
        self.begun = self.base.wall
        self._ids = range(BASE_ID + 1, BASE_ID + 1 + drones)
        self._random = Random(seed)
        self._numbers = dict.fromkeys((BASE_ID, *self._ids), 0)
        self._spots: dict[int, tuple[float, float]] = dict.fromkeys((BASE_ID, *self._ids), (0.0, 0.0))
        self._waiting: list[tuple[float, int, int, int, bytes, float, int]] = []

    def fly(self, seconds: int) -> None:
        """Let so many seconds pass, and write what arrives."""
        for _ in range(0, seconds, MEASURE_S):
            self.base.wall += MEASURE_S
            now = self.base.wall - self.begun
            for id in self._ids:
                if id != self._ids[-1] or now < 900:
                    self._act(id, now)
            if now % STATUS_S == 0:
                self._say(BASE_ID, now)
            self._deliver(now)

    def _act(self, id: int, now: float) -> None:
        lane = id - self._ids[0] - (len(self._ids) - 1) / 2
        way = 4.0 * now % 1200.0
        spot = (20.0 + min(way, 1200.0 - way), 70.0 * lane + 25.0 * math.sin(now / 40.0 + id))
        self._spots[id] = spot
        latitude, longitude = place(*spot)
        reading = dose(*spot) * self._random.uniform(0.85, 1.15)
        m = Measurement(latitude, longitude, 440.0, reading, min(reading / 60.0, 1.0), unit="usvh", error_m=1.8)
        self._create(id, Kind.MEASUREMENT, self.base.measurement(id, 0, m).payload, now)
        if now % STATUS_S == 0:
            self._say(id, now)

    def _say(self, id: int, now: float) -> None:
        spot = self._spots[id]
        near = {other: math.dist(spot, self._spots[other]) for other in self._spots if other != id}
        heard = {other: max(0.0, 1 - distance / 330.0) for other, distance in near.items()}
        hops = 0 if id == BASE_ID else 1 + int(math.hypot(*spot) // 220)
        held = 0 if id == BASE_ID else self._random.randrange(5, 60)
        alone = held // 4
        neighbours = {other: quality for other, quality in heard.items() if quality > 0.2}
        # Its route leads to the neighbour that is nearest to the base.
        next_hop = min(neighbours, key=lambda other: math.hypot(*self._spots[other]), default=None)
        status = NodeStatus(
            held, alone, held // 2, 5000 - held, min(dose(*spot) / 60.0, 1.0), hops, max(5, 98 - int(now / 40)),
            place(*spot), neighbours, {id: alone} if alone else {}, next_hop=next_hop,
        )  # fmt: skip
        if id == BASE_ID:
            status = status._replace(free=None, risk=0.0, battery=None, base=True, next_hop=None)
        self._create(id, Kind.STATUS, encode_status(status), now)

    def _create(self, id: int, kind: int, payload: bytes, now: float) -> None:
        number = self._numbers[id]
        self._numbers[id] += 1
        chance = self._random.random()
        if id != BASE_ID and chance < 0.04:
            return
        if id != BASE_ID and chance < 0.055:
            self.base.store.lose(DatumId(id, EPOCH, number), Fate.OVERFLOW if chance < 0.05 else Fate.CORRUPTED)
            return
        hops = 0 if id == BASE_ID else 1 + int(math.hypot(*self._spots[id]) // 220)
        delay = 0.0 if id == BASE_ID else self._random.expovariate(1 / (6.0 * hops**2))
        self._waiting.append((now + delay, id, number, kind, payload, now, hops))

    def _deliver(self, now: float) -> None:
        due = sorted(row for row in self._waiting if row[0] <= now)
        self._waiting = [row for row in self._waiting if row[0] > now]
        self.base.arrive(*(self._datum(row, now) for row in due))

    def _datum(self, row: tuple[float, int, int, int, bytes, float, int], now: float) -> Datum:
        _, id, number, kind, payload, created, hops = row
        return self.base.datum(id, number, kind, payload, age_s=now - created, hops=hops)

    def close(self) -> None:
        self.base.close()

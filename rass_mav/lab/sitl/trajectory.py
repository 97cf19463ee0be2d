"""Compares the data that arrived at the bases with the vehicles' true positions."""

from __future__ import annotations

import bisect
import csv
import math
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from rass_mav.app.clock import DateNote
from rass_mav.core.datum import Kind
from rass_mav.lab.medium.neighbours import Position
from rass_mav.lab.swarm.autopilot import to_arena
from rass_mav.store.reader import SqliteReader
from rass_mav.wire.measurement import decode_measurement


class Trajectories:
    """The vehicles' positions over time, from the file that the air has written."""

    def __init__(self, path: Path) -> None:
        """Read the file (columns `air.COLUMNS`)."""
        self._times: dict[int, list[float]] = defaultdict(list)
        self._places: dict[int, list[Position]] = defaultdict(list)
        with path.open(encoding="ascii", newline="") as file:
            for row in csv.DictReader(file):
                node = int(row["node"])
                self._times[node].append(float(row["time"]))
                self._places[node].append((float(row["x"]), float(row["y"])))

    def place(self, node: int, time: float) -> Position | None:
        """The last position before a time (seconds since 1970), metres; None: it had not been heard."""
        index = bisect.bisect_right(self._times[node], time) - 1
        return self._places[node][index] if index >= 0 else None


def measurements(stores: Iterable[Path], flown: Trajectories) -> dict[str, Any]:
    """Figures about the measurements in the bases' stores.

    `error_m`: distance between the position in a measurement and the vehicle's true position then, mean and largest.
    """
    seen = set()
    with_position = 0
    readings: list[float] = []
    errors: list[float] = []
    for path in stores:
        with SqliteReader(path) as store:
            offset = DateNote.of(store.meta()).offset_s
            for info in store.held():
                datum = store.get(info.id)
                if datum is None or datum.kind != Kind.MEASUREMENT or info.id in seen:
                    continue
                seen.add(info.id)
                m = decode_measurement(datum.payload)
                if m.reading is not None:
                    readings.append(m.reading)
                if m.latitude is None or m.longitude is None:
                    continue
                with_position += 1
                truth = flown.place(info.id.origin, info.created + offset)
                if truth is not None:
                    errors.append(math.dist(truth, to_arena(m.latitude, m.longitude)))
    return {
        "delivered": len(seen),
        "with_position": with_position,
        "with_reading": len(readings),
        "largest_reading": round(max(readings), 3) if readings else None,
        "error_m": {
            "mean": round(sum(errors) / len(errors), 2) if errors else None,
            "max": round(max(errors), 2) if errors else None,
        },
    }

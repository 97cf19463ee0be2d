"""What arrived at the base, for people and their scripts."""

from __future__ import annotations

import csv
from datetime import datetime, timedelta, timezone
from typing import IO, Any, NamedTuple

from rass_mav.wire.measurement import decode_measurement

from .world import ReplaySwarm

_EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)


class Arrival(NamedTuple):
    """One datum at the base. Unknown values are None; a CSV leaves them empty."""

    origin: int
    """Node id of the vehicle that created it."""
    system_id: int
    """MAVLink system id of that vehicle."""
    sequence: int
    """Number among its data, from 0."""
    time: str
    """When it was created, UTC, ISO 8601, to the millisecond."""
    latitude: float | None
    """Degrees."""
    longitude: float | None
    """Degrees."""
    altitude_m: float | None
    """Metres above mean sea level."""
    reading: float | None
    """As in the log, in its unit; of a bGeigie log in `sensor.unit`."""
    risk: float
    """Local risk at that time, 0..1."""
    delay_s: float
    """From its creation to its arrival, seconds."""
    hops: int
    """Hand-overs so far."""


def utc(time_us: int) -> str:
    """Microseconds since 1970 as UTC in ISO 8601, to the millisecond."""
    # Adding is exact, and unaffected by the year 2038 or local time.
    return (_EPOCH + timedelta(microseconds=time_us)).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def arrivals(swarm: ReplaySwarm) -> list[Arrival]:
    """The data at the base, in order of creation."""
    ledger, base, recording = swarm.ledger, swarm.stores[0], swarm.recording
    rows = []
    for id, step in sorted(ledger.arrived.items(), key=lambda item: (ledger.born[item[0]], item[0])):
        datum = base.get(id)
        if datum is None:
            continue
        made = decode_measurement(datum.payload)
        born = ledger.born[id]
        rows.append(
            Arrival(
                id.origin,
                recording.vehicles[id.origin - 1].system_id,
                id.sequence,
                utc(recording.start_us + round(born * swarm.step_s * 1e6)),
                made.latitude,
                made.longitude,
                made.altitude,
                # The wire has a 32-bit float: more digits than it holds would be invented.
                None if made.reading is None else float(f"{made.reading:.7g}"),
                round(made.risk, 5),
                round((step - born) * swarm.step_s, 6),
                datum.hops,
            )
        )
    return rows


def write_csv(rows: list[Arrival], file: IO[str]) -> None:
    """A header and a line for each. `file`: open for writing with newline=""."""
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(Arrival._fields)
    writer.writerows(rows)


def summary(swarm: ReplaySwarm, rows: list[Arrival]) -> dict[str, Any]:
    """What `replay --json` prints, except the wall times: the summary of a swarm, and the figures about the logs."""
    recording = swarm.recording
    risk = swarm.agents[0].settings.risk
    readings = [row.reading for row in rows if row.reading is not None]
    base = swarm.base
    result = swarm.statistics.summary()
    result["records"] = {
        "read": sum(file.read for file in recording.files),
        "used": sum(file.used for file in recording.files),
        "rejected": sum(file.rejected for file in recording.files),
    }
    result["delivered_with_position"] = sum(row.latitude is not None for row in rows)
    result["delivered_with_reading"] = len(readings)
    result["readings"] = {"min": min(readings), "max": max(readings)} if readings else None
    result["risk"] = {"low": risk.low, "high": risk.high}
    result["base"] = None if base is None else {"lat": base.latitude, "lon": base.longitude, "alt_m": base.altitude}
    result["start"], result["end"] = utc(recording.start_us), utc(recording.end_us)
    result["vehicles"] = [
        {"node": node, "system_id": vehicle.system_id, "file": vehicle.file}
        for node, vehicle in enumerate(recording.vehicles, start=1)
    ]
    result["files"] = [
        {"file": file.name, "read": file.read, "used": file.used, "rejected": file.rejected} for file in recording.files
    ]
    return result

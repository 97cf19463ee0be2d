"""The content of the logs: vehicles with their frames, the place of home, the largest reading."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from rass_mav.errors import ConfigError, LogError, os_errors_as
from rass_mav.lab.replay.settings import CountsSettings
from rass_mav.mavlink.messages import GLOBAL_POSITION_INT, HOME_POSITION, NAMED_VALUE_FLOAT
from rass_mav.mavlink.telemetry import Position, Telemetry
from rass_mav.sensor.bgeigie import SENTENCE
from rass_mav.sensor.bgeigie_log import load_bgeigie
from rass_mav.sensor.dose import DoseMeter

from .tlog import Record, TlogReader, spoken, system_id_of

# How many bytes of a file are searched for a bGeigie sentence.
_HEAD = 4096


@dataclass
class Vehicle:
    """One vehicle of one file."""

    file: str
    """The file, as it was named."""
    system_id: int
    """MAVLink system id, 1..255."""
    records: list[tuple[int, bytes]]
    """(microseconds since 1970, frame) of all its components, in order of time."""


@dataclass
class LogFile:
    """One file, and how much of it could be read."""

    name: str
    read: int
    """Records, and damaged stretches."""
    used: int
    """Intact records."""
    vehicles: list[Vehicle]
    """In order of system id; none if it contains no autopilot."""

    @property
    def rejected(self) -> int:
        """Damaged records and stretches."""
        return self.read - self.used


@dataclass
class Recording:
    """All logs together. At least one vehicle."""

    files: list[LogFile]
    vehicles: list[Vehicle] = field(init=False)
    """In order of file, then system id. The node id of a vehicle is its index here, counted from 1."""
    start_us: int = field(init=False)
    """The first record of a vehicle, microseconds since 1970."""
    end_us: int = field(init=False)
    """The last one."""
    home: Position | None
    """The first HOME_POSITION, else the first position with a fix; None: neither."""
    highest: float | None
    """The largest reading; None: no reading at all."""

    def __post_init__(self) -> None:
        """Collect what the files hold."""
        self.vehicles = [vehicle for file in self.files for vehicle in file.vehicles]
        self.start_us = min(vehicle.records[0][0] for vehicle in self.vehicles)
        self.end_us = max(vehicle.records[-1][0] for vehicle in self.vehicles)

    @property
    def span_s(self) -> float:
        """From the first to the last record, seconds."""
        return (self.end_us - self.start_us) / 1e6


def has_fix(position: Position) -> bool:
    """False for latitude and longitude 0, which autopilots send before their first fix; the altitude may be known."""
    return bool(position.latitude or position.longitude)


class _Scan:
    """One system id of one file, with the telemetry that a node uses."""

    def __init__(self, system_id: int, reading_name: str) -> None:
        self.records: list[tuple[int, bytes]] = []
        self.home: tuple[int, Position] | None = None
        self.first: tuple[int, Position] | None = None
        self.highest: float | None = None
        self._telemetry = Telemetry(system_id, reading_name=reading_name)

    def take(self, record: Record) -> None:
        time_us, raw, frame = record
        self.records.append((time_us, raw))
        telemetry = self._telemetry
        if frame is None or not telemetry.handle(frame, time_us / 1e6):
            return
        if frame.message_id == NAMED_VALUE_FLOAT:
            value = telemetry.reading.value if telemetry.reading is not None else None
            if value is not None and (self.highest is None or value > self.highest):
                self.highest = value
        elif frame.message_id == GLOBAL_POSITION_INT and self.first is None:
            self.first = _placed(time_us, telemetry.position)
        elif frame.message_id == HOME_POSITION and self.home is None:
            self.home = _placed(time_us, telemetry.home)

    @property
    def is_vehicle(self) -> bool:
        """Whether it has an autopilot: by its heartbeat, or (heartbeats may be damaged) by messages that only one
        sends."""
        telemetry = self._telemetry
        return any((telemetry.heartbeat_at is not None, telemetry.position, telemetry.reading, telemetry.home))


def _placed(time_us: int, position: Position | None) -> tuple[int, Position] | None:
    return (time_us, position) if position is not None and has_fix(position) else None


def read_logs(paths: Sequence[str], *, reading_name: str = "RAD", meter: DoseMeter | None = None) -> Recording:
    """Read logs, damaged ones as far as possible. Two vehicles may share a system id: each file has its own.

    :param reading_name: of the NAMED_VALUE_FLOAT that is the reading.
    :param meter: turns the counts of bGeigie logs into readings; None: uSv/h as Safecast does.
    :raises ConfigError: a file cannot be opened.
    :raises LogError: a file has no valid record, or none contains a vehicle.
    """
    meter = meter or CountsSettings().meter()
    files: list[LogFile] = []
    scans: list[_Scan] = []
    for path in paths:
        file, found = _read(path, reading_name, meter)
        files.append(file)
        scans += found
    if not scans:
        raise LogError(f"{', '.join(paths)}: contains no vehicle: no autopilot (component 1) sends frames")
    homes = [scan.home for scan in scans if scan.home] or [scan.first for scan in scans if scan.first]
    readings = [scan.highest for scan in scans if scan.highest is not None]
    return Recording(
        files,
        # By time; records of the same time in the order of vehicles.
        home=min(homes, key=lambda placed: placed[0])[1] if homes else None,
        highest=max(readings, default=None),
    )


def _read(path: str, reading_name: str, meter: DoseMeter) -> tuple[LogFile, list[_Scan]]:
    scans: dict[int, _Scan] = {}
    used = 0
    with os_errors_as(ConfigError, path), Path(path).open("rb") as stream:
        head = stream.read(_HEAD)
        stream.seek(0)
        reader = TlogReader(stream)
        for record in reader:
            used += 1
            system_id = record.raw[5] if record.raw[0] == 0xFD else record.raw[3]
            if system_id:
                scan = scans.get(system_id)
                if scan is None:
                    scan = scans[system_id] = _Scan(system_id, reading_name)
                scan.take(record)
    if not used:
        if SENTENCE.search(head):
            return _read_bgeigie(path, reading_name, meter)
        raise LogError(f"{path}: no valid MAVLink record; expected a telemetry log (.tlog) or a bGeigie log (.LOG)")
    found = {system_id: scan for system_id, scan in sorted(scans.items()) if scan.is_vehicle}
    vehicles = []
    for system_id, scan in found.items():
        # Stable: records of the same microsecond stay in the order of the file.
        scan.records.sort(key=lambda record: record[0])
        vehicles.append(Vehicle(path, system_id, scan.records))
    return LogFile(path, reader.read, used, vehicles), list(found.values())


def _read_bgeigie(path: str, reading_name: str, meter: DoseMeter) -> tuple[LogFile, list[_Scan]]:
    log = load_bgeigie(path)
    system_id = system_id_of(log)
    scan = _Scan(system_id, reading_name)
    for record in spoken(log, system_id, reading_name, meter):
        scan.take(record)
    return LogFile(path, log.read, log.read - log.rejected, [Vehicle(path, system_id, scan.records)]), [scan]

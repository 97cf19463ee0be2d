"""What is found in logs: vehicles, home, the largest reading; and which files are refused."""

from __future__ import annotations

import operator
from functools import partial
from pathlib import Path

import pytest

from rass_mav.errors import ConfigError, LogError
from rass_mav.lab.replay.recording import read_logs
from tests.some import some

from .logs import GROUND, START, ground_station, place, vehicle, write


def test_one_vehicle_a_file_or_several_in_one(tmp_path: Path) -> None:
    one = write(tmp_path / "b.tlog", vehicle(7, 5))
    many = write(tmp_path / "a.tlog", vehicle(9, 5), vehicle(2, 5), ground_station(5))
    recording = read_logs([one, many])
    # In order of the command line, then of system id; the ground station flies nowhere.
    assert [(v.file, v.system_id) for v in recording.vehicles] == [(one, 7), (many, 2), (many, 9)]
    assert [frame for _, frame in recording.vehicles[2].records] == [frame for _, frame in vehicle(9, 5)]
    assert [(file.read, file.used, file.rejected) for file in recording.files] == [(15, 15, 0), (35, 35, 0)]


def test_one_system_id_in_two_files_is_two_vehicles(tmp_path: Path) -> None:
    paths = [write(tmp_path / f"{n}.tlog", vehicle(1, 5, x=n)) for n in range(2)]
    recording = read_logs(paths)
    assert [v.file for v in recording.vehicles] == paths


def test_the_time_line_is_that_of_all_logs_together(tmp_path: Path) -> None:
    early = write(tmp_path / "early.tlog", vehicle(1, 5))
    late = write(tmp_path / "late.tlog", vehicle(2, 30, begin=20))
    recording = read_logs([late, early])
    assert recording.start_us == round(START * 1e6)
    assert recording.span_s == pytest.approx(29.2)


def test_records_are_sorted_by_time(tmp_path: Path) -> None:
    said = [(at - (0.35 if n % 4 == 2 else 0.0), frame) for n, (at, frame) in enumerate(vehicle(1, 5))]
    path = tmp_path / "a.tlog"
    with path.open("wb") as file:
        for at, frame in said:
            file.write(round(at * 1e6).to_bytes(8, "big") + frame)
    times = [time_us for time_us, _ in read_logs([str(path)]).vehicles[0].records]
    assert times == sorted(round(at * 1e6) for at, _ in said)
    assert times != [round(at * 1e6) for at, _ in said]


def test_the_first_home_counts(tmp_path: Path) -> None:
    late = write(tmp_path / "late.tlog", vehicle(1, 9, x=50, home=(60, 0), begin=3))
    early = write(tmp_path / "early.tlog", vehicle(2, 9, x=20, home=(30, 0)))
    home = some(read_logs([late, early]).home)
    assert (home.latitude, home.longitude) == pytest.approx(place(30, 0), abs=1e-7)
    assert home.altitude == GROUND


@pytest.mark.parametrize("altitude", [0.0, 584.0])
def test_without_home_the_first_fix_counts_and_zeros_are_none(tmp_path: Path, altitude: float) -> None:
    late = write(tmp_path / "late.tlog", vehicle(1, 9, x=50, fix_after=6))
    early = write(tmp_path / "early.tlog", vehicle(2, 9, x=20, height=3.0, fix_after=4, unfixed_altitude=altitude))
    home = some(read_logs([late, early]).home)
    assert (home.latitude, home.longitude) == pytest.approx(place(20, 0), abs=1e-7)
    assert home.altitude == GROUND + 3.0


def test_no_position_and_no_reading(tmp_path: Path) -> None:
    recording = read_logs([write(tmp_path / "a.tlog", vehicle(1, 5, fix_after=99, reading=lambda t: None))])
    assert recording.home is None
    assert recording.highest is None


def test_the_largest_reading_by_its_name(tmp_path: Path) -> None:
    paths = [write(tmp_path / f"{n}.tlog", vehicle(n, 5, reading=partial(operator.add, 10.0 * n))) for n in (1, 2)]
    assert read_logs(paths).highest == 24.0
    assert read_logs(paths, reading_name="DOSE").highest is None


def test_a_log_whose_heartbeats_are_gone_still_has_its_vehicle(tmp_path: Path) -> None:
    said = [s for s in vehicle(4, 5) if s[1][7] != 0]
    recording = read_logs([write(tmp_path / "a.tlog", said)])
    assert [v.system_id for v in recording.vehicles] == [4]


@pytest.mark.parametrize("content", [b"", b"\0", b"no log at all\n" * 100, bytes(5000), b"\xfd" * 3000])
def test_a_file_without_one_valid_record_is_refused(tmp_path: Path, content: bytes) -> None:
    good = write(tmp_path / "good.tlog", vehicle(1, 5))
    bad = tmp_path / "bad.tlog"
    bad.write_bytes(content)
    with pytest.raises(LogError, match=r"bad\.tlog: no valid MAVLink record"):
        read_logs([good, str(bad)])


def test_logs_without_a_vehicle_are_refused_together_only(tmp_path: Path) -> None:
    ground = write(tmp_path / "ground.tlog", ground_station(5))
    with pytest.raises(LogError, match="no vehicle"):
        read_logs([ground])
    recording = read_logs([ground, write(tmp_path / "a.tlog", vehicle(1, 5))])
    assert [len(file.vehicles) for file in recording.files] == [0, 1]


def test_a_file_that_cannot_be_opened(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.tlog: no such file"):
        read_logs([str(tmp_path / "none.tlog")])
    with pytest.raises(ConfigError, match="is a directory"):
        read_logs([str(tmp_path)])

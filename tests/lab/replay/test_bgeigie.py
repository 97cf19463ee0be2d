"""bGeigie logs through the nodes: a vehicle each, with the positions and counts of the log."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from rass_mav.cli import main
from rass_mav.errors import LogError
from rass_mav.lab.replay.arrivals import Arrival, arrivals, summary
from rass_mav.lab.replay.recording import read_logs
from rass_mav.lab.replay.settings import load_settings
from rass_mav.lab.replay.world import ReplaySwarm
from rass_mav.lab.swarm.invariants import check
from rass_mav.sensor.dose import DoseMeter, Tube
from tests.commands import json_output, output
from tests.extent import extents
from tests.sensor.sentences import sentence

from .logs import START, vehicle, write

SAMPLES = Path(__file__).parents[4] / "shared" / "data" / "bgeigie"
needs_samples = pytest.mark.skipif(
    not SAMPLES.exists(), reason="needs ../shared/data/bgeigie, which is not part of the repository"
)


def at(second: int) -> bytes:
    return b"2012-09-20T15:%02d:%02dZ" % divmod(second, 60)


def drive(path: Path, lines: Sequence[bytes]) -> str:
    path.write_bytes(b"\r\n".join([b"# NEW LOG", *lines]) + b"\r\n")
    return str(path)


def played(*paths: str, keys: tuple[str, ...] = (), range_m: float = 1e5) -> tuple[list[Arrival], dict[str, Any]]:
    settings, scale = load_settings(range_m, keys)
    recording = read_logs(paths, meter=settings.sensor.meter())
    swarm = ReplaySwarm(recording, settings.with_highest(recording.highest) if scale else settings)
    swarm.run(swarm.span_steps, after=check)
    rows = arrivals(swarm)
    return rows, summary(swarm, rows)


#: The risk is that of the last reading.
AT_ONCE = ("risk.gain=1",)
MINUTE = [
    sentence(time=at(n), cpm=33 * n, valid=b"V" if n < 20 else b"A", fix=b"V" if n < 10 else b"A") for n in range(61)
]


def test_counts_and_places_arrive_at_the_base(tmp_path: Path) -> None:
    rows, result = played(drive(tmp_path / "a.LOG", MINUTE), keys=AT_ONCE)
    assert result["records"] == {"read": 61, "used": 61, "rejected": 0}
    assert result["vehicles"] == [{"node": 1, "system_id": 204, "file": str(tmp_path / "a.LOG")}]
    assert result["start"] == "2012-09-20T15:00:00.000Z"
    assert (result["base"]["lat"], result["base"]["lon"]) == pytest.approx((52.311975, 4.7608383), abs=1e-7)
    assert all(row.latitude is not None for row in rows)
    # Made at steps 11, 21 ...; each of the counts as 33 n counts a minute; before 20 s they were not valid. At step 1
    # nothing was known, and nothing was made.
    assert [row.reading for row in rows] == [None, *(pytest.approx(33 * n / 334) for n in (21, 31, 41, 51))]
    assert [row.risk for row in rows] == pytest.approx([1.0, 0.35, 0.51667, 0.68333, 0.85], abs=1e-4)
    assert rows[-1].altitude_m == 4.8


@pytest.mark.no_cover
@pytest.mark.parametrize(
    ("keys", "reading"),
    [
        (("sensor.unit=cpm",), 33.0 * 51),
        (("sensor.unit=cps",), 33.0 * 51 / 60),
        (("sensor.tube=sbm-20", "sensor.dead_time_us=0"), 33.0 * 51 / 106),
        (("sensor.cpm_per_usvh=100",), 33.0 * 51 / 100),
        (("sensor.unit=cps", "sensor.dead_time_us=10000"), 28.05 / (1 - 0.2805)),
    ],
)
def test_the_unit_and_the_tube_are_settings(tmp_path: Path, keys: tuple[str, ...], reading: float) -> None:
    rows, _ = played(drive(tmp_path / "a.LOG", MINUTE), keys=keys)
    assert rows[-1].reading == pytest.approx(reading)


def test_background_and_a_logarithmic_scale(tmp_path: Path) -> None:
    keys = ("sensor.unit=cpm", "risk.background=83", "risk.scale=logarithmic", "risk.low=1", "risk.high=2560000")
    rows, _ = played(drive(tmp_path / "a.LOG", MINUTE), keys=(*keys, *AT_ONCE))
    # 51 * 33 - 83 = 1600 is the root of 2560000.
    assert rows[-1].risk == pytest.approx(0.5, abs=1e-4)
    # The largest reading is risk 1, whatever the background.
    rows, result = played(drive(tmp_path / "a.LOG", MINUTE), keys=("sensor.unit=cpm", "risk.background=33", *AT_ONCE))
    assert result["risk"]["high"] == 33 * 59
    assert rows[-1].risk == pytest.approx(50 / 59, abs=1e-4)


def test_damaged_records_are_counted_and_cost_nothing_else(tmp_path: Path) -> None:
    lines = [
        *MINUTE[:30],
        b"rubbish",
        MINUTE[30][:-2] + b"zz",
        sentence(longitude=b"-07355.3663", ew=b"W"),
        *MINUTE[31:],
    ]
    rows, result = played(drive(tmp_path / "a.LOG", lines))
    assert result["records"] == {"read": 63, "used": 60, "rejected": 3}
    assert len(rows) == 5


def test_a_drive_beside_a_flight(tmp_path: Path) -> None:
    flight = write(
        tmp_path / "b.tlog", [(said - START + 1348153200, frame) for said, frame in vehicle(204, 60, fix_after=15)]
    )
    rows, result = played(drive(tmp_path / "a.LOG", MINUTE), flight)
    assert [v["system_id"] for v in result["vehicles"]] == [204, 204]
    assert result["records"]["read"] == 61 + 180
    assert {row.origin for row in rows} == {1}, "the flight is far away, on another continent"
    assert result["created"] == 5 + 6


@pytest.mark.parametrize(("device", "system_id"), [(1, 1), (255, 255), (256, 1), (2048, 8), (0, 255)])
def test_the_devices_number_becomes_a_system_id(tmp_path: Path, device: int, system_id: int) -> None:
    path = drive(tmp_path / "a.LOG", [sentence(device=device)])
    assert [v.system_id for v in read_logs([path]).vehicles] == [system_id]


def test_readings_go_through_the_meter(tmp_path: Path) -> None:
    path = drive(tmp_path / "a.LOG", [sentence(cpm=600)])
    assert read_logs([path], meter=DoseMeter(Tube(50.0, 0.0))).highest == 12.0


@pytest.mark.parametrize("comments", [b"", b"# NEW LOG\n", b"# DriverName = THS\n# TripInfo = Test\n# NEW LOG\n"])
def test_a_log_without_one_valid_record_says_why(tmp_path: Path, comments: bytes) -> None:
    path = tmp_path / "drive.LOG"
    path.write_bytes(comments + sentence(latitude=b"nowhere") + b"\n")
    with pytest.raises(LogError, match=r"no valid bGeigie record \(1 rejected; line \d: expected dddmm"):
        read_logs([str(path)])


def test_the_command_takes_both_kinds(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = drive(tmp_path / "a.LOG", [*MINUTE, b"$BNRDD,damaged*00"])
    result = json_output(capsys, "replay", path, "--set", "sensor.unit=cpm")
    assert result["records"] == {"read": 62, "used": 61, "rejected": 1}
    assert result["readings"]["max"] == 33 * 51
    assert "a.LOG: damaged, 1 of 62 records rejected" in output(capsys, "replay", path).out
    assert main(["replay", path, "--set", "sensor.tube=best"]) == 2
    assert "replay: sensor.tube: expected one of j305, lnd-7317" in capsys.readouterr().err


@pytest.mark.no_cover
@needs_samples
@pytest.mark.parametrize("every", extents(16, 1))
def test_an_airliner_between_two_continents(every: int, tmp_path: Path) -> None:
    """`every`: of so many records one."""
    lines = (SAMPLES / "flight-204-part1.LOG").read_bytes().splitlines(keepends=True)
    records = [line for line in lines if line.startswith(b"$")][::every]
    path = tmp_path / "flight.LOG"
    path.write_bytes(b"".join(records))
    rows, result = played(str(path), keys=("sensor.unit=cpm",), range_m=3e7)
    assert result["records"] == {"read": len(records), "used": len(records), "rejected": 0}
    assert result["delivered"] == result["created"] == result["delivered_with_position"]
    # Cosmic radiation grows with the height.
    ground = [row.reading for row in rows if row.altitude_m is not None and row.altitude_m < 100 and row.reading]
    high = [row.reading for row in rows if row.altitude_m is not None and row.altitude_m > 10_000 and row.reading]
    assert max(ground) < 100 < 400 < min(high)


@needs_samples
def test_a_counter_that_never_had_a_fix() -> None:
    _, result = played(str(SAMPLES / "bgeigie.log"))
    assert result["records"] == {"read": 23, "used": 23, "rejected": 0}
    assert result["base"] is None
    # Every ten seconds, but not in the first minute: the counter says itself that its counts are not valid yet.
    assert result["held"] == result["created"] == 5

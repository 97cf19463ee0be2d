"""`rass-mav replay` as a person or a script calls it."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from rass_mav.cli import main
from rass_mav.lab.replay.tlog import TlogReader
from tests.commands import json_output, output
from tests.environment import environment

from .logs import START, place, vehicle, write


@pytest.fixture
def flight(tmp_path: Path) -> list[str]:
    """Three vehicles in a row, three hops from home at 12 m of range; the second log is damaged in one record."""
    paths = []
    for n in (1, 2, 3):
        said = vehicle(n, 40, x=10.0 * n, height=0.0, home=(0, 0) if n == 1 else None)
        paths.append(write(tmp_path / f"vehicle-{n}.tlog", said))
    damaged = bytearray(Path(paths[1]).read_bytes())
    damaged[30] ^= 0xFF
    Path(paths[1]).write_bytes(damaged)
    return paths


def asked(capsys: pytest.CaptureFixture[str], *arguments: str) -> Any:
    """The one JSON object on stdout; nothing is on stderr."""
    return json_output(capsys, "replay", *arguments)


def test_the_summary_is_that_of_a_swarm_and_more(flight: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    summary = asked(capsys, *flight, "--range", "12", "--check")
    assert json_output(capsys, "swarm", "--nodes", "4", "--steps", "5").keys() < summary.keys()
    assert summary["topology"] == "replay"
    assert summary["records"] == {"read": 361, "used": 360, "rejected": 1}
    assert summary["delivered_with_position"] == summary["delivered_with_reading"] > 6
    assert [v["node"] for v in summary["vehicles"]] == [1, 2, 3]
    assert summary["routing"]["max_hop_count"] == 3


def test_people_read_what_arrived_and_what_was_damaged(flight: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    out = output(capsys, "replay", *flight, "--range", "12").out
    assert "361 records, 360 used, 1 rejected" in out
    assert "vehicle-2.tlog: damaged, 1 of 120 records rejected" in out
    assert "arrived: " in out
    assert "risk 1 at 41" in out


def test_the_csv_holds_what_arrived(flight: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "arrived.csv"
    summary = asked(capsys, *flight, "--range", "12", "-o", str(path))
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == summary["delivered"]
    for row in rows:
        latitude, longitude = place(10.0 * int(row["origin"]), 0.0)
        assert float(row["latitude"]) == pytest.approx(latitude, abs=2e-7)
        assert float(row["longitude"]) == pytest.approx(longitude, abs=2e-7)
        assert int(row["hops"]) == int(row["system_id"]) == int(row["origin"])
    assert sum(bool(row["reading"]) for row in rows) == summary["delivered_with_reading"]


def test_the_tape_holds_every_frame_at_the_time_of_the_logs(
    flight: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "air.tlog"
    summary = asked(capsys, *flight, "--record", str(path))
    with path.open("rb") as file:
        records = list(TlogReader(file))
    assert len(records) == summary["frames"]["sent"]
    assert sum(len(record.raw) for record in records) == summary["bytes_sent"]
    times = [record.time_us / 1e6 for record in records]
    assert times[0] == START
    assert times[-1] == START + summary["steps"] - 1


@pytest.mark.parametrize("option", ["--record", "-o"])
def test_a_log_is_not_written_over(flight: list[str], option: str, capsys: pytest.CaptureFixture[str]) -> None:
    before = Path(flight[0]).read_bytes()
    assert "is one of the logs to replay" in output(capsys, "replay", *flight, option, flight[0], code=2).err
    assert Path(flight[0]).read_bytes() == before


@pytest.mark.no_cover
def test_base_takes_southern_latitudes(flight: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    latitude, longitude = place(40.0, 0.0)
    assert latitude < 0
    for text in (f"{latitude},{longitude}", f"{latitude}, {longitude}"):
        summary = asked(capsys, *flight, "--base", text, "--range", "12")
        assert (summary["base"]["lat"], summary["base"]["lon"]) == (latitude, longitude)
        assert summary["delivered"] > 6


@pytest.mark.parametrize("text", ["here", "1", "1,2,3", "91,0", "0,181", "nan,0", "-"])
def test_a_base_that_is_no_place(flight: list[str], text: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as failure:
        main(["replay", *flight, "--base", text])
    assert failure.value.code == 2
    assert "--base" in capsys.readouterr().err


def test_settings_by_key(flight: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    summary = asked(capsys, *flight, "--set", "data.interval_steps=20", "--set", "policy.name=hop-count")
    assert summary["created"] == 6
    assert summary["policy"] == "hop-count"
    assert main(["replay", *flight, "--set", "data.intervall=1"]) == 2
    assert "replay: data.intervall: unknown key" in capsys.readouterr().err


def test_draining_until_all_has_arrived(flight: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    summary = asked(capsys, *flight, "--range", "12", "--drain", "300")
    assert summary["held"] == 0
    assert summary["created"] == summary["delivered"]


def test_a_file_without_a_valid_record_fails_the_run(
    flight: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bad = tmp_path / "bad.tlog"
    bad.write_bytes(b"\0" * 100)
    assert main(["replay", *flight, str(bad), "--json"]) == 1
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1
    assert "bad.tlog: no valid MAVLink record" in captured.err
    assert json.loads(captured.out)["error"] == [captured.err.rstrip("\n")]


def test_a_missing_file_is_bad_usage(flight: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert output(capsys, "replay", *flight, "nowhere.tlog", code=2).err == "nowhere.tlog: no such file or directory\n"


def test_a_truncated_log_is_used_as_far_as_it_goes(flight: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    whole = Path(flight[2]).read_bytes()
    Path(flight[2]).write_bytes(whole[: len(whole) // 2 + 5])
    summary = asked(capsys, *flight, "--range", "12")
    assert summary["records"]["rejected"] == 2
    assert 290 < summary["records"]["used"] < 310
    assert summary["delivered"] > 6


def test_the_same_logs_give_the_same_summary_in_any_process(flight: list[str]) -> None:
    def summary(hash_seed: str, *arguments: str) -> dict[str, Any]:
        done = subprocess.run(
            [sys.executable, "-m", "rass_mav", "replay", "--json", "--range", "12", *flight, *arguments],
            env=environment(PYTHONHASHSEED=hash_seed),
            capture_output=True,
            text=True,
            check=True,
        )
        result: dict[str, Any] = json.loads(done.stdout)
        del result["wall_s"], result["cpu_s"], result["robot_steps_per_s"]
        return result

    loss = ("--set", "radio.loss=0.2")
    first = summary("0", *loss)
    assert first == summary("4242", *loss)
    assert first["air_sha256"] != summary("0", *loss, "--set", "seed=2")["air_sha256"]


def test_help_has_an_example(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as done:
        main(["replay", "--help"])
    assert done.value.code == 0
    assert "example: rass-mav replay" in capsys.readouterr().out

"""firmware_params/rass_rad.lua does what it says, on a small stub of ArduPilot's scripting API."""

from __future__ import annotations

import re
import shutil
import statistics
import subprocess
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import pytest

LUA = next((found for name in ("lua5.3", "lua53", "lua5.4", "lua") if (found := shutil.which(name))), None)
pytestmark = pytest.mark.skipif(LUA is None, reason="Lua 5.3 is not installed (Debian: apt install lua5.3)")

ROOT = Path(__file__).parents[1]
SCRIPT = ROOT / "firmware_params" / "rass_rad.lua"
STUB = Path(__file__).with_name("ardupilot_stub.lua")


class Said(NamedTuple):
    readings: list[tuple[float, float]]
    """(seconds, value) of each NAMED_VALUE_FLOAT RAD."""
    texts: list[str]
    """STATUSTEXT messages."""

    @property
    def values(self) -> list[float]:
        return [value for _, value in self.readings]


def run(seconds: int, *options: str) -> Said:
    assert LUA is not None
    done = subprocess.run(
        [LUA, str(STUB), str(SCRIPT), str(seconds), *options], capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    said = Said([], [])
    for line in done.stdout.splitlines():
        kind, at, rest = line.split(" ", 2)
        if kind == "TEXT":
            said.texts.append(rest)
        else:
            assert kind == "RAD"
            said.readings.append((float(at), float(rest)))
    return said


def serial(tmp_path: Path, lines: list[str]) -> str:
    file = tmp_path / "counter.txt"
    file.write_text("\n".join(lines) + "\n")
    return f"serial={file}"


def test_a_serial_counter(tmp_path: Path) -> None:
    lines = [f"CPS, {n}, CPM, {60 * n}, uSv/hr, 0.07, SLOW" for n in range(20)]
    said = run(30, serial(tmp_path, lines))
    assert said.values == list(range(20))
    times = [at for at, _ in said.readings]
    assert all(0.8 <= later - earlier <= 1.2 for earlier, later in pairwise(times))


def test_a_counter_that_tells_a_minute_only_and_lines_that_are_garbage(tmp_path: Path) -> None:
    said = run(10, serial(tmp_path, ["CPM: 120", "hello", "CPS, x, CPM, 60", "C" * 500, "CPS=7.5", "\x07\x80"]))
    assert said.values == [2.0, 1.0, 7.5]


def test_a_silent_counter_is_told_once_and_sends_nothing(tmp_path: Path) -> None:
    said = run(40, serial(tmp_path, ["CPS, 3", *[""] * 20, "CPS, 4"]))
    assert said.values == [3.0, 4.0]
    assert said.texts == [
        "6 rass_rad: the counter is heard",
        "4 rass_rad: the counter is silent",
        "6 rass_rad: the counter is heard",
        "4 rass_rad: the counter is silent",
    ]


def test_no_port_is_told_and_looked_for_again() -> None:
    said = run(60)
    assert (said.readings, said.texts) == ([], ["4 rass_rad: no serial port with protocol 28"])


@pytest.mark.parametrize("counted", [0, 10, 1000, 5000])
def test_dead_time(counted: int, tmp_path: Path) -> None:
    (value,) = run(5, serial(tmp_path, [f"CPS, {counted}"]), "RADS_DEAD_US=100").values
    assert value == pytest.approx(counted / (1 - counted * 1e-4))


def test_a_saturated_tube_gives_a_large_finite_reading(tmp_path: Path) -> None:
    (value,) = run(5, serial(tmp_path, ["CPS, 20000"]), "RADS_DEAD_US=100").values
    assert value == pytest.approx(20 * 20000)


@pytest.mark.parametrize(("edges", "share"), [(1, 0.5), (2, 1.0)])
@pytest.mark.parametrize("changes", [1, 20, 200])
def test_pulses_on_a_pin(changes: int, edges: int, share: float) -> None:
    said = run(30, "RADS_SOURCE=2", "RADS_PIN=54", f"RADS_EDGES={edges}", f"pulses={changes}")
    assert len(said.values) >= 25
    assert statistics.fmean(said.values) == pytest.approx(changes * share, rel=0.1)


def test_a_pin_that_is_not_set() -> None:
    assert run(30, "RADS_SOURCE=2").texts == ["4 rass_rad: set RADS_PIN to the pin of the counter"]


@pytest.mark.parametrize(("place", "mean"), [("30,40,0", 200.5), ("30,40,-10", 100.5), ("1000000,0,0", 0.5)])
def test_a_source_made_up(place: str, mean: float) -> None:
    """RADS_CPS at the source, half of it at 10 m with a decay of 0.01, the background far away; with counting noise."""
    source = ["RADS_SOURCE=3", "RADS_NORTH=30", "RADS_EAST=40", "RADS_CPS=200", "RADS_DECAY=0.01"]
    values = run(2000, *source, f"place={place}").values
    assert len(values) == 2000
    # Six standard deviations of a mean over counts that are Poisson distributed.
    assert statistics.fmean(values) == pytest.approx(mean, abs=6 * (mean / len(values)) ** 0.5)
    assert statistics.variance(values) == pytest.approx(mean, rel=0.3)


def test_without_a_position_nothing_is_made_up() -> None:
    said = run(20, "RADS_SOURCE=3")
    assert (said.readings, said.texts) == ([], ["6 rass_rad: waiting for a position"])


def test_off() -> None:
    assert run(20, "RADS_SOURCE=0") == Said([], ["6 rass_rad: off (RADS_SOURCE)"])


def test_the_head_names_every_parameter_and_no_other() -> None:
    text = SCRIPT.read_text("ascii")
    code = set(re.findall(r'\{ "([A-Z_]+)",', text))
    assert code == set(re.findall(r"RADS_([A-Z_]+)", text.split("\nlocal NAME")[0]))

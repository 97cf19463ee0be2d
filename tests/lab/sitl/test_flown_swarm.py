"""`rass-mav sitl`: vehicles fly, nodes deliver, and nothing is left behind."""

from __future__ import annotations

import csv
import json
import math
import os
import shutil
import signal
import subprocess
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

import psutil
import pytest

from rass_mav.cli import main
from rass_mav.mavlink.frames import FrameReader
from rass_mav.mavlink.messages import TUNNEL
from rass_mav.mavlink.tunnel import decode_tunnel
from tests.environment import environment
from tests.patience import PATIENCE_S
from tests.some import some

pytest.importorskip("mavsdk.asyncio.mavsdk", reason="MAVSDK 4 is not installed (it is made for 64-bit computers only)")

ROOT = Path(__file__).parents[3]
THREE = str(ROOT / "sitl" / "three-copters.yaml")
SIX = str(ROOT / "sitl" / "six-copters.yaml")
#: With real firmware: until its GPS is believed, the flight, and the rest.
REAL_DEADLINE_S = 420.0
#: A base, a relay that hovers, and a vehicle that flies out of the base's range and back; small and quick.
QUICK = """# made by a test
nodes: 3
steps: 100
topology: positions
arena_m: 200
mobility: {positions: [[0, 0], [3, 0], [3, 3]]}
flight:
  altitude_m: 2
  speed_m_s: 20
  missions:
    - [[70, 0, 2.5]]
    - [[40, 0, 5]]
node: {step_s: 0.1}
data: {interval_steps: 3}
radio: {range_m: 50}
radiation: {sources: [[70, 10, 100], [0, 100, 1]], decay: 0.01, noise: 0.5}
risk: {low: 5, high: 100}
"""


def command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "rass_mav", "sitl", *arguments]


def fly(*arguments: str, deadline_s: float = PATIENCE_S, path: str | None = None) -> tuple[dict[str, Any], str]:
    """The summary, and what was said on stderr."""
    done = subprocess.run(
        command(*arguments, "--json"),
        capture_output=True,
        text=True,
        timeout=deadline_s,
        check=False,
        env=environment(**({} if path is None else {"PATH": path})),
    )
    assert done.returncode == 0, done.stderr
    summary: dict[str, Any] = json.loads(done.stdout)
    return summary, done.stderr


@pytest.fixture
def quick(tmp_path: Path) -> str:
    path = tmp_path / "quick.yaml"
    path.write_text(QUICK)
    return str(path)


def rows(directory: Path) -> list[dict[str, str]]:
    with (directory / "track.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def track(directory: Path) -> dict[int, list[tuple[float, float]]]:
    places = defaultdict(list)
    for row in rows(directory):
        places[int(row["node"])].append((float(row["x"]), float(row["y"])))
    return places


def check_delivery(summary: dict[str, Any]) -> None:
    assert summary["created"] == summary["delivered"] + summary["held"] > 0
    assert summary["delivered"] > 0
    assert summary["altered"] == 0
    assert summary["reliability"] == 1.0
    assert summary["frames"]["malformed"] == 0
    assert summary["transport"]["name"] == "sitl"
    found = summary["sitl"]["measurements"]
    assert found["delivered"] == summary["delivered"]
    # The first of each vehicle may be made before its autopilot has been heard.
    assert min(found["with_position"], found["with_reading"]) > 0.7 * found["delivered"]


def test_the_mock_flies_its_mission_beside_the_autopilots(quick: str, tmp_path: Path) -> None:
    kept, tape = tmp_path / "kept", tmp_path / "air.tlog"
    summary, said = fly(quick, "--mock", "--keep", str(kept), "--record", str(tape))
    assert said == ""
    check_delivery(summary)
    flight = summary["sitl"]
    assert (flight["firmware"], flight["wiring"], flight["readings"]) == ("mock", "beside-autopilots", "injected")
    assert flight["missions"] == {"finished": [1, 2], "unfinished": [], "not_flown": []}
    # Out of range of the base: over the relay.
    assert summary["hops"]["p95"] == 2
    assert summary["routing"]["max_hop_count"] >= 2
    # It went where the mission says, and no farther; so says the simulator.
    first, second = flight["vehicles"]
    assert first["farthest_m"] == pytest.approx(67, abs=0.2)
    assert second["farthest_m"] == pytest.approx(math.hypot(37, 3), abs=0.2)
    assert first["highest_m"] == pytest.approx(2, abs=0.1)
    places = track(kept)
    assert max(x for x, _ in places[1]) == pytest.approx(70, abs=0.2)
    # A position is at most a second old, at 20 m/s; and a look at the truth 0.2 s.
    assert flight["measurements"]["error_m"]["max"] < 20 * 1.5
    assert flight["measurements"]["largest_reading"] > 20
    # What a vehicle says to people is in its log.
    assert "Arming motors" in (kept / "vehicle-1.log").read_text()
    # Everything on the tape is a node's own.
    frames = FrameReader().feed(tape.read_bytes())
    assert len(frames) == summary["frames"]["sent"]
    assert {(frame.message_id, frame.component_id) for frame in frames} == {(TUNNEL, 191)}


def fake_arducopter(place: Path) -> str:
    """A program with ArduCopter's name and options: the mock, which ends if it is started in another way."""
    place.mkdir()
    binary = place / "arducopter"
    binary.write_text(f'#!/bin/sh\nPYTHONPATH={ROOT} exec {sys.executable} -m rass_mav.lab.sitl.mock_copter "$@"\n')
    binary.chmod(0o755)
    return str(binary)


def test_through_the_autopilots_of_a_binary_on_the_path(quick: str, tmp_path: Path) -> None:
    place = tmp_path / "bin"
    fake_arducopter(place)
    tape = tmp_path / "air.tlog"
    path = f"{place}{os.pathsep}{os.environ['PATH']}"
    # A telemetry radio is slower: with longer steps there are fewer beacons on it.
    pace = ("--set", "node.step_s=0.2", "--steps", "50")
    summary, said = fly(quick, "--through-autopilots", *pace, "--record", str(tape), path=path)
    assert said == ""
    check_delivery(summary)
    flight = summary["sitl"]
    assert (flight["firmware"], flight["wiring"], summary["steps"]) == ("arducopter", "through-autopilots", 50)
    assert summary["hops"]["p95"] == 2
    assert flight["missions"] == {"finished": [1, 2], "unfinished": [], "not_flown": []}
    # What the autopilots send by themselves is on the air too, and what nodes say is passed on verbatim.
    frames = FrameReader().feed(tape.read_bytes())
    ours = [frame for frame in frames if frame.message_id == TUNNEL]
    assert len(frames) == summary["frames"]["sent"] == len(ours) + flight["telemetry_frames"]
    assert flight["telemetry_frames"] > 0
    assert {(frame.system_id, frame.component_id) for frame in ours} == {(1, 191), (2, 191), (3, 191)}
    assert {decode_tunnel(frame.payload).payload_type for frame in ours} == {33200}
    # MAVSDK's own words (system 245) stay on its wire.
    assert {frame.system_id for frame in frames} == {1, 2, 3}


def test_a_node_that_is_killed_comes_back_and_an_autopilot_does_not(quick: str, tmp_path: Path) -> None:
    """The relay's autopilot dies when it is above its place: its node relays on, and the other vehicle flies on.

    There is no binary either: it says how to get one, and flies mock ones.
    """
    empty = tmp_path / "empty"
    empty.mkdir()
    failures = "failures={kill_every_s: 3, kill_autopilots: [[2, 4]]}"
    summary, said = fly(quick, "--set", failures, "--keep", str(tmp_path / "kept"), path=str(empty))
    assert len(said.splitlines()) == 1
    assert said.startswith("no arducopter or px4 on PATH. ArduCopter: build it")
    assert "mock flight controllers instead" in said
    assert summary["sitl"]["firmware"] == "mock"
    assert summary["created"] == summary["delivered"] + summary["held"] > 0
    assert summary["reliability"] == 1.0
    assert summary["transport"]["kills"] == 3
    flight = summary["sitl"]
    assert flight["missions"] == {"finished": [1], "unfinished": [2], "not_flown": []}
    flier, relay = flight["vehicles"]
    assert flier["killed_s"] is None
    assert flier["farthest_m"] == pytest.approx(67, abs=0.2)
    assert 4 <= relay["killed_s"] < 10
    # Its wreck lies under the place where it was.
    last = [row for row in rows(tmp_path / "kept") if row["node"] == "2"][-1]
    assert float(last["x"]) > 30
    assert float(last["height"]) == 0
    assert relay["true_positions"] < flier["true_positions"]
    assert summary["hops"]["p95"] == 2


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["none.yaml"], "none.yaml: no such file or directory"),
        (["QUICK", "--binary", "none/arducopter"], "--binary none/arducopter: no such program"),
        (["QUICK", "--mock", "--vehicles", "3"], "--vehicles: expected 1..2"),
        (["QUICK", "--firmware", "px4"], "--firmware px4: no arducopter or px4 on PATH"),
        (["QUICK", "--mock", "--set", "failures.die_fraction=0.5"], "failures.die_fraction: not for flying vehicles"),
        (
            ["QUICK", "--mock", "--set", "disk={}", "--set", "radiation.corruption=false"],
            "disk: not for flying vehicles",
        ),
    ],
)
def test_what_cannot_be_flown_is_one_line(
    quick: str,
    tmp_path: Path,
    arguments: list[str],
    expected: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert main(["sitl", *(quick if word == "QUICK" else word for word in arguments)]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert expected in said.err
    assert len(said.err.splitlines()) == 1


def test_a_vehicle_that_ends_fails_the_run_with_what_it_said(quick: str, tmp_path: Path) -> None:
    binary = tmp_path / "arducopter"
    binary.write_text("#!/bin/sh\necho out of memory\nexit 5\n")
    binary.chmod(0o755)
    done = subprocess.run(
        command(quick, "--binary", str(binary)),
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
        env=environment(),
    )
    assert done.returncode == 1
    assert done.stderr in [f"vehicle {n}: ended with exit code 5: out of memory\n" for n in (1, 2)]


# -- nothing is left behind --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("number", "code"),
    # The fleet's own tests try SIGINT too.
    [
        pytest.param(signal.SIGINT, 130, marks=pytest.mark.soak),
        pytest.param(signal.SIGTERM, 143),
        pytest.param(signal.SIGKILL, -9),
    ],
    ids=str,
)
def test_no_process_outlives_the_command(quick: str, number: int, code: int) -> None:
    process = subprocess.Popen(
        command(quick, "--mock", "-v"), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=environment()
    )
    try:
        # In full flight.
        assert any("flying" in line for line in some(process.stderr))
        children = psutil.Process(process.pid).children(recursive=True)
        # Radio, pilot, two vehicles, three nodes.
        assert len(children) == 7
        process.send_signal(number)
        assert process.wait(PATIENCE_S) == code
        _, alive = psutil.wait_procs(children, PATIENCE_S)
        assert not alive
    finally:
        process.kill()
        process.wait()
        some(process.stderr).close()


# -- real firmware -----------------------------------------------------------------------------------------------------


@pytest.mark.skipif(
    shutil.which("arducopter") is None,
    reason="no arducopter on PATH (docs/contribute/sitl-and-replay.md says how to get it)",
)
def test_three_arducopters_deliver_readings_through_the_autopilots(tmp_path: Path) -> None:
    summary, _ = fly(
        THREE, "--firmware", "arducopter", "--through-autopilots", "--keep", str(tmp_path / "kept"),
        deadline_s=REAL_DEADLINE_S,
    )  # fmt: skip
    check_delivery(summary)
    flight = summary["sitl"]
    assert (flight["firmware"], flight["readings"]) == ("arducopter", "script")
    assert summary["hops"]["p95"] == 2
    assert flight["missions"] == {"finished": [1, 2, 3], "unfinished": [], "not_flown": []}
    assert all(vehicle["highest_m"] > 10 for vehicle in flight["vehicles"])
    assert flight["vehicles"][0]["farthest_m"] > 60


@pytest.mark.skipif(
    shutil.which("arducopter") is None,
    reason="no arducopter on PATH (docs/contribute/sitl-and-replay.md says how to get it)",
)
def test_five_of_six_arducopters_fly_on_when_an_autopilot_dies() -> None:
    killed = "failures.kill_autopilots=[[3, 45]]"
    summary, _ = fly(SIX, "--firmware", "arducopter", "--set", killed, deadline_s=REAL_DEADLINE_S)
    check_delivery(summary)
    flight = summary["sitl"]
    assert flight["missions"] == {"finished": [1, 2, 4, 5, 6], "unfinished": [3], "not_flown": []}
    assert [vehicle["node_id"] for vehicle in flight["vehicles"] if vehicle["killed_s"] is not None] == [3]
    assert summary["routing"]["max_hop_count"] >= 4


@pytest.mark.skipif(
    shutil.which("px4") is None, reason="no px4 on PATH (docs/contribute/sitl-and-replay.md says how to get it)"
)
def test_three_px4_vehicles_deliver_readings(tmp_path: Path) -> None:
    summary, _ = fly(THREE, "--firmware", "px4", "--keep", str(tmp_path / "kept"), deadline_s=REAL_DEADLINE_S)
    check_delivery(summary)
    assert (summary["sitl"]["firmware"], summary["sitl"]["readings"]) == ("px4", "injected")
    assert all(vehicle["highest_m"] > 10 for vehicle in summary["sitl"]["vehicles"])

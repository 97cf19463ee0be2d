"""Which firmware flies, how it is started, and that it never outlives us."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from rass_mav.cli import main
from rass_mav.errors import ConfigError
from rass_mav.lab.fleet.air_server import Ports
from rass_mav.lab.fleet.tether import become_arguments
from rass_mav.lab.medium.neighbours import RangeGraph
from rass_mav.lab.sitl.firmware import arducopter_parameters, find_firmware, made_up_readings, prepare
from rass_mav.lab.sitl.mission import CMD_RETURN, CMD_SPEED, CMD_TAKEOFF, CMD_WAYPOINT
from rass_mav.lab.sitl.mock_copter import GUIDED, NO_FORWARD, mode_after_boot, read_defaults
from rass_mav.lab.sitl.pilot import need_mavsdk
from rass_mav.lab.sitl.scenario import FlightScenario, load_flight
from rass_mav.lab.swarm.autopilot import to_earth
from tests.patience import PATIENCE_S
from tests.some import some

ROOT = Path(__file__).parents[3]
FILE = str(ROOT / "sitl" / "three-copters.yaml")
PORTS = Ports(
    air=[0] * 4,
    vehicle=[0] * 4,
    serial0=[0, 5010, 5020, 5030],
    serial1=[0, 5011, 5021, 5031],
    serial2=[0, 5012, 5022, 5032],
    station=[0] * 4,
)
LUA = next((found for name in ("lua5.3", "lua53", "lua5.4", "lua") if (found := shutil.which(name))), None)


@pytest.fixture
def programs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A PATH with nothing on it."""
    place = tmp_path / "bin"
    place.mkdir()
    monkeypatch.setenv("PATH", str(place))
    return place


def program(path: Path) -> str:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("#!/bin/sh\n")
    path.chmod(0o755)
    return str(path)


def test_the_firmware_is_the_one_named_or_the_first_on_the_path(programs: Path, tmp_path: Path) -> None:
    assert find_firmware() is None
    px4 = program(programs / "px4")
    found = some(find_firmware())
    assert (found.name, found.command, found.script) == ("px4", (px4,), None)
    copter = program(programs / "arducopter")
    found = some(find_firmware())
    assert (found.name, found.command) == ("arducopter", (copter,))
    found = some(find_firmware(kind="px4"))
    assert found.command == (px4,)
    elsewhere = program(tmp_path / "build" / "my-copter")
    found = some(find_firmware(elsewhere))
    assert (found.name, found.command) == ("arducopter", (elsewhere,))
    found = some(find_firmware(mock=True))
    assert found.name == "mock"
    with pytest.raises(ConfigError, match=r"--binary .*nowhere: no such program"):
        find_firmware(str(tmp_path / "nowhere"))


def test_arducopter_is_started_with_its_home_ports_and_parameters(programs: Path, tmp_path: Path) -> None:
    copter = program(programs / "arducopter")
    firmware = some(find_firmware())
    scenario = load_flight(FILE)
    directory = tmp_path / "vehicle-2"
    arguments = prepare(firmware, scenario, PORTS, 2, directory, scripted=True)
    command = arguments[arguments.index("--") + 1 :]
    assert command[0] == copter
    options = dict(zip(command[1::2], command[2::2], strict=True))
    latitude, longitude = to_earth(6, 6)
    assert [float(part) for part in options["--home"].split(",")] == pytest.approx(
        [latitude, longitude, 100.0, 0.0], abs=1e-7
    )
    assert [options[f"--serial{n}"] for n in range(3)] == [f"udpclient:127.0.0.1:{5020 + n}" for n in range(3)]
    values = read_defaults(options["--defaults"])
    assert (values["MAV_SYSID"], values["SYSID_THISMAV"], values["SCR_ENABLE"]) == (3.0, 3.0, 1.0)
    assert arguments[: arguments.index("--")][-1] == str(directory)  # eeprom, logs and scripts are looked for there
    assert (directory / "scripts" / "rass_rad.lua").is_file()


def parameters() -> dict[str, float]:
    lines = arducopter_parameters(5, scripted=False).splitlines()
    return {name: float(value) for name, value in (line.split() for line in lines)}


def test_motors_start_in_a_mode_that_needs_a_position() -> None:
    """The simulated radio control has a mode switch; with it the vehicle would be armed before it can fly a mission."""
    assert mode_after_boot(parameters()) == GUIDED


def test_the_ground_station_is_not_on_the_air() -> None:
    values = parameters()
    # Before 4.7, and since.
    assert int(values["SERIAL0_OPTIONS"]) & NO_FORWARD
    assert int(values["MAV1_OPTIONS"]) & 2
    assert values["SCR_ENABLE"] == 0
    assert all(len(name) <= 16 for name in values)


def test_px4_is_started_with_its_home_and_instance(tmp_path: Path) -> None:
    binary = program(tmp_path / "opt" / "bin" / "px4")
    firmware = some(find_firmware(binary))
    scenario = load_flight(FILE)
    with pytest.raises(ConfigError, match=r"expected PX4's files in .*opt/etc"):
        prepare(firmware, scenario, PORTS, 1, tmp_path / "none", scripted=False)
    (tmp_path / "opt" / "etc").mkdir()
    arguments = prepare(firmware, scenario, PORTS, 3, tmp_path / "vehicle-3", scripted=False)
    cut = arguments.index("--")
    assert arguments[cut + 1 :] == [
        binary, "-d", "-i", "3", "-w", str(tmp_path / "vehicle-3"), str(tmp_path / "opt" / "etc"),
    ]  # fmt: skip
    variables = dict(setting.split("=") for setting in arguments[:cut] if "=" in setting)
    assert variables["PX4_SIM_MODEL"] == "sihsim_quadx"
    assert float(variables["PX4_HOME_LAT"]) == pytest.approx(to_earth(6, -6)[0], abs=1e-7)


@pytest.mark.skipif(LUA is None, reason="Lua 5.3 is not installed (Debian: apt install lua5.3)")
def test_the_script_makes_up_what_the_scenario_says(tmp_path: Path) -> None:
    scenario = load_flight(FILE)
    script = tmp_path / "rass_rad.lua"
    text = (ROOT / "firmware_params" / "rass_rad.lua").read_text(encoding="utf-8")
    script.write_text(made_up_readings(text, scenario, 2), encoding="utf-8")

    def mean_at(x: float, y: float, height: float) -> float:
        start = scenario.places[2]
        place = f"place={y - start[1]},{x - start[0]},{-height}"
        stub = str(ROOT / "tests" / "ardupilot_stub.lua")
        done = subprocess.run(
            [some(LUA), stub, str(script), "400", place], capture_output=True, text=True, timeout=60, check=True
        )
        values = [float(line.split()[2]) for line in done.stdout.splitlines() if line.startswith("RAD")]
        assert len(values) > 300
        return sum(values) / len(values)

    for place in ((50.0, -40.0, 0.0), (50.0, -20.0, 15.0), (90.0, 0.0, 15.0)):
        assert mean_at(*place) == pytest.approx(scenario.level(*place), rel=0.15)


def test_another_script_is_refused() -> None:
    with pytest.raises(ConfigError, match="expected one parameter SOURCE, found 0"):
        made_up_readings("return", load_flight(FILE), 1)


# -- scenarios ---------------------------------------------------------------------------------------------------------


def test_a_mission_is_take_off_speed_places_and_return() -> None:
    scenario = load_flight(FILE)
    items = scenario.mission(1, home_first=True)
    assert [item.command for item in items] == [
        CMD_WAYPOINT, CMD_TAKEOFF, CMD_SPEED, CMD_WAYPOINT, CMD_WAYPOINT, CMD_WAYPOINT, CMD_RETURN,
    ]  # fmt: skip
    assert items[4][2:6] == (*to_earth(90, 0), 15.0, 12.0)
    assert scenario.mission(1, home_first=False) == items[1:]


def test_drones_without_a_mission_stay_where_they_are() -> None:
    scenario = load_flight(str(ROOT / "sitl" / "three-vehicles.yaml"))
    stay = scenario.mission(3, home_first=True)[3]
    assert stay[2:4] == to_earth(40, -30)
    assert stay.param1 == pytest.approx(scenario.steps * scenario.node.step_s)


def test_fewer_vehicles_are_the_first_ones() -> None:
    scenario = load_flight(FILE, vehicles=1)
    assert (scenario.nodes, len(scenario.places), len(scenario.flight.missions)) == (2, 2, 1)
    some = load_flight(FILE, assignments=["failures.kill_autopilots=[[1, 5], [3, 9]]"], vehicles=2)
    assert some.failures.kill_autopilots == ((1, 5.0),)
    with pytest.raises(ConfigError, match=r"--vehicles: expected 1..3"):
        load_flight(FILE, vehicles=4)


@pytest.mark.parametrize(
    ("assignment", "expected"),
    [
        ("topology=grid", "topology: expected positions"),
        ("flight.missions=[[[1]]]", "flight.missions"),
        ("flight.missions=[[], [], [], []]", "at most one for each of 3 drones"),
        ("failures.kill_autopilots=[[0, 5]]", "failures.kill_autopilots: expected drones, 1..3, got 0"),
        ("failures.kill_autopilots=[[4, 5]]", "failures.kill_autopilots: expected drones, 1..3, got 4"),
        ("flight.speed_m_s=0", "flight.speed_m_s: expected a number > 0"),
        ("radiation.drift=1", "sources that do not move"),
        ("radiation.law=dose", "expected paper with flying vehicles, got dose"),
        ("flight.height=3", "flight.height"),
        ("variants={rass: {node: {step_s: 1}}}", "variants"),
    ],
)
def test_what_cannot_be_flown_is_said_in_one_line(assignment: str, expected: str) -> None:
    with pytest.raises(ConfigError, match=r"three-copters.yaml") as caught:
        load_flight(FILE, assignments=[assignment])
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_last_of_six_vehicles_is_four_hops_from_the_base() -> None:
    scenario = load_flight(str(ROOT / "sitl" / "six-copters.yaml"))
    flown = [scenario.waypoints(n)[0] for n in range(1, 7)]
    graph = RangeGraph([scenario.places[0], *((x, y) for x, y, _ in flown)], scenario.radio.range_m)
    # Two lanes, 1 and 3, and 2 and 4: without either of them there is still a way.
    assert graph.neighbours == [[1, 2], [0, 2, 3], [0, 1, 4], [1, 4, 5], [2, 3, 5], [3, 4, 6], [5]]


def test_levels_count_the_height_in() -> None:
    scenario: FlightScenario = load_flight(FILE)
    assert scenario.level(50, -40, 0) == 200
    assert scenario.level(50, -40, 10) == scenario.level(60, -40, 0) == 100


def test_without_mavsdk_it_says_what_is_needed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "mavsdk.asyncio", raising=False)
    monkeypatch.setitem(sys.modules, "mavsdk", None)
    with pytest.raises(ConfigError, match=r"needs MAVSDK 4 to fly: pip install -e '\.\[sitl\]' in the checkout"):
        need_mavsdk()


def test_without_mavsdk_it_does_not_announce_a_flight(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PATH", "")
    monkeypatch.delitem(sys.modules, "mavsdk.asyncio", raising=False)
    monkeypatch.setitem(sys.modules, "mavsdk", None)
    assert main(["sitl", str(FILE)]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert line.startswith("sitl needs MAVSDK 4 to fly: ")


# -- the tether --------------------------------------------------------------------------------------------------------


def test_a_tether_becomes_the_command_and_keeps_its_stdout_quiet(tmp_path: Path) -> None:
    command = ["sh", "-c", 'echo "$WORD in $(pwd)"; exit 3']
    arguments = become_arguments(str(tmp_path), {"WORD": "said"}, command)
    done = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (3, "", f"said in {tmp_path}\n")
    missing = become_arguments(str(tmp_path), {}, [str(tmp_path / "none")])
    done = subprocess.run([sys.executable, *missing], capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert (done.returncode, done.stderr) == (127, f"{tmp_path}/none: no such file or directory\n")


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux kills a child with its parent")
def test_firmware_dies_with_its_parent(tmp_path: Path) -> None:
    # It ignores all that can be ignored, as firmware may.
    stubborn = ["sh", "-c", "trap '' TERM INT HUP PIPE; echo up >&2; while :; do sleep 0.1; done"]
    code = (
        "import subprocess, sys\n"
        "from rass_mav.lab.fleet.tether import become_arguments\n"
        f"arguments = become_arguments({str(tmp_path)!r}, {{}}, {stubborn!r})\n"
        "child = subprocess.Popen([sys.executable, *arguments], stderr=subprocess.PIPE)\n"
        "child.stderr.readline()\n"
        "print(child.pid, flush=True)\n"
        "child.wait()\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    try:
        firmware = psutil.Process(int(some(parent.stdout).readline()))
        parent.kill()
        parent.wait(PATIENCE_S)
        _, alive = psutil.wait_procs([firmware], PATIENCE_S)
        assert not alive
    finally:
        parent.kill()
        parent.wait()
        some(parent.stdout).close()

"""`rass-mav params` against a mock flight controller over real UDP and a real pseudo-terminal."""

from __future__ import annotations

import io
import json
import os
import socket
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rass_mav.cli import main
from tests.app.app_nodes import RunningNode
from tests.commands import Output, output
from tests.mock_vehicle import INT8, INT16, INT32, PX4, REAL32, MockVehicle
from tests.ptys import SerialDevice
from tests.virtual import VirtualTime

FOLDER = Path(__file__).parents[2] / "firmware_params"
FILE = """\
# Ground station.
SYSID_MYGCS 255
# Takes effect after a reboot.
SERIAL2_PROTOCOL 2
SR2_POSITION 0.1
SYSID_THISMAV 1
"""


@pytest.fixture
def config(tmp_path: Path, virtual: VirtualTime) -> tuple[str, int]:
    """A configuration whose autopilot speaks to a port of this host; and that port."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        port = int(sock.getsockname()[1])
    file = tmp_path / "drone.yaml"
    file.write_text(
        f"node: {{id: 7, role: base}}\nautopilot: {{url: 'udpin:127.0.0.1:{port}'}}\nstore: {{path: {tmp_path}/n.db}}\n"
    )
    return str(file), port


def ardupilot(**parameters: tuple[float, int]) -> MockVehicle:
    vehicle = MockVehicle()
    vehicle.parameters = {
        "SYSID_MYGCS": (255, INT16),
        "SERIAL2_PROTOCOL": (1, INT8),
        # As 32 bits hold it.
        "SR2_POSITION": (0.10000000149011612, REAL32),
        "SYSID_THISMAV": (1, INT16),
        **parameters,
    }
    return vehicle


def params(tmp_path: Path, action: str, text: str, *options: str, name: str = "file.parm") -> int:
    file = tmp_path / name
    file.write_text(text)
    return main(["params", action, str(file), *options])


Capture = pytest.CaptureFixture[str]


class Live:
    """The command, with a mock vehicle where the configuration says that one is."""

    def __init__(self, path: str, port: int, folder: Path, capture: Capture, virtual: VirtualTime) -> None:
        self.path, self.port, self.folder, self.capture = path, port, folder, capture
        self.virtual = virtual

    def __call__(
        self,
        vehicle: MockVehicle,
        action: str,
        *options: str,
        text: str = FILE,
        file: Path | None = None,
        code: int = 0,
    ) -> Output[str]:
        """`file`: of the parameters; None: one with this text."""
        if file is None:
            file = self.folder / "file.parm"
            file.write_text(text)
        with vehicle.on_udp(self.port, self.virtual):
            return output(self.capture, "params", action, str(file), "--live", self.path, *options, code=code)


@pytest.fixture
def live(config: tuple[str, int], tmp_path: Path, capsys: Capture, virtual: VirtualTime) -> Live:
    return Live(*config, tmp_path, capsys, virtual)


def test_a_file_without_a_vehicle(tmp_path: Path, capsys: Capture) -> None:
    assert params(tmp_path, "check", FILE) == 0
    assert capsys.readouterr().out == f"{tmp_path}/file.parm: ok, 4 parameters\n"
    assert params(tmp_path, "check", FILE, "--json") == 0
    assert json.loads(capsys.readouterr().out) == {
        "file": f"{tmp_path}/file.parm", "format": "ardupilot", "parameters": 4,
    }  # fmt: skip
    assert params(tmp_path, "check", "A b\n") == 2
    assert capsys.readouterr().err == f"{tmp_path}/file.parm: line 1: expected a number that fits 32 bits, got 'b'\n"


def test_check_says_what_differs_and_changes_nothing(live: Live) -> None:
    vehicle = ardupilot()
    printed = live(vehicle, "check", code=1)
    assert vehicle.sets == []
    # The node's own identity, and its heartbeat before anything else.
    assert vehicle.heard[0].get_type() == "HEARTBEAT"
    assert {message.get_srcComponent() for message in vehicle.heard} == {191}
    assert printed.out.splitlines() == [
        "vehicle 1: ArduPilot 4.6.3 disarmed",
        "  SERIAL2_PROTOCOL 1 -> 2, needs a reboot",
        "1 different, 3 the same",
    ]


def test_all_the_same_is_exit_code_0(live: Live) -> None:
    said = json.loads(live(ardupilot(SERIAL2_PROTOCOL=(2, INT8)), "check", "--json").out)
    assert said["vehicle"] == {"system_id": 1, "firmware": "ArduPilot", "version": "4.6.3", "armed": False}
    assert (said["fitting_file"], said["misfit"]) == ("ardupilot-4.6.parm", None)
    assert [parameter["state"] for parameter in said["parameters"]] == 4 * ["same"]


def test_lost_questions_are_asked_again(live: Live) -> None:
    vehicle = ardupilot(SERIAL2_PROTOCOL=(2, INT8))
    seen: dict[str, int] = {}

    def every_first(message: Any) -> bool:
        if message.get_type() != "PARAM_REQUEST_READ":
            return False
        seen[message.param_id] = seen.get(message.param_id, 0) + 1
        return seen[message.param_id] == 1

    vehicle.lose = every_first
    live(vehicle, "check")
    assert min(seen.values()) >= 2


def test_write_shows_the_list_first_and_reads_back(
    monkeypatch: pytest.MonkeyPatch, capsys: Capture, live: Live
) -> None:
    vehicle = ardupilot()

    class Person:
        def readline(self) -> str:
            self.shown = capsys.readouterr()
            assert vehicle.sets == []
            return "y\n"

    person = Person()
    monkeypatch.setattr(sys, "stdin", person)
    printed = live(vehicle, "write")
    assert "  SERIAL2_PROTOCOL 1 -> 2, needs a reboot\n" in person.shown.out
    assert person.shown.err == "Write 1 to vehicle 1? [y/N] "
    assert vehicle.sets == ["SERIAL2_PROTOCOL"]
    assert vehicle.parameters["SERIAL2_PROTOCOL"] == (2, INT8)
    out = printed.out
    assert "  SERIAL2_PROTOCOL written: 2, needs a reboot\n" in out
    assert out.endswith("3 the same, 1 written\nreboot the autopilot: some of these take effect only then\n")


@pytest.mark.parametrize("answer", ["", "\n", "n\n", "yesterday\n"])
def test_without_a_yes_nothing_is_written(answer: str, monkeypatch: pytest.MonkeyPatch, live: Live) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO(answer))
    vehicle = ardupilot()
    printed = live(vehicle, "write", code=1)
    assert vehicle.sets == []
    assert printed.out.endswith("nothing written: not confirmed (--yes skips the question)\n")


def test_scripts_get_one_object_and_the_list_on_stderr(live: Live) -> None:
    said = live(ardupilot(), "write", "--yes", "--json")
    assert {p["name"]: (p["state"], p["vehicle"]) for p in json.loads(said.out)["parameters"]} == {
        "SYSID_MYGCS": ("same", 255), "SERIAL2_PROTOCOL": ("written", 2),
        "SR2_POSITION": ("same", pytest.approx(0.1)), "SYSID_THISMAV": ("same", 1),
    }  # fmt: skip
    assert "SERIAL2_PROTOCOL 1 -> 2" in said.err


def test_a_refused_value_is_told_with_its_reason(live: Live) -> None:
    vehicle = ardupilot(SYSID_MYGCS=(250, INT16))
    vehicle.refusing = {"SERIAL2_PROTOCOL": 5, "SYSID_MYGCS": None}
    out = live(vehicle, "write", "--yes", code=1).out
    assert "  SERIAL2_PROTOCOL refused: 1, not 2: it is read-only\n" in out
    assert "  SYSID_MYGCS      refused: 250, not 255: the vehicle keeps its value\n" in out
    assert vehicle.parameters["SERIAL2_PROTOCOL"] == (1, INT8)


def test_lost_answers_do_not_matter_since_it_is_read_back(live: Live) -> None:
    vehicle = ardupilot()
    lost: list[str] = []

    def first_set(message: Any) -> bool:
        if message.get_type() == "PARAM_SET" and not lost:
            lost.append(message.param_id)
            return True
        return False

    vehicle.lose = first_set
    live(vehicle, "write", "--yes")
    assert lost == ["SERIAL2_PROTOCOL"]
    assert vehicle.parameters["SERIAL2_PROTOCOL"] == (2, INT8)


@pytest.mark.parametrize("at_once", [True, False], ids=["at once", "after a reboot"])
def test_the_system_id_changes_under_our_feet(at_once: bool, live: Live) -> None:
    vehicle = ardupilot()
    vehicle.id_changes = at_once
    printed = live(vehicle, "write", "--yes", "--sysid", "12")
    assert vehicle.sets == ["SERIAL2_PROTOCOL", "SYSID_THISMAV"]
    assert vehicle.system_id == (12 if at_once else 1)
    reboot = "" if at_once else ", needs a reboot"
    assert f"  SYSID_THISMAV    written: 12{reboot}\n" in printed.out


def test_a_system_id_that_waits_for_a_reboot(live: Live) -> None:
    vehicle = ardupilot(SERIAL2_PROTOCOL=(2, INT8), SYSID_THISMAV=(12, INT16))
    printed = live(vehicle, "check", "--sysid", "12")
    still = "  SYSID_THISMAV    12, but the vehicle still uses 1: reboot it\n"
    assert still in printed.out


def test_a_system_id_is_not_set_unasked(
    tmp_path: Path, config: tuple[str, int], virtual: VirtualTime, capsys: Capture
) -> None:
    path, port = config
    with MockVehicle(3).on_udp(port, virtual) as vehicle:
        vehicle.parameters = ardupilot(SYSID_THISMAV=(3, INT16)).parameters
        assert params(tmp_path, "check", FILE, "--live", path) == 1
        assert params(tmp_path, "write", FILE, "--live", path, "--yes", "--json") == 1
        assert vehicle.sets == ["SERIAL2_PROTOCOL"]
    said = capsys.readouterr()
    line = "  SYSID_THISMAV    kept: 3, not 1: use --sysid to set a system id\n"
    assert line in said.out
    assert line in said.err
    (entry,) = [p for p in json.loads(said.out.splitlines()[-1])["parameters"] if p["name"] == "SYSID_THISMAV"]
    assert (entry["state"], entry["vehicle"], entry["file"]) == ("kept", 3, 1)


@pytest.mark.parametrize(
    ("vehicle", "name", "kind"),
    [
        (MockVehicle(version=(4, 7, 0)), "MAV_SYSID", INT16),
        (MockVehicle(firmware=PX4, version=(1, 15, 2)), "MAV_SYS_ID", INT32),
    ],
    ids=["ArduPilot 4.7", "PX4"],
)
def test_each_firmware_calls_its_system_id_otherwise(vehicle: MockVehicle, name: str, kind: int, live: Live) -> None:
    vehicle.parameters = {name: (1, kind), "X": (1, kind)}
    printed = live(vehicle, "write", "--yes", "--sysid", "9", text="X 1\n")
    assert vehicle.parameters[name] == (9, kind)
    assert f"  {name:16} 1 -> 9" in printed.out


def test_a_firmware_whose_system_id_nobody_knows(live: Live) -> None:
    vehicle = MockVehicle(firmware=0)
    vehicle.parameters = {"X": (2, INT16)}
    printed = live(vehicle, "write", "--yes", "--sysid", "9", text="X 1\n", code=1)
    assert vehicle.sets == []
    assert "name for the system id is unknown" in printed.err


@pytest.mark.parametrize("number", ["0", "256", "two", "1.0"])
def test_what_is_no_system_id(number: str, tmp_path: Path, config: tuple[str, int], capsys: Capture) -> None:
    with pytest.raises(SystemExit) as ended:
        params(tmp_path, "write", FILE, "--live", config[0], "--sysid", number)
    assert ended.value.code == 2
    assert "expected a system id, 1 to 255" in capsys.readouterr().err
    assert params(tmp_path, "check", FILE, "--sysid", "7") == 2
    assert capsys.readouterr().err == "--sysid: requires --live\n"


def test_an_armed_vehicle_is_left_alone(live: Live) -> None:
    vehicle = ardupilot()
    vehicle.armed = True
    printed = live(vehicle, "write", "--yes", code=1)
    assert vehicle.sets == []
    assert printed.out.endswith("nothing written: vehicle 1 is armed\n")


def values_of(file: str, kind: Callable[[str], int]) -> dict[str, tuple[float, int]]:
    from rass_mav.params.files import read_file

    return {entry.name: (entry.value, kind(entry.name)) for entry in read_file(FOLDER / file).entries}


def test_a_file_of_another_version_says_which_to_use_and_is_not_written(live: Live) -> None:
    vehicle = MockVehicle(version=(4, 8, 0))
    vehicle.parameters = values_of("ardupilot-4.7.parm", lambda _: INT16)
    vehicle.parameters["SERIAL2_BAUD"] = (57, INT16)
    vehicle.parameters["SERIAL2_OPTIONS"] = (0, INT16)
    out = live(vehicle, "write", "--yes", file=FOLDER / "ardupilot-4.6.parm", code=1).out
    assert "  SYSID_MYGCS      missing: this firmware calls it MAV_GCS_SYSID\n" in out
    assert "  SR2_POSITION     missing: this firmware calls it MAV3_POSITION\n" in out
    assert "nothing written: the file is for another version of ArduPilot; use ardupilot-4.7.parm\n" in out
    assert vehicle.sets == []


def test_what_a_board_does_not_have_is_told_and_the_rest_is_written(live: Live) -> None:
    vehicle = MockVehicle(version=(4, 7, 0))
    vehicle.parameters = values_of("ardupilot-4.7.parm", lambda _: INT16)
    del vehicle.parameters["BRD_SER2_RTSCTS"]
    vehicle.parameters["SERIAL2_BAUD"] = (57, INT16)
    printed = live(vehicle, "write", "--yes", file=FOLDER / "ardupilot-4.7.parm", code=1)
    assert "  BRD_SER2_RTSCTS  missing: not in this firmware or on this board\n" in printed.out
    assert vehicle.sets == ["SERIAL2_BAUD"]


def test_px4_gets_whole_numbers_as_their_bytes(live: Live) -> None:
    vehicle = MockVehicle(firmware=PX4, version=(1, 15, 2))
    vehicle.parameters = values_of("px4.params", lambda _: INT32)
    vehicle.parameters |= {"SER_TEL2_BAUD": (57600, INT32), "MAV_1_RATE": (-1, INT32)}
    del vehicle.parameters["MAV_1_CONFIG"]
    vehicle.parameters["SER_TEL2_PROTO"] = (1, INT32)
    printed = live(vehicle, "write", "--yes", file=FOLDER / "px4.params", code=1)
    assert vehicle.parameters["SER_TEL2_BAUD"] == (921600, INT32)
    assert vehicle.parameters["MAV_1_RATE"] == (0, INT32)
    out = printed.out
    assert out.startswith("vehicle 1: PX4 1.15.2 disarmed\n")
    assert "  SER_TEL2_BAUD    57600 -> 921600, needs a reboot\n" in out
    # There it is another parameter with other values: told, but nothing to hold the rest back for.
    assert (
        "MAV_1_CONFIG     missing: this firmware has SER_TEL2_PROTO instead, with different meanings of the values"
        in out
    )


def test_px4_is_known_by_its_heartbeat_where_it_does_not_tell_its_version(live: Live) -> None:
    vehicle = MockVehicle(firmware=PX4)
    vehicle.capabilities = None
    vehicle.parameters = values_of("px4.params", lambda _: INT32)
    live(vehicle, "check", file=FOLDER / "px4.params")


def test_a_file_for_another_autopilot(live: Live) -> None:
    vehicle = ardupilot(SCR_ENABLE=(1, INT8))
    out = live(vehicle, "write", "--yes", file=FOLDER / "px4.params", code=1).out
    assert vehicle.sets == []
    assert "WARNING: the file is for PX4, this is ArduPilot; use ardupilot-4.6.parm" in out


def test_a_type_that_cannot_hold_the_value_is_told_and_not_set(live: Live) -> None:
    vehicle = ardupilot()
    printed = live(vehicle, "write", "--yes", text="SERIAL2_PROTOCOL 1.5\n", code=1)
    assert "SERIAL2_PROTOCOL unfit: 1, not 1.5: its type on the vehicle is 2" in printed.out
    assert vehicle.sets == []


def test_nobody_there_is_one_line(tmp_path: Path, config: tuple[str, int], capsys: Capture) -> None:
    path, port = config
    assert params(tmp_path, "check", FILE, "--live", path) == 1
    assert capsys.readouterr().err == f"udpin:127.0.0.1:{port}: nothing heard\n"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", port))
        assert params(tmp_path, "check", FILE, "--live", path) == 1
    said = capsys.readouterr().err
    assert said.startswith(f"udpin:127.0.0.1:{port}: address already in use by process {os.getpid()} (")
    quiet = tmp_path / "quiet.yaml"
    quiet.write_text("node: {id: 7, role: base}\n")
    assert params(tmp_path, "check", FILE, "--live", str(quiet)) == 2
    assert capsys.readouterr().err == f"{quiet}: autopilot.url: missing, expected the autopilot's address\n"


def test_the_node_that_has_the_port_is_named(tmp_path: Path, config: tuple[str, int], capsys: Capture) -> None:
    path, port = config
    node = RunningNode(
        tmp_path, 7, "node", node={"role": "base"}, autopilot={"url": f"udpin:127.0.0.1:{port}"},
        store={"path": f"{tmp_path}/n.db"},
    ).start()  # fmt: skip
    try:
        assert params(tmp_path, "check", FILE, "--live", path) == 1
    finally:
        node.end()
    said = capsys.readouterr().err
    assert said.startswith(f"udpin:127.0.0.1:{port}: address already in use by process ")
    assert said.endswith(f"); the node of {path} is running and uses the autopilot's port: stop it first\n")


def test_another_autopilot_than_the_configured_one(config: tuple[str, int], live: Live) -> None:
    with Path(config[0]).open("a") as file:
        file.write("mavlink: {autopilot_id: 9}\n")
    printed = live(ardupilot(), "check", code=1)
    assert "no autopilot with system id 9 heard, but 1 (mavlink.autopilot_id)" in printed.err


def test_over_a_serial_port(tmp_path: Path) -> None:
    device = SerialDevice(tmp_path / "ttyUSB0").plug()
    file = tmp_path / "drone.yaml"
    file.write_text(f"node: {{id: 7, role: base}}\nautopilot: {{url: '{device.path},921600'}}\n")
    try:
        with ardupilot().on_pty(device.far) as vehicle:
            assert params(tmp_path, "write", FILE, "--live", str(file), "--yes") == 0
        assert vehicle.parameters["SERIAL2_PROTOCOL"] == (2, INT8)
    finally:
        device.unplug()


@pytest.mark.usefixtures("virtual")
def test_a_serial_port_that_is_not_there(tmp_path: Path, capsys: Capture) -> None:
    file = tmp_path / "drone.yaml"
    file.write_text(f"node: {{id: 7, role: base}}\nautopilot: {{url: '{tmp_path}/ttyUSB0,921600'}}\n")
    assert params(tmp_path, "check", FILE, "--live", str(file)) == 1
    assert capsys.readouterr().err.endswith(f"serial:{tmp_path}/ttyUSB0:921600: no such file or directory\n")

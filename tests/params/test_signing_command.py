"""`rass-mav params signing` against a mock flight controller that takes keys as ArduPilot does, over real UDP."""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from rass_mav.cli import main
from tests.app.app_nodes import command, free_ports
from tests.mavlink import pymav
from tests.mock_vehicle import ARDUPILOT, INT8, PX4, MockVehicle
from tests.virtual import VirtualTime

Capture = pytest.CaptureFixture[str]
OTHER = bytes(range(32))
GIVE = "the key is sent in the clear: do this by wire or USB, not by radio"
ON = (
    "signing is on: its signatures are valid, with timestamps 60 s above the one it received, and it has "
    "answered a signed request"
)


class Place:
    """A drone's folder with its keys, and the port on which it hears its autopilot."""

    def __init__(self, folder: Path) -> None:
        for arguments in (["new", "m"], ["drone", "7", "-d", "m"]):
            assert command(folder, "keys", *arguments).returncode == 0
        shown = command(folder, "keys", "autopilot", "7", "-d", "m", "--json")
        self.passphrase = json.loads(shown.stdout)["passphrase"]
        self.key = pymav.sha256(self.passphrase)
        [self.port] = free_ports(1)
        self.path = folder / "drone.yaml"
        self.folder = folder
        self.virtual = VirtualTime()
        self.write(signing=True)

    def write(self, *, signing: bool = False, keys: bool = True) -> str:
        url = f"url: 'udpin:127.0.0.1:{self.port}'"
        self.path.write_text(
            f"node: {{id: 7}}\nautopilot: {{{url}{', signing: true' if signing else ''}}}\n"
            f"store: {{path: {self.folder}/n.db}}\nlinks: [{{listen: '127.0.0.1:0', broadcast: '127.0.0.1:9'}}]\n"
            + (f"keys: {{file: {self.folder}/m/drone-7.keys}}\n" if keys else "")
        )
        return str(self.path)


@pytest.fixture(scope="module")
def mission(tmp_path_factory: pytest.TempPathFactory) -> Place:
    return Place(tmp_path_factory.mktemp("signing"))


@pytest.fixture
def place(mission: Place, virtual: VirtualTime) -> Place:
    mission.virtual = virtual
    return mission


def signing(place: Place, *options: str) -> int:
    return main(["params", "signing", str(place.path), *options])


def test_on_and_off_again(place: Place, capsys: Capture) -> None:
    path = place.write()
    vehicle = MockVehicle()
    with vehicle.on_udp(place.port, place.virtual):
        assert signing(place, "--yes") == 0
        assert capsys.readouterr().out.splitlines() == [
            "vehicle 1: ArduPilot 4.6.3 disarmed, signing is off", GIVE, ON,
            f"now set autopilot.signing: true in {path}",
        ]  # fmt: skip
        assert vehicle.key == place.key
        place.write(signing=True)
        assert signing(place) == 0
        assert capsys.readouterr().out.splitlines() == [
            "vehicle 1: ArduPilot 4.6.3 disarmed, signing is on, with this drone's key",
            "its signatures are valid, and it has answered a signed request",
        ]
        assert signing(place, "--off", "--yes") == 0
        assert capsys.readouterr().out.splitlines() == [
            "vehicle 1: ArduPilot 4.6.3 disarmed, signing is on, with this drone's key",
            "signing is off: its frames have no signature",
            f"now set autopilot.signing: false in {path}",
        ]
        assert vehicle.key is None
        place.write()
        assert signing(place, "--off") == 0
    assert "signing is off: its frames have no signature\n" in capsys.readouterr().out


def test_no_output_shows_the_key(place: Place, capsys: Capture, caplog: pytest.LogCaptureFixture) -> None:
    vehicle = MockVehicle()
    with vehicle.on_udp(place.port, place.virtual):
        assert main(["params", "signing", place.write(), "--yes", "--json", "-vv"]) == 0
    said = capsys.readouterr()
    assert json.loads(said.out) == {
        "system_id": 1, "before": "none", "after": "ours", "ahead_s": pytest.approx(60, abs=0.1), "refused": None,
    }  # fmt: skip
    everything = said.out + said.err + caplog.text
    assert place.passphrase not in everything
    assert place.key.hex() not in everything
    assert vehicle.key == place.key


@pytest.mark.parametrize("answer", ["", "n\n"])
def test_without_a_yes_nothing_changes(
    answer: str, place: Place, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    place.write()
    monkeypatch.setattr(sys, "stdin", io.StringIO(answer))
    with MockVehicle().on_udp(place.port, place.virtual) as vehicle:
        assert signing(place) == 1
        assert vehicle.key is None
        assert not any(message.get_type() == "SETUP_SIGNING" for message in vehicle.heard)
    said = capsys.readouterr()
    assert said.err == "Give the key of drone 7 to vehicle 1? [y/N] "
    assert said.out.endswith("nothing changed: not confirmed (--yes skips the question)\n")


def armed(vehicle: MockVehicle) -> None:
    vehicle.armed = True


def old_px4(vehicle: MockVehicle) -> None:
    vehicle.firmware, vehicle.version, vehicle.capabilities = PX4, (1, 15, 2), 16


def by_radio(vehicle: MockVehicle) -> None:
    vehicle.radio = True


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (armed, "vehicle 1 is armed"),
        (old_px4, "PX4 1.15.2 has no signing, which came with 1.18"),
        (by_radio, "a telemetry radio is on this port, and others could read the key: connect the autopilot by wire "
                   "or USB"),
    ],
)  # fmt: skip
def test_a_vehicle_that_must_be_left_alone(
    change: Callable[[MockVehicle], None], why: str, place: Place, capsys: Capture
) -> None:
    place.write()
    vehicle = MockVehicle()
    change(vehicle)
    with vehicle.on_udp(place.port, place.virtual):
        assert signing(place, "--yes") == 1
    assert capsys.readouterr().out.endswith(f"nothing changed: {why}\n")
    assert not any(message.get_type() == "SETUP_SIGNING" for message in vehicle.heard)


def test_an_autopilot_that_does_not_take_the_key(place: Place, capsys: Capture) -> None:
    place.write()
    vehicle = MockVehicle()
    vehicle.takes_keys = False
    with vehicle.on_udp(place.port, place.virtual):
        assert signing(place, "--yes") == 1
    assert capsys.readouterr().err == (
        f"udpin:127.0.0.1:{place.port}: it did not accept the key: it may not support signing, or it refused (see its "
        "messages at the ground station)\n"
    )


@pytest.mark.parametrize("option", [[], ["--off"]])
def test_an_autopilot_with_another_key(option: list[str], place: Place, capsys: Capture) -> None:
    place.write()
    vehicle = MockVehicle()
    vehicle.key = OTHER
    with vehicle.on_udp(place.port, place.virtual):
        assert signing(place, "--yes", *option) == 1
    said = capsys.readouterr()
    assert said.out.startswith("vehicle 1: ArduPilot disarmed, signing is on, with another key\n")
    assert said.err.startswith(f"udpin:127.0.0.1:{place.port}: it has another key; connect to its USB port")
    assert vehicle.key == OTHER


def test_an_autopilot_that_signs_and_answers_nothing(place: Place, capsys: Capture) -> None:
    place.write()
    vehicle = MockVehicle()
    vehicle.key = place.key
    vehicle.answers_questions = False
    with vehicle.on_udp(place.port, place.virtual):
        assert signing(place) == 1
    assert "but does not answer signed requests: it remembers at most 16 signed senders" in capsys.readouterr().err


@pytest.mark.parametrize("option", [[], ["--off"]])
@pytest.mark.parametrize("key", [None, OTHER])
@pytest.mark.parametrize(
    ("firmware", "remedy"),
    [(ARDUPILOT, "set SERIALn_PROTOCOL 2 for this port (SERIAL2 is TELEM2)"), (PX4, "set MAV_PROTO_VER 2")],
)
def test_a_port_that_shows_no_signatures(
    firmware: int, remedy: str, key: bytes | None, option: list[str], place: Place, capsys: Capture
) -> None:
    """MAVLink 1 has no signatures, so nobody can see whether the autopilot has a key, or has taken one."""
    place.write()
    vehicle = MockVehicle(firmware=firmware, version=(1, 18, 0) if firmware == PX4 else (4, 6, 3))
    vehicle.mavlink_1 = True
    vehicle.key = key
    with vehicle.on_udp(place.port, place.virtual):
        assert signing(place, "--yes", "--json", *option) == 1
    said = capsys.readouterr()
    assert json.loads(said.out) == {
        "system_id": 1, "before": "hidden", "after": "hidden", "ahead_s": None, "refused":
            f"this port sends MAVLink 1, which has no signatures: {remedy}, and reboot the autopilot",
    }  # fmt: skip
    assert "disarmed, signing is not visible" in said.err
    assert vehicle.key == key
    assert not any(message.get_type() == "SETUP_SIGNING" for message in vehicle.heard)


def test_without_keys_there_is_nothing_to_give(place: Place, capsys: Capture) -> None:
    path = place.write(keys=False)
    assert signing(place, "--yes") == 2
    assert (
        capsys.readouterr().err
        == f"{path}: keys: missing, expected the drone's key file (documentation: how-to/keys)\n"
    )


def test_a_base_has_no_key_for_an_autopilot(place: Place, capsys: Capture) -> None:
    path = place.write()
    text = place.path.read_text().replace("id: 7", "id: 1, role: base").replace("drone-7.keys", "ground.keys")
    place.path.write_text(text)
    assert signing(place, "--yes") == 2
    assert capsys.readouterr().err == f"{path}: node.role: expected drone; a base has no key for an autopilot\n"


def write_parameter(place: Place, *, signing: bool) -> int:
    file = place.folder / "x.parm"
    file.write_text("X 2\n")
    return main(["params", "write", str(file), "--live", place.write(signing=signing), "--yes"])


def test_parameters_are_written_with_signatures(place: Place, capsys: Capture) -> None:
    vehicle = MockVehicle()
    vehicle.parameters = {"X": (1, INT8)}
    vehicle.key = place.key
    vehicle.reboot(37_000_000_000_000)
    with vehicle.on_udp(place.port, place.virtual):
        assert write_parameter(place, signing=False) == 1
        assert "does not answer parameter requests" in capsys.readouterr().err
        assert write_parameter(place, signing=True) == 0
        assert vehicle.parameters["X"] == (2, INT8)


@pytest.mark.parametrize(
    ("key", "mavlink_1", "how"),
    [
        (None, False, "not signed"), (OTHER, False, "signed with another key"),
        (None, True, "MAVLink 1, which has no signatures"),
    ],
)  # fmt: skip
def test_what_is_not_signed_rightly_is_not_heard(
    key: bytes | None, mavlink_1: bool, how: str, place: Place, capsys: Capture
) -> None:
    vehicle = MockVehicle()
    vehicle.key, vehicle.mavlink_1 = key, mavlink_1
    with vehicle.on_udp(place.port, place.virtual):
        assert write_parameter(place, signing=True) == 1
    remedy = "set SERIALn_PROTOCOL 2 for this port" if mavlink_1 else "rass-mav params signing"
    assert capsys.readouterr().err == (
        f"udpin:127.0.0.1:{place.port}: the autopilot's frames are {how}, and autopilot.signing is true ({remedy})\n"
    )

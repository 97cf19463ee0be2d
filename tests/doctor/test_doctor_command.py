"""`rass-mav doctor` on real nodes, ports and a mock flight controller: with the node running, and without it."""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import threading
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import serial

from rass_mav.cli import main
from rass_mav.doctor import node, service, watch
from rass_mav.mavlink.frames import FrameWriter
from tests.app.app_nodes import RunningNode, Tidy, command, free_ports
from tests.mavlink import pymav
from tests.mock_vehicle import INT8, INT16, REAL32, MockVehicle
from tests.ptys import SerialDevice
from tests.virtual import VirtualTime
from tests.wire.version_1 import VERSION_1

Capture = pytest.CaptureFixture[str]


def examined(path: Path, capsys: Capture, code: int) -> dict[str, dict[str, Any]]:
    """The checks by name; the command ends with this exit code."""
    assert main(["doctor", str(path), "--json"]) == code
    said = capsys.readouterr()
    assert said.err == ""
    report = json.loads(said.out)
    levels = [check["level"] for check in report["checks"]]
    assert [report[key] for key in ("passed", "warned", "failed", "skipped")] == [
        levels.count(level) for level in ("pass", "warn", "fail", "skip")
    ]
    assert code == (1 if "fail" in levels else 0), [c for c in report["checks"] if c["level"] == "fail"]
    assert all((check["remedy"] is None) == (check["level"] in ("pass", "skip")) for check in report["checks"])
    names = [check["name"] for check in report["checks"]]
    assert len(names) == len(set(names))
    return {check["name"]: check for check in report["checks"]} | {"report": report}


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """For what shows without waiting: the command does not wait in vain for what never comes."""
    monkeypatch.setattr(watch, "MOST_S", 0.5)


def levels(found: dict[str, dict[str, Any]], *names: str) -> list[str]:
    return [found[name]["level"] for name in names]


def drone(directory: Path, vehicle: int, listen: int, peer: int, **sections: Any) -> RunningNode:
    return RunningNode(
        directory, 7,
        autopilot={"url": f"udpin:127.0.0.1:{vehicle}", **sections.pop("autopilot", {})},
        links=[{"listen": f"127.0.0.1:{listen}", "peers": [{"address": f"127.0.0.1:{peer}"}]}],
        risk={"low": 0, "high": 100},
        **sections,
    )  # fmt: skip


def base(directory: Path, listen: int, peer: int, node_id: int = 1, name: str | None = None) -> RunningNode:
    links = [{"listen": f"127.0.0.1:{listen}", "peers": [{"address": f"127.0.0.1:{peer}"}]}]
    return RunningNode(directory, node_id, name, node={"role": "base"}, links=links)


def lonely_base(directory: Path, vehicle: int) -> RunningNode:
    return RunningNode(directory, 7, node={"role": "base"}, autopilot={"url": f"udpin:127.0.0.1:{vehicle}"}, links=[])


@pytest.mark.parametrize("running", [False, True], ids=["trial", "running"])
def test_a_node_with_all_it_needs(running: bool, tmp_path: Path, tidy: Tidy, capsys: Capture, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    vehicle_port, listen, peer = free_ports(3)
    node = drone(tmp_path, vehicle_port, listen, peer)
    other = tidy(base(tmp_path, peer, listen)).start()
    vehicle = MockVehicle(42)
    vehicle.reading = 25.0
    vehicle.parameters = {"SERIAL2_PROTOCOL": (2, INT8), "SERIAL2_OPTIONS": (0, INT16)}
    with vehicle.on_udp(vehicle_port):
        if running:
            tidy(node).start()
            node.until(lambda: node.status()["neighbours"] != [])
        before = node.status()["skipped_steps"] if running else 0
        found = examined(Path(node.config), capsys, 0)
        skips = running and node.status()["skipped_steps"] > before
    assert found["report"]["running"] is running
    assert found["report"]["node_id"] == 7
    needed = ("python", "packages", "configuration", "store", "node", "autopilot", "position", "sensor", "links[0]",
              "links[0] address", "links[0] hops", "neighbours", "versions", "loops", "node id",
              "system ids", "parameters")  # fmt: skip
    unmet = {name: found[name] for name in needed if found[name]["level"] != "pass"}
    if skips:
        # This computer is busy, and the doctor is right to say so.
        unmet = {name: finding for name, finding in unmet.items() if "it skips steps" not in finding["text"]}
    assert unmet == {}
    assert "system 42, disarmed" in found["autopilot"]["text"]
    assert "ArduPilot 4.6.3" in found["autopilot"]["text"]
    assert "ardupilot-4.6.parm --live" in found["parameters"]["text"]
    # The mock flight controller speaks five times a second.
    for name in ("position", "sensor"):
        per_second = float(found[name]["text"].rsplit(" ", 1)[1].removesuffix("/s"))
        assert 2.0 < per_second < 8.0
    assert found["neighbours"]["text"] == "1 (base)"
    if running:
        assert "process" in found["node"]["text"]
        node.signal(signal.SIGTERM)
    else:
        assert found["forwarding"]["level"] == "pass"
        # The neighbour has heard nothing of it, and nothing was stored.
        assert other.status()["neighbours"] == []
        assert not (tmp_path / "n7.db").exists()
    other.signal(signal.SIGTERM)


@pytest.mark.usefixtures("impatient", "virtual")
@pytest.mark.parametrize("running", [False, True], ids=["trial", "running"])
def test_a_node_with_nothing(running: bool, tmp_path: Path, tidy: Tidy, capsys: Capture, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    vehicle_port, listen, peer = free_ports(3)
    node = drone(tmp_path, vehicle_port, listen, peer)
    if running:
        tidy(node).start()
    found = examined(Path(node.config), capsys, 1)
    # One fault, one remedy: the autopilot is not there.
    assert levels(found, "autopilot", "sensor", "position", "neighbours") == ["fail", "skip", "skip", "warn"]
    assert found["position"]["text"] == found["sensor"]["text"] == "not checked: no autopilot"
    assert found["autopilot"]["text"] == f"nothing heard on udpin:127.0.0.1:{vehicle_port}"
    assert "parameters" not in found
    assert "forwarding" not in found


@pytest.mark.usefixtures("virtual")
def test_for_people_each_check_is_a_line(tmp_path: Path) -> None:
    RunningNode(tmp_path, 1, node={"role": "base"}, links=[])
    said = command(tmp_path, "doctor", "n1.yaml")
    assert (said.returncode, said.stderr) == (0, b"")
    *lines, last = said.stdout.decode().splitlines()
    assert all(line.split("  ")[0] in ("pass", "warn") and ": " in line for line in lines)
    count = {level: sum(line.startswith(level) for line in lines) for level in ("pass", "warn")}
    assert last == f"{count['pass']} passed, {count['warn']} warned, 0 failed"


def test_pages_are_named_by_their_place_in_the_documentation(tmp_path: Path, capsys: Capture) -> None:
    """A wheel has no folder docs/. The last line says where the pages are."""
    (tmp_path / "n1.yaml").write_text("node: {}\n", encoding="utf-8")
    assert main(["doctor", str(tmp_path / "n1.yaml")]) == 1
    said = capsys.readouterr().out
    assert "(documentation: reference/configuration)\n" in said
    assert said.endswith("\ndocumentation: the pages in docs/ of the source of rass-mav\n")
    assert main(["doctor", str(tmp_path / "n2.yaml")]) == 1
    said = capsys.readouterr().out
    assert "n2.yaml: no such file or directory; check the path and the current folder\n" in said


@pytest.mark.parametrize(
    "yaml", [None, "node: {id: 7}\npolicy: {alpha: ten}\n", "links: [\n"], ids=["none", "wrong", "no yaml"]
)
def test_a_wrong_configuration_is_a_finding(yaml: str | None, tmp_path: Path, capsys: Capture) -> None:
    path = tmp_path / "n7.yaml"
    if yaml is not None:
        path.write_text(yaml)
    found = examined(path, capsys, 1)
    assert levels(found, "configuration", "python", "packages") == ["fail", "pass", "pass"]
    assert str(path) in found["configuration"]["text"]
    assert found["report"]["node_id"] is None


def test_no_fix_yet(tmp_path: Path, virtual: VirtualTime, capsys: Capture, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    vehicle_port, listen, peer = free_ports(3)
    node = drone(tmp_path, vehicle_port, listen, peer)
    vehicle = MockVehicle()
    vehicle.position, vehicle.reading = None, 1.0
    with vehicle.on_udp(vehicle_port, virtual):
        found = examined(Path(node.config), capsys, 0)
    assert (found["position"]["level"], found["position"]["text"]) == ("warn", "no fix yet")


def test_another_autopilot_and_several(tmp_path: Path, virtual: VirtualTime, capsys: Capture, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    vehicle_port, listen, peer = free_ports(3)
    meant = drone(tmp_path, vehicle_port, listen, peer, mavlink={"autopilot_id": 9})
    with MockVehicle(3).on_udp(vehicle_port, virtual):
        found = examined(Path(meant.config), capsys, 1)
    assert found["autopilot"]["text"] == f"no system 9 on udpin:127.0.0.1:{vehicle_port}, but 3"
    first = drone(tmp_path, vehicle_port, listen, peer)
    with MockVehicle(3).on_udp(vehicle_port, virtual), MockVehicle(4).on_udp(vehicle_port, virtual):
        found = examined(Path(first.config), capsys, 1)
    assert found["autopilot"]["level"] == "warn"
    assert "its port also carries systems" in found["autopilot"]["text"]


def test_an_autopilot_behind_which_nobody_is_heard(
    tmp_path: Path, virtual: VirtualTime, capsys: Capture, monkeypatch: Any
) -> None:
    """Its parameters are read and tell why; and it is one fault."""
    monkeypatch.chdir(tmp_path)
    (vehicle_port,) = free_ports(1)
    node = RunningNode(
        tmp_path, 7, node={"role": "drone"},
        autopilot={"url": f"udpin:127.0.0.1:{vehicle_port}"}, links=[{"type": "autopilot"}],
        mavlink={"autopilot_id": 1},
    )  # fmt: skip
    vehicle = MockVehicle()
    vehicle.parameters = {
        "SYSID_THISMAV": (1, INT16), "SERIAL2_PROTOCOL": (2, INT8), "SERIAL2_OPTIONS": (1024, INT16),
        "SCR_ENABLE": (1, INT8), "RADS_SOURCE": (1, REAL32),
    }  # fmt: skip
    with vehicle.on_udp(vehicle_port, virtual):
        found = examined(Path(node.config), capsys, 1)
    assert levels(found, "autopilot", "forwarding", "sensor", "neighbours") == ["pass", "fail", "fail", "skip"]
    assert "set SERIAL2_OPTIONS 0, and reboot" in found["forwarding"]["remedy"]
    assert "RADS_SOURCE is 1" in found["sensor"]["text"]
    # Nothing is heard of TUNNEL: the trial is mute, and asks the autopilot only.
    assert {message.get_type() for message in vehicle.heard} == {"HEARTBEAT", "COMMAND_LONG", "PARAM_REQUEST_READ"}


@pytest.mark.parametrize("protocol", [-1, 5, 28])
def test_an_autopilot_whose_radio_has_no_mavlink_port(
    protocol: int, tmp_path: Path, virtual: VirtualTime, capsys: Capture, monkeypatch: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    (vehicle_port,) = free_ports(1)
    node = RunningNode(
        tmp_path, 7, node={"role": "drone"},
        autopilot={"url": f"udpin:127.0.0.1:{vehicle_port}"}, links=[{"type": "autopilot"}],
        mavlink={"autopilot_id": 1},
    )  # fmt: skip
    vehicle = MockVehicle()
    vehicle.reading = 1.0
    vehicle.parameters = {
        "SERIAL1_PROTOCOL": (protocol, INT8), "SERIAL2_PROTOCOL": (2, INT8), "SERIAL3_PROTOCOL": (5, INT8),
        "SERIAL5_PROTOCOL": (-1, INT8),
    }  # fmt: skip
    with vehicle.on_udp(vehicle_port, virtual):
        found = examined(Path(node.config), capsys, 0)
    assert levels(found, "autopilot", "forwarding", "neighbours") == ["pass", "warn", "warn"]
    assert f"nothing is forwarded to SERIAL1 (SERIAL1_PROTOCOL {protocol})" in found["forwarding"]["text"]
    assert "set SERIAL1_PROTOCOL 2, and reboot" in found["forwarding"]["remedy"]


@pytest.mark.parametrize("key", [None, bytes(range(32))], ids=["open", "key"])
@pytest.mark.parametrize("running", [False, True], ids=["trial", "running"])
def test_an_autopilot_that_sends_mavlink_1(
    running: bool,
    key: bytes | None,
    tmp_path: Path,
    tidy: Tidy,
    virtual: VirtualTime,
    capsys: Capture,
    monkeypatch: Any,
) -> None:
    """Its frames show no signature, even if it answers only what is signed."""
    monkeypatch.chdir(tmp_path)
    vehicle_port, listen, peer = free_ports(3)
    # The doctor waits in real time for what a running drone lacks; a base lacks nothing.
    node = lonely_base(tmp_path, vehicle_port) if running else drone(tmp_path, vehicle_port, listen, peer)
    vehicle = MockVehicle()
    vehicle.mavlink_1, vehicle.key = True, key
    with vehicle.on_udp(vehicle_port, None if running else virtual):
        if running:
            tidy(node).start()
            node.until(lambda: (node.status()["autopilot"] or {}).get("version") is not None or key is not None)
            node.until(lambda: node.status()["autopilot"] is not None)
        found = examined(Path(node.config), capsys, 0 if running and key is None else 1)
    assert found["autopilot"]["level"] == ("warn" if key is None else "fail")
    assert "MAVLink 1" in found["autopilot"]["text"]
    assert ("does not answer" in found["autopilot"]["text"]) is (key is not None)
    assert "set SERIALn_PROTOCOL 2 for this port" in found["autopilot"]["remedy"]
    # One fault, one remedy.
    sensor = "pass" if running else "fail" if key is None else "skip"
    assert levels(found, "position", "sensor") == ["pass", sensor]


@pytest.mark.parametrize("running", [False, True], ids=["trial", "running"])
def test_an_autopilot_that_wants_signatures(
    running: bool, tmp_path: Path, tidy: Tidy, virtual: VirtualTime, capsys: Capture, monkeypatch: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    vehicle_port, listen, peer = free_ports(3)
    # The doctor waits in real time for what a running drone lacks; a base lacks nothing.
    node = lonely_base(tmp_path, vehicle_port) if running else drone(tmp_path, vehicle_port, listen, peer)
    vehicle = MockVehicle()
    vehicle.key = bytes(range(32))
    with vehicle.on_udp(vehicle_port, None if running else virtual):
        if running:
            tidy(node).start()
            node.until(lambda: node.status()["autopilot"] is not None)
        found = examined(Path(node.config), capsys, 1)
    assert levels(found, "autopilot", "sensor") == ["fail", "pass" if running else "skip"]
    assert "MAVLink signing is on" in found["autopilot"]["text"]
    # Positions come all the same, as often as the autopilot likes.
    assert found["position"]["level"] == "pass"


@pytest.mark.parametrize("right", [True, False])
def test_an_autopilot_with_signing_and_a_node_that_signs(
    right: bool, tmp_path: Path, virtual: VirtualTime, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for arguments in (["new", "m"], ["drone", "7", "-d", "m"]):
        assert command(tmp_path, "keys", *arguments).returncode == 0
    shown = command(tmp_path, "keys", "autopilot", "7", "-d", "m").stdout.decode()
    vehicle_port, listen, peer = free_ports(3)
    node = drone(
        tmp_path, vehicle_port, listen, peer, autopilot={"signing": True}, keys={"file": "m/drone-7.keys"}
    )  # fmt: skip
    vehicle = MockVehicle()
    vehicle.reading = 1.0
    vehicle.key = pymav.sha256(shown.split("\n")[0]) if right else bytes(32)
    vehicle.reboot(37_000_000_000_000)
    with vehicle.on_udp(vehicle_port, virtual):
        found = examined(Path(node.config), capsys, 0 if right else 1)
    if right:
        assert found["autopilot"]["text"].endswith("heartbeats/s, signed")
        assert levels(found, "autopilot", "position") == ["pass", "pass"]
    else:
        assert levels(found, "autopilot", "position") == ["fail", "skip"]
        assert "heard, but its signatures are wrong" in found["autopilot"]["text"]


@pytest.mark.usefixtures("virtual")
def test_a_port_that_another_program_has(tmp_path: Path, capsys: Capture, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    vehicle_port, listen, peer = free_ports(3)
    node = drone(tmp_path, vehicle_port, listen, peer)
    with ExitStack() as stack:
        for port in (vehicle_port, listen):
            sock = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            sock.bind(("127.0.0.1", port))
        found = examined(Path(node.config), capsys, 1)
    for name in ("autopilot", "links[0]"):
        assert found[name]["level"] == "fail"
        assert f"address already in use by process {os.getpid()} (" in found[name]["text"]
    assert found["links[0]"]["remedy"].endswith(f"ss -lunp 'sport = :{listen}'")
    assert found["autopilot"]["remedy"].endswith(f"ss -lunp 'sport = :{vehicle_port}'")
    assert "position" not in found


def test_serial_ports(tmp_path: Path, capsys: Capture, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    device, counter = SerialDevice(tmp_path / "ttyAMA0"), SerialDevice(tmp_path / "ttyUSB0")
    node = RunningNode(
        tmp_path, 7, node={"role": "drone"},
        autopilot={"url": f"{device.path},57600"},
        sensor={"type": "mightyohm", "port": str(counter.path)},
        links=[{"type": "autopilot"}],
        mavlink={"autopilot_id": 1},
    )  # fmt: skip
    with monkeypatch.context() as impatient:
        impatient.setattr(watch, "MOST_S", 0.5)
        found = examined(Path(node.config), capsys, 1)
    assert levels(found, f"serial port {device.path}", f"serial port {counter.path}") == 2 * ["fail"]
    # What needs them has no remedy of its own.
    assert levels(found, "autopilot", "position", "sensor", "links[0]", "neighbours") == 5 * ["skip"]
    device.plug()
    counter.plug()
    try:
        with MockVehicle().on_pty(device.far), Talking(counter.far, b"CPS, 1, CPM, 60, uSv/hr, 0.35, SLOW\r\n"):
            found = examined(Path(node.config), capsys, 0)
        assert levels(found, f"serial port {device.path}", f"serial port {counter.path}", "autopilot", "sensor",
                      "links[0]") == 5 * ["pass"]  # fmt: skip
        # Who is heard through an autopilot may be far away.
        assert (found["links[0] hops"]["level"], "links[0].only" in found["links[0] hops"]["remedy"]) == ("warn", True)
        # Bytes that are not understood arrive, but not what it waits for.
        monkeypatch.setattr(watch, "MOST_S", watch.LEAST_S)
        with Talking(device.far, bytes(range(1, 200))), Talking(counter.far, b"\xff\xfe\r\n"):
            found = examined(Path(node.config), capsys, 1)
        assert "is not MAVLink" in found["autopilot"]["text"]
        assert found["sensor"]["level"] == "fail"
    finally:
        device.unplug()
        counter.unplug()


@pytest.mark.usefixtures("virtual")
def test_a_serial_port_that_another_program_has(tmp_path: Path, capsys: Capture, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    device = SerialDevice(tmp_path / "ttyAMA0").plug()
    node = RunningNode(
        tmp_path, 7, node={"role": "base"}, autopilot={"url": f"serial:{device.path}:57600"}, links=[]
    )  # fmt: skip
    try:
        with serial.Serial(str(device.path), 57600, exclusive=True):
            found = examined(Path(node.config), capsys, 1)
    finally:
        device.unplug()
    assert found["autopilot"]["text"].endswith(": another program is using the port")


class Talking:
    """Says the same thing again and again at the far end of a pseudo-terminal."""

    def __init__(self, descriptor: int, data: bytes) -> None:
        self._stop = threading.Event()

        def talk() -> None:
            while not self._stop.wait(0.2):
                try:
                    os.write(descriptor, data)
                except OSError:
                    continue  # nobody reads

        self._thread = threading.Thread(target=talk)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()


@pytest.mark.usefixtures("virtual")
def test_only_on_a_link_that_forwards(tmp_path: Path, capsys: Capture, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    listen, peer = free_ports(2)
    link = {"listen": f"127.0.0.1:{listen}", "peers": [{"address": f"127.0.0.1:{peer}"}], "one_hop": False}
    node = RunningNode(tmp_path, 7, node={"role": "base"}, links=[link])
    assert examined(Path(node.config), capsys, 0)["links[0] hops"]["level"] == "warn"
    node = RunningNode(tmp_path, 7, node={"role": "base"}, links=[{**link, "only": [3, 4]}])
    assert "only nodes 3, 4" in examined(Path(node.config), capsys, 0)["links[0] hops"]["text"]


def test_the_same_node_id_twice(tmp_path: Path, tidy: Tidy, capsys: Capture, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    mine, theirs = free_ports(2)
    tidy(base(tmp_path, theirs, mine, 5, "rival")).start()
    node = base(tmp_path, mine, theirs, 5)
    found = examined(Path(node.config), capsys, 1)
    assert found["node id"]["level"] == "fail"
    tidy(node).start()
    node.until(lambda: node.status()["rivals"] != [])
    monkeypatch.setattr(watch, "MOST_S", 0.5)
    assert examined(Path(node.config), capsys, 1)["node id"]["level"] == "fail"


def test_two_nodes_under_one_system_id(tmp_path: Path, tidy: Tidy, capsys: Capture, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    vehicle_port, mine, theirs = free_ports(3)
    # A base without an autopilot takes its system id from its node id.
    tidy(base(tmp_path, theirs, mine, 42)).start()
    node = drone(tmp_path, vehicle_port, mine, theirs)
    vehicle = MockVehicle(42)
    vehicle.reading = 25.0
    with vehicle.on_udp(vehicle_port):
        found = examined(Path(node.config), capsys, 0)
        assert found["system ids"]["level"] == "warn"
        assert found["system ids"]["text"].startswith("nodes 7, 42 all use system id 42")
        tidy(node).start()
        node.until(lambda: node.status()["shared_system_ids"] != [])
        status = node.status()
    assert status["shared_system_ids"] == [{"system_id": 42, "node_ids": [7, 42]}]
    assert (status["system_id"], status["neighbours"][0]["system_id"]) == (42, 42)


@pytest.mark.usefixtures("impatient")
def test_a_neighbour_of_another_version(tmp_path: Path, tidy: Tidy, capsys: Capture, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    mine, theirs = free_ports(2)
    node = tidy(base(tmp_path, mine, theirs)).start()
    old = FrameWriter(3, 191).tunnel(VERSION_1["beacon-drone"], payload_type=33200)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as neighbour:
        neighbour.sendto(old, ("127.0.0.1", mine))
    node.until(lambda: node.status()["other_versions"] != [])
    [other] = node.status()["other_versions"]
    assert (other["node_id"], other["version"], other["age_s"] >= 0) == (3, 1, True)
    found = examined(Path(node.config), capsys, 0)["versions"]
    assert (found["level"], "update rass-mav on node 3" in found["remedy"]) == ("warn", True)


def test_a_loop_that_brings_everything_back(tmp_path: Path, tidy: Tidy, capsys: Capture, monkeypatch: Any) -> None:
    """A forwarder at the neighbour's address sends back what it hears."""
    monkeypatch.chdir(tmp_path)
    (mine,) = free_ports(1)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as forwarder:
        forwarder.bind(("127.0.0.1", 0))
        node = tidy(base(tmp_path, mine, forwarder.getsockname()[1])).start()
        stop, stopped = socket.socketpair()

        def forward() -> None:
            while stopped not in select.select([forwarder, stopped], [], [])[0]:
                forwarder.sendto(forwarder.recv(2048), ("127.0.0.1", mine))

        thread = threading.Thread(target=forward)
        thread.start()
        try:
            found = examined(Path(node.config), capsys, 1)
        finally:
            stop.send(b"x")
            thread.join()
            stop.close()
            stopped.close()
    assert (found["loops"]["level"], "came back" in found["loops"]["text"]) == ("fail", True)


def test_a_node_that_does_not_answer_and_one_that_was_killed(
    tmp_path: Path, tidy: Tidy, capsys: Capture, monkeypatch: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    node = tidy(RunningNode(tmp_path, 1, node={"role": "base"}, links=[])).start()
    assert node.process is not None
    node.process.send_signal(signal.SIGSTOP)
    found = examined(Path(node.config), capsys, 1)
    assert (found["node"]["level"], "does not answer" in found["node"]["text"]) == ("fail", True)
    # Its ports are not free, so they are not tried.
    assert "autopilot" not in found
    node.process.send_signal(signal.SIGCONT)
    node.signal(signal.SIGKILL)
    found = examined(Path(node.config), capsys, 0)
    assert "was killed" in found["node"]["text"]


def test_a_running_node_of_another_configuration(tmp_path: Path, tidy: Tidy, capsys: Capture, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    node = tidy(RunningNode(tmp_path, 1, node={"role": "base"}, links=[])).start()
    RunningNode(tmp_path, 2, "n1", node={"role": "base"}, links=[])
    found = examined(Path(node.config), capsys, 1)
    assert "running: node 1 (base)" in found["node"]["text"]
    assert found["node"]["level"] == "fail"


def test_all_waits_together_take_ten_seconds_at_most() -> None:
    assert watch.MOST_S + node.ANSWER_S + service.ANSWER_S <= 10.0


def test_rates() -> None:
    def sample(uptime: float, at: float | None) -> dict[str, Any]:
        return {"uptime_s": uptime, "reading": None if at is None else {"age_s": round(uptime - at, 3)}}

    looks = [sample(0.0, None), sample(0.1, 0.05), sample(0.2, 0.05), sample(1.1, 1.05), sample(2.1, 2.05)]
    assert watch.readings(looks) == pytest.approx([0.05, 1.05, 2.05])
    assert watch.rate(watch.readings(looks)) == pytest.approx(1.0)
    # What came long before we looked tells nothing about now.
    assert watch.readings([sample(100.0, 50.0), sample(101.0, 50.0)]) == []
    assert watch.rate([1.0]) is None

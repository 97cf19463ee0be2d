"""`rass-mav try`: real nodes on this machine, a mock vehicle, and data that one sees arrive."""

from __future__ import annotations

import re
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import psutil
import pytest

from rass_mav.app.config import load_config
from rass_mav.cli import main
from rass_mav.core.datum import DatumId, Kind
from rass_mav.core.seals import SEALED
from rass_mav.ground.assembly import Groups
from rass_mav.ground.entry import Entry
from rass_mav.lab.commands.demo import Files, arrival_line, opening_lines
from rass_mav.lab.fleet.children import Children
from rass_mav.lab.fleet.demo import (
    MAX_DRONES,
    PHOTO,
    RADIUS_M,
    ROUND_S,
    SOURCE,
    STEP_S,
    Demo,
    MockVehicles,
    Options,
    demo,
)  # fmt: skip
from rass_mav.lab.swarm.autopilot import METRES_PER_DEGREE
from rass_mav.mavlink.frames import FrameReader
from rass_mav.mavlink.telemetry import Telemetry
from rass_mav.store.reader import SqliteReader
from rass_mav.wire.file import PLAIN, Manifest, PartHead, cut_file
from rass_mav.wire.measurement import Measurement
from tests.commands import json_output
from tests.some import some

DEADLINE_S = 60.0
#: What a drone's installation need not have.
WITHOUT = """
import sys
sys.modules["msgspec"] = sys.modules["mavsdk"] = sys.modules["tqdm"] = None
from rass_mav.cli import main
sys.exit(main(sys.argv[1:]))
"""


class Trial:
    """A `rass-mav try` that runs, and its lines."""

    def __init__(self, *options: str) -> None:
        self.process = subprocess.Popen([sys.executable, "-c", WITHOUT, "try", *options], stdout=subprocess.PIPE)
        self.lines: list[str] = []

    def until(self, wanted: Callable[[str], bool]) -> None:
        """Until such a line."""
        assert self.process.stdout is not None
        while not (self.lines and wanted(self.lines[-1])):
            ready, _, _ = select.select([self.process.stdout], [], [], DEADLINE_S)
            assert ready, self.lines
            line = self.process.stdout.readline()
            assert line, self.lines
            self.lines.append(line.decode().rstrip("\n"))


def test_data_arrive_and_one_can_take_part_until_it_is_interrupted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # However long the directory's name: the sockets, whose names have a limit, are elsewhere.
    keep = tmp_path / ("kept " * 30)
    trial = Trial("--keep", str(keep))
    try:
        trial.until(lambda line: " at 45.0" in line and " risk " in line)
        assert any(str(keep) in line for line in trial.lines)
        drone, base = str(keep / "drone-2.yaml"), str(keep / "base.yaml")
        assert main(["put", "-c", drone, "--line", "hello"]) == 0
        trial.until(lambda line: line.endswith("node 2 hello"))
        capsys.readouterr()
        pids = []
        for config in (drone, base):
            pids.append(json_output(capsys, "status", config)["pid"])
        nodes = [psutil.Process(pid) for pid in pids]
        trial.process.send_signal(signal.SIGINT)
        trial.until(lambda line: " data created, " in line)
        assert trial.process.wait(DEADLINE_S) == 0
        assert not any(node.is_running() for node in nodes)
    finally:
        trial.process.kill()
        trial.process.communicate()
    with SqliteReader(keep / "base.db") as store:
        arrived = len(store.ids())
    assert arrived >= 2
    found = re.search(
        r"(\d+) data created, (\d+) arrived at the base, (\d+) still on the drones, 0 lost", trial.lines[-1]
    )
    created, delivered, held = map(int, some(found).groups())
    assert (delivered, created) == (arrived, delivered + held)


def test_as_json_it_says_one_object_and_keeps_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    summary = json_output(capsys, "try", "--for", "0.01")
    assert (summary["drones"], summary["directory"], summary["altered"]) == (1, None, 0)
    assert summary["created"] == summary["delivered"] + summary["held"]
    assert not any(summary["lost"].values())


@pytest.mark.parametrize(
    ("options", "error"),
    [
        (["--drones", "0"], f"--drones: expected 1 to {MAX_DRONES}, got 0"),
        (["--drones", "17"], f"--drones: expected 1 to {MAX_DRONES}, got 17"),
        (["--for", "-1"], "--for: expected seconds above 0, got -1"),
        (["--page", "8080"], "--page: expected host:port (IPv4 address, [IPv6 address] or name), got '8080'"),
        (["--for", "nan"], "--for: expected seconds above 0, got nan"),
        (["--keep", "{}"], "{}: expected a new or empty directory"),
    ],
)
def test_what_it_cannot_do_it_says_in_one_line(
    options: list[str], error: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine").touch()
    assert main(["try", *(option.format(tmp_path) for option in options)]) == 2
    assert capsys.readouterr().err == error.format(tmp_path) + "\n"


def test_it_does_not_start_where_another_program_serves_the_page(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        page = f"127.0.0.1:{other.getsockname()[1]}"
        assert main(["try", "--page", page]) == 1
    assert capsys.readouterr().err.startswith(f"--page: {page}: address already in use")


def test_the_configurations_are_like_those_of_real_nodes(tmp_path: Path) -> None:
    with closing(MockVehicles(range(2, 5))) as vehicles:
        nodes = Demo(Options(3), tmp_path, tmp_path, Children(), vehicles, lambda entry, content: None)
        nodes.configure()
        lines = list(opening_lines(nodes, kept=False))
    configs = [load_config(node.config) for node in nodes.nodes]
    assert [(config.node_id, config.node.role, config.node.step_s) for config in configs] == [
        (1, "base", STEP_S), (2, "drone", STEP_S), (3, "drone", STEP_S), (4, "drone", STEP_S),
    ]  # fmt: skip
    listening = {config.links[0].listen for config in configs}
    assert len(listening) == 4
    for config in configs:
        [link] = config.links
        assert {link.listen} | {peer.address for peer in link.peers} == listening
        assert (config.autopilot.url is None) is config.is_base
    assert "nodes 2 to 4 are drones" in lines[0]
    assert f"{tmp_path} (--keep DIR keeps them)" in lines[1]


def test_a_rehearsal_has_keys_a_photo_and_a_drone_that_dies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("nacl", reason="PyNaCl is not installed (extra keys)")
    monkeypatch.setattr("rass_mav.lab.fleet.demo.PHOTO_S", 0.0)
    monkeypatch.setattr("rass_mav.lab.fleet.demo.DEATH_S", 0.1)
    seen: dict[str, Entry] = {}
    said: list[str] = []

    def arrived(entry: Entry, payload: bytes) -> None:
        seen[entry.file or entry.kind_name] = entry

    with demo(Options(3, tmp_path / "kept", keys=True), arrived, said.append) as nodes:
        until = time.monotonic() + DEADLINE_S
        while not {PHOTO, "measurement"} <= seen.keys():
            assert time.monotonic() < until, seen
            nodes.run(time.monotonic() + 0.2)
        assert [node.node_id for node in nodes.drones] == [2, 3]
        nodes.stop()
        assert nodes.summary()["drones"] == 3
    assert seen[PHOTO].id.origin == 2
    assert said[0].startswith("node 2 takes a photograph, ")
    assert said[1].startswith("node 4 dies: ")
    # Sealed: only the ground's keys have opened it.
    with SqliteReader(tmp_path / "kept/base.db") as store:
        assert all(info.kind & SEALED for info in store.held())


def test_the_vehicle_flies_past_the_source(tmp_path: Path) -> None:
    with (
        closing(MockVehicles(range(2, 3))) as vehicle, Children() as children,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as node,
    ):  # fmt: skip
        vehicle.start(tmp_path, children)
        node.settimeout(DEADLINE_S)
        url = some(vehicle.url(2))
        node.connect(("127.0.0.1", int(url.rpartition(":")[2])))
        node.send(b"it learns where its node is")
        children.wait(time.monotonic() + DEADLINE_S)
        telemetry, reader = Telemetry(2), FrameReader()
        readings, places = [], set()
        for second in range(int(ROUND_S)):
            vehicle.fly(float(second))
            before = telemetry.reading
            while telemetry.reading is before:  # the last that it says
                for frame in reader.datagram(node.recv(300)):
                    telemetry.handle(frame, float(second))
            readings.append(some(telemetry.reading).value)
            places.add(some(telemetry.position)[:2])
    assert readings[0] == pytest.approx(SOURCE.intensity)
    assert min(readings) == pytest.approx(readings[int(ROUND_S) // 2])
    assert len(places) == ROUND_S
    north = [latitude for latitude, _ in places]
    assert max(north) - min(north) == pytest.approx(2 * RADIUS_M / METRES_PER_DEGREE, rel=0.01)


@pytest.mark.parametrize(
    ("fields", "payload", "shown"),
    [
        (
            {"kind": Kind.MEASUREMENT, "measurement": Measurement(45.0, -73.0, 110.0, 1.5, 0.25)},
            b"",
            "reading 1.5, risk 0.250",
        ),
        ({"file": "a\x1b.jpg"}, b"", "file a\\x1b.jpg"),
        ({}, b"hello\x07", "6 bytes"),
        ({}, b"\x1b[2Jhello", "9 bytes"),
        ({}, b"\x00\x01\x02", "3 bytes"),
        ({}, b"x" * 61, "x" * 60 + " ..."),
        ({}, b"\x89PNG\r\n" + bytes(200), "206 bytes"),
        ({"kind": Kind.BYTES | SEALED}, b"raw", "sealed"),
    ],
)
def test_how_a_datum_is_shown(fields: dict[str, Any], payload: bytes, shown: str) -> None:
    entry = Entry(1, DatumId(2, 0x0123ABCD, 4), 0, Kind.BYTES, len(payload), 1, 0.0, None, False, 1.0)
    line = arrival_line(entry._replace(**fields), payload)
    assert line[8:].startswith(f" node 2 {shown}")


def test_a_file_in_parts_has_a_line_and_not_one_for_each_part() -> None:
    now = 0.0
    files = Files(Groups(), lambda: now)
    cut = cut_file(95 * 100, 95 * 100, b"d" * 32, PLAIN, 100)
    blank = Entry(1, DatumId(2, 0x0123ABCD, 0), 0, Kind.BYTES, 100, 1, 0.0, None, False, 1.0)
    name = "photo\x1b[2J.jpg"
    manifest = blank._replace(kind=Kind.MANIFEST, manifest=Manifest(cut, name, 9500, b"d" * 32), file=name)

    def part(number: int) -> Entry:
        return blank._replace(id=DatumId(2, 0x0123ABCD, number + 1), kind=Kind.PART, part=PartHead(cut, number))

    assert not files.takes(blank)
    assert files.takes(manifest)
    assert [files.line(entry) for entry in (manifest, *map(part, range(40)))] == [None] * 41
    assert [line[9:] for line in files.unfinished()] == ["node 2 photo\\x1b[2J.jpg 40 of 95 parts"]
    now = 10.0
    assert some(files.line(part(40)))[9:] == "node 2 photo\\x1b[2J.jpg 41 of 95 parts"
    said = [files.line(part(number)) for number in range(41, 95)]
    assert [line[9:] for line in said if line is not None] == ["node 2 photo\\x1b[2J.jpg 95 parts"]
    assert files.line(part(94)) is None, "a second copy"
    assert files.unfinished() == []

"""`rass-mav mock-vehicle`: an autopilot that is none, for a node with a configuration of one's own."""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from rass_mav.app.config import RunConfig
from rass_mav.cli import main
from rass_mav.config.typed import build
from rass_mav.errors import LinkError
from rass_mav.lab.fleet.rehearsal import Flight, Rehearsal, Way
from rass_mav.link.address import parse_vehicle_url
from rass_mav.link.vehicle import open_vehicle
from rass_mav.mavlink.frames import FrameReader, FrameWriter
from rass_mav.mavlink.messages import companion_heartbeat
from rass_mav.mavlink.signedport import SignedPort
from rass_mav.mavlink.telemetry import Telemetry
from tests.patience import PATIENCE_S
from tests.some import some

PLACE = (-33.9, 18.4)


def free_port(kind: socket.SocketKind = socket.SOCK_DGRAM) -> int:
    with socket.socket(socket.AF_INET, kind) as sock:
        sock.bind(("127.0.0.1", 0))
        port: int = sock.getsockname()[1]
        return port


@contextmanager
def program(*arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    """`rass-mav` with these arguments, until the end of the block."""
    process = subprocess.Popen([sys.executable, "-m", "rass_mav", *arguments], stdout=subprocess.PIPE)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def written(path: Path, text: str) -> str:
    path.write_text(text)
    return str(path)


def line_of(process: subprocess.Popen[bytes]) -> dict[str, Any]:
    """The next line that it writes, JSON."""
    assert process.stdout is not None
    ready, _, _ = select.select([process.stdout], [], [], PATIENCE_S)
    assert ready
    found: dict[str, Any] = json.loads(process.stdout.readline())
    return found


def test_data_of_a_real_node_arrive_with_places_and_readings(tmp_path: Path) -> None:
    vehicle, drone, base = free_port(), free_port(), free_port()
    flown = written(
        tmp_path / "drone.yaml",
        f"node: {{id: 5, step_s: 0.2}}\nautopilot: {{url: 'udpin:127.0.0.1:{vehicle}'}}\n"
        f"links: [{{type: udp, listen: '127.0.0.1:{drone}', peers: [{{address: '127.0.0.1:{base}'}}]}}]\n"
        f"risk: {{unit: usvh, low: 1, high: 100}}\nstore: {{path: {tmp_path}/drone.db}}\n",
    )
    ground = written(
        tmp_path / "base.yaml",
        f"node: {{id: 1, role: base, step_s: 0.2}}\n"
        f"links: [{{type: udp, listen: '127.0.0.1:{base}', peers: [{{address: '127.0.0.1:{drone}'}}]}}]\n"
        f"store: {{path: {tmp_path}/base.db}}\n",
    )
    source = f"--source={PLACE[0]},{PLACE[1]},1e5"
    with (
        program("mock-vehicle", flown, source, "--path", "hover", "--json") as mock,
        program("run", "-q", "--json", flown),
        program("run", "-q", "--json", ground) as sink,
    ):
        line_of(sink)
        with program("ls", ground, "--follow", "--json", "--above", "10") as arrivals:
            arrived = line_of(arrivals)["measurement"]
        mock.send_signal(signal.SIGINT)
        summary = line_of(mock)
        assert mock.wait(PATIENCE_S) == 0
    assert (arrived["latitude"], arrived["longitude"]) == pytest.approx(PLACE, abs=1e-5)
    # 1e5 uSv/h at 1 m, from a height of 10 m.
    assert (arrived["reading"], arrived["unit"]) == (pytest.approx(1000.0, rel=0.3), "usvh")
    assert summary["system_id"] == 5
    assert summary["heartbeats"] > 0


def config_of(url: str | None, **sections: Any) -> RunConfig:
    keys = {"node": {"id": 9}, "autopilot": {"url": url}, "links": [{"type": "udp"}], **sections}
    return build(keys, RunConfig)


async def heard(config: RunConfig, flight: Flight, vehicle: Rehearsal) -> Telemetry:
    """What the node's own port makes of the vehicle: until it knows where it is, the date and the reading."""
    telemetry = Telemetry(
        0, reading_name=config.mavlink.reading_name, reading_component=config.mavlink.reading_component
    )
    port = open_vehicle(parse_vehicle_url(some(config.autopilot.url)))
    came = asyncio.Event()
    heartbeat, reader = FrameWriter(9, 191).message(companion_heartbeat()), FrameReader()
    try:
        vehicle.port.start(came.set)
        port.start(came.set)
        now = 0.0
        while None in (telemetry.position, telemetry.reading, telemetry.date) or not vehicle.heard:
            port.send(heartbeat)
            vehicle.turn(now)
            now += 0.2
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(came.wait(), 0.05)
            came.clear()
            for data in port.receive():
                for frame in reader.feed(data):
                    telemetry.handle(frame, now)
    finally:
        port.close()
        vehicle.port.close()
    return telemetry


@pytest.mark.parametrize("mode", ["udpin", "udpout", "tcp", "serial"])
def test_it_is_the_other_end_of_every_port(mode: str, tmp_path: Path) -> None:
    if mode == "serial":
        pytest.importorskip("serial", reason="pyserial is not installed (extra drone)")
    kind = socket.SOCK_STREAM if mode == "tcp" else socket.SOCK_DGRAM
    device = tmp_path / "ttyAMA0"
    # One that was killed has left its name.
    device.symlink_to("/dev/pts/no-longer")
    config = config_of(
        f"serial:{device}:57600" if mode == "serial" else f"{mode}:127.0.0.1:{free_port(kind)}",
        mavlink={"reading_name": "GEIGER", "reading_component": 25, "autopilot_id": 77}, risk={"unit": "cpm"},
    )  # fmt: skip
    said: list[str] = []
    flight = Flight(PLACE, "hover", sources=[(*PLACE, 1e5)])

    async def both() -> Telemetry:
        return await asyncio.wait_for(heard(config, flight, Rehearsal(config, flight, said.append)), PATIENCE_S)

    telemetry = asyncio.run(both())
    position = some(telemetry.position)
    assert (position.latitude, position.longitude) == pytest.approx(PLACE, abs=1e-6)
    # 106 counts a minute are 1 uSv/h for the tube.
    assert some(telemetry.reading).value == pytest.approx(106_000.0, rel=0.3)
    assert telemetry.system_id == 77
    assert some(telemetry.date).utc == pytest.approx(time.time(), abs=600)
    assert [line[9:] for line in said] == ["the node is there"]
    assert mode != "serial" or not device.is_symlink()


@pytest.mark.parametrize(
    ("mode", "why"),
    [
        ("udpin", "another mock vehicle sends to this port; stop it first"),
        ("udpout", "address already in use"),
        ("tcp", "address already in use"),
    ],
)
def test_a_second_one_at_the_same_port_is_refused(mode: str, why: str) -> None:
    kind = socket.SOCK_STREAM if mode == "tcp" else socket.SOCK_DGRAM
    config = config_of(f"{mode}:127.0.0.1:{free_port(kind)}")
    first = Rehearsal(config, Flight(PLACE), print)
    with pytest.raises(LinkError, match=why):
        Rehearsal(config, Flight(PLACE), print)
    first.port.close()
    Rehearsal(config, Flight(PLACE), print).port.close()


def test_a_node_that_is_gone_is_reported() -> None:
    said: list[str] = []

    async def turns() -> None:
        config = config_of(f"udpout:127.0.0.1:{free_port()}")
        vehicle = Rehearsal(config, Flight(PLACE), said.append)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as node:
            came = asyncio.Event()
            vehicle.port.start(came.set)
            node.sendto(
                FrameWriter(9, 191).message(companion_heartbeat()),
                parse_vehicle_url(some(config.autopilot.url)).address,
            )
            await asyncio.wait_for(came.wait(), PATIENCE_S)
        vehicle.turn(0.0)
        vehicle.turn(4.9)
        vehicle.turn(5.1)
        vehicle.port.close()

    asyncio.run(turns())
    assert [line[9:] for line in said] == ["the node is there", "the node is silent"]


def test_an_autopilot_with_signing_signs_with_the_key_of_the_drone(tmp_path: Path) -> None:
    pytest.importorskip("nacl", reason="PyNaCl is not installed (extra keys)")
    from rass_mav.app.signing import signing_key
    from rass_mav.trust.keys.folder import create, issue

    create(tmp_path / "mission")
    issue(tmp_path / "mission", [9])
    url = f"udpin:127.0.0.1:{free_port()}"
    config = config_of(
        url, keys={"file": str(tmp_path / "mission" / "drone-9.keys")}, autopilot={"url": url, "signing": True}
    )
    checked = FrameReader(SignedPort(signing_key(some(config.open_keys())), 0))

    async def first() -> bytes:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as node:
            node.settimeout(PATIENCE_S)
            node.bind(parse_vehicle_url(url).address)
            vehicle = Rehearsal(config, Flight(PLACE), print)
            vehicle.port.start(lambda: None)
            vehicle.turn(0.0)
            vehicle.port.close()
            return node.recv(300)

    [frame] = checked.datagram(asyncio.run(first()))
    assert frame.signed


@pytest.mark.parametrize("path", ["circle", "lawnmower", "hover"])
def test_a_path_is_flown_at_its_speed_and_stays_in_its_square(path: str) -> None:
    way = Way(Flight(PLACE, path, size_m=60.0, speed_m_s=5.0))
    places = [way.at(n * 0.2) for n in range(1200)]
    speed = 0.0 if path == "hover" else 5.0
    assert max(max(abs(x), abs(y)) for x, y, _ in places) == pytest.approx(30.0 if speed else 0.0)
    for (x1, y1, v), (x2, y2, _) in pairwise(places):
        assert math.hypot(*v) == pytest.approx(speed)
        assert math.dist((x1, y1), (x2, y2)) <= speed * 0.2 + 1e-9
    if path == "lawnmower":
        assert {round(y) for x, y, _ in places if abs(x) < 1} == {-30, -18, -6, 6, 18, 30}


DRONE = "node: {id: 5}\nlinks: [{broadcast: '127.255.255.255:9'}]\nautopilot: {url: %s}\n"


@pytest.mark.parametrize(
    ("url", "options", "error"),
    [
        ("null", [], "autopilot.url: none, so this node listens to no vehicle; pass --set"),
        ("udpin:127.0.0.1:0", [], "autopilot.url: expected a fixed port, got 'udpin:127.0.0.1:0'"),
        ("tcp:192.0.2.1:5760", [], "autopilot.url: expected an address of this computer for a rehearsal"),
        ("udpout:127.0.0.1:{port}", [], "udpin:127.0.0.1:{port}: address already in use"),
        (
            "serial:{taken}:57600",
            [],
            "serial:{taken}:57600: the mock vehicle cannot use this port: file exists",
        ),
        ("udpin:127.0.0.1:14550", ["--place", "here"], "--place: expected latitude and longitude, separated by commas"),
        (
            "udpin:127.0.0.1:14550",
            ["--place", "1,2,3"],
            "--place: expected latitude and longitude, separated by commas",
        ),
        ("udpin:127.0.0.1:14550", ["--place", "91,0"], "--place: expected a latitude within 89 degrees"),
        ("udpin:127.0.0.1:14550", ["--source", "45,-73"], "--source: expected latitude, longitude and uSv/h at 1 m"),
        (
            "udpin:127.0.0.1:14550",
            ["--source", "45,-73,nan"],
            "--source: expected latitude, longitude and uSv/h at 1 m",
        ),
        ("udpin:127.0.0.1:14550", ["--source", "45,-73,-1"], "--source: expected at least 0 uSv/h, got '45,-73,-1'"),
        ("udpin:127.0.0.1:14550", ["--speed", "0"], "--speed: expected a number above 0, at most 100, got 0"),
        ("udpin:127.0.0.1:14550", ["--size", "nan"], "--size: expected a number above 0, at most 20000, got nan"),
        ("udpin:127.0.0.1:14550", ["--for", "-1"], "--for: expected a number above 0, got -1"),
    ],
)
def test_what_it_cannot_do_it_says_in_a_line(
    url: str, options: list[str], error: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    taken = tmp_path / "ttyAMA0"
    taken.touch()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        about = {"port": sock.getsockname()[1], "taken": taken}
        config = written(tmp_path / "drone.yaml", DRONE % url.format(**about))
        assert main(["mock-vehicle", config, *options]) in (1, 2)
    assert capsys.readouterr().err.startswith(error.format(**about))
    assert taken.exists()


def test_what_it_does_not_stand_in_for_is_said(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    config = written(
        tmp_path / "drone.yaml",
        "node: {id: 5}\nlinks: [{type: autopilot}]\nmavlink: {autopilot_id: 5}\n"
        f"autopilot: {{url: 'udpin:127.0.0.1:{free_port()}'}}\nsensor: {{type: program}}\n",
    )
    assert main(["mock-vehicle", config, "--for", "0.01"]) == 0
    out = capsys.readouterr().out
    assert "sensor.type is program: the node does not use the readings of the mock vehicle" in out
    assert "links[0] goes through the autopilot: a mock vehicle forwards nothing to other nodes" in out

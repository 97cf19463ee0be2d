"""Readings that programs hand in: with real nodes, by the command and by the socket."""

from __future__ import annotations

import asyncio
import json
import os
import random
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import settings as tried
from hypothesis import strategies as st

from rass_mav.agent.settings import DataSettings
from rass_mav.app.clock import LivedClock, TimeSources
from rass_mav.app.driver import Driver
from rass_mav.app.handed import HandedReading
from rass_mav.app.measures import MOST_DATA, Measures
from rass_mav.app.payloads import parse_name
from rass_mav.app.track import Track
from rass_mav.config.typed import build
from rass_mav.errors import ControlError, RefusedError
from rass_mav.lab.swarm.autopilot import autopilot_heartbeat
from rass_mav.mavlink.dialect import MavlinkMessage
from rass_mav.mavlink.frames import FrameWriter
from rass_mav.mavlink.telemetry import Position
from rass_mav.sensor.dose import STATED
from rass_mav.sensor.settings import SensorSettings
from rass_mav.station.node import build_node
from rass_mav.store.memory import MemoryStore
from rass_mav.wire.measurement import decode_measurement
from tests.environment import environment
from tests.patience import PATIENCE_S
from tests.some import some
from tests.telemetry import global_position_int, named_value_float

from .app_drivers import settings
from .app_nodes import RunningNode, Tidy, command, free_ports, line_of, process

PROGRAM = {"type": "program"}
#: A place that no mock vehicle is at.
HERE = {"latitude": -35.5, "longitude": 149.25, "altitude": 584.5}


def alone(directory: Path, **sections: Any) -> RunningNode:
    """A drone that hears nobody."""
    (port,) = free_ports(1)
    link = {"listen": f"127.0.0.1:{port}", "peers": [{"address": "127.0.0.1:9"}]}
    return RunningNode(directory, 7, links=[link], **sections)


class Vehicle:
    """An autopilot, and other components at its port."""

    def __init__(self, sock: socket.socket, port: int) -> None:
        self._sock, self._port = sock, port

    def say(self, *messages: MavlinkMessage, system: int = 42, component: int = 1) -> None:
        writer = FrameWriter(system, component)
        for message in messages:
            self._sock.sendto(writer.message(message), ("127.0.0.1", self._port))


@pytest.fixture
def vehicle() -> Iterator[Vehicle]:
    (port,) = free_ports(1)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        yield Vehicle(sock, port)


def flying(directory: Path, vehicle: Vehicle, **sections: Any) -> RunningNode:
    return alone(directory, autopilot={"url": f"udpin:127.0.0.1:{vehicle._port}"}, **sections)


def measured(node: RunningNode) -> list[dict[str, Any]]:
    return [entry.plain()["measurement"] for entry in node.listing().values()]


def test_a_reading_goes_the_way_of_a_sensors_and_arrives_with_its_unit(
    tmp_path: Path, tidy: Tidy, vehicle: Vehicle
) -> None:
    (port, peer) = free_ports(2)
    base = tidy(
        RunningNode(
            tmp_path, 1, node={"role": "base"},
            links=[{"listen": f"127.0.0.1:{peer}", "peers": [{"id": 7, "address": f"127.0.0.1:{port}"}]}],
        )
    ).start()  # fmt: skip
    drone = tidy(
        RunningNode(
            tmp_path, 7, autopilot={"url": f"udpin:127.0.0.1:{vehicle._port}"},
            links=[{"listen": f"127.0.0.1:{port}", "peers": [{"id": 1, "address": f"127.0.0.1:{peer}"}]}],
            risk={"low": 0, "high": 100}, data={"interval_steps": 5}, sensor=PROGRAM,
        )
    ).start()  # fmt: skip

    def placed() -> bool:
        vehicle.say(autopilot_heartbeat(), global_position_int(48.5, 2.25, 330.0, 300.0, 1000))
        return drone.status()["position"] is not None

    drone.until(placed)
    assert (drone.status()["risk"], drone.status()["handed_in"]) == (1.0, None)
    said = command(tmp_path, "measure", "0.025", "--unit", "mSv/h", "-c", "n7.yaml")
    assert (said.returncode, said.stderr) == (0, b"")
    # After a pause a reading becomes a datum at once: what is due next may come too late for it.
    first = said.stdout.decode().strip()
    status = drone.status()
    assert (status["risk"], status["risk_known"]) == (0.25, True)
    assert status["reading"]["unit"] == "usvh"
    assert status["handed_in"]["readings"] == status["handed_in"]["data"] == 1
    # The next ones become measurements when these are due, as those of a sensor do.
    taken = json.loads(command(tmp_path, "measure", "75", "--unit", "uSv/h", "-c", "n7.yaml", "--json").stdout)
    assert (taken["id"], taken["unit"], taken["drives_risk"]) == (None, "usvh", True)
    assert 0.0 < taken["due_s"] <= 5 * 0.05
    base.until(lambda: any(entry.reading == 75.0 for entry in base.listing().values()))
    entry = base.listing()[first]
    assert (entry.reading, entry.place) == (25.0, (48.5, 2.25))
    assert entry.measurement is not None
    assert entry.measurement.unit == "usvh"
    assert "25 uSv/h" in command(tmp_path, "ls", "n1.yaml").stdout.decode()


def test_a_reading_with_its_own_time_and_place_is_a_datum_of_its_own(tmp_path: Path, tidy: Tidy) -> None:
    base, drone = (tidy(node).start() for node in line_of(tmp_path, [1, 2], sensor=PROGRAM))
    when = time.time() - 40.0
    ids = [
        drone.ask("measure", value=3.0, unit="uSv/h", time=when, **HERE)["id"],
        drone.ask("measure", value=4.0, unit="uSv/h", time=_iso(when + 10))["id"],
        # Nobody knows where it was measured: the vehicle has been elsewhere since.
        base.ask("measure", value=5.0, unit="uSv/h", **HERE)["id"],
    ]
    base.until(lambda: set(ids) <= set(base.listing()))
    entries = [base.listing()[id] for id in ids]
    assert [entry.reading for entry in entries] == [3.0, 4.0, 5.0]
    assert [entry.place for entry in entries] == [(-35.5, 149.25), None, (-35.5, 149.25)]
    assert entries[0].altitude == 584.5
    assert entries[0].utc == pytest.approx(when, abs=2.0)
    assert entries[1].utc == pytest.approx(when + 10, abs=2.0)
    assert entries[0].measurement is not None
    assert entries[0].measurement.error_m is None, "nobody knows the error of a place that was stated"
    # They are too old to say how dangerous it is now.
    assert drone.status()["risk_known"] is False
    assert base.status()["reading"] is None, "it is of elsewhere"
    with pytest.raises(RefusedError, match=r"a base has no readings of its own: state where"):
        base.ask("measure", value=5.0, unit="uSv/h")


def _iso(date: float) -> str:
    return datetime.fromtimestamp(date, timezone.utc).isoformat().replace("+00:00", "Z")


@pytest.mark.parametrize(
    ("arguments", "code", "error"),
    [
        (["0,12", "--unit", "uSv/h"], 2, "VALUE: expected a number with a decimal point, like 0.12, got '0,12'"),
        (["nan", "--unit", "uSv/h"], 2, "VALUE: expected a number with a decimal point, like 0.12, got 'nan'"),
        (["inf", "--unit", "uSv/h"], 2, "VALUE: expected a number with a decimal point, like 0.12, got 'inf'"),
        (["1e999", "--unit", "uSv/h"], 2, "value: expected a finite number, got inf"),
        (["-1", "--unit", "uSv/h"], 2, "value: expected a number >= 0, got -1.0"),
        (["1"], 2, "measure: expected VALUE --unit UNIT, or --follow"),
        (["1", "--unit", "mR/h"], 2, "unit: expected one of Sv/h, counts, cpm, cps, mSv/h, nSv/h, uSv/h,"),
        (["1", "--unit", "uSv/h", "--at", "47,5,8,5,400"], 2, "--at: expected LAT,LON,ALT like 47.3977,8.5456,408"),
        (["1", "--unit", "uSv/h", "--at", "91,8,400"], 2, "latitude: expected a number >= -90 and <= 90, got 91.0"),
        (["1", "--unit", "uSv/h", "--at", "47,8,up"], 2, "--at: expected a number with a decimal point, like 0.12"),
        (
            ["1", "--unit", "uSv/h", "--at", "0,0,12"],
            2,
            "latitude, longitude: 0, 0 comes from a receiver without a fix",
        ),
        (["1", "--unit", "uSv/h", "--time", "noon"], 2, "time: expected a date like 2026-11-22T10:30 (UTC), got"),
        (["1", "--unit", "uSv/h", "--time", "1970-01-01"], 1, "time: 1970-01-01T00:00:00Z is before 2024: the program"),
        (["1", "--unit", "uSv/h", "--time", "2099-01-01"], 1, "s ahead of this node's clock"),
        (["1", "--unit", "uSv/h", "--time", "2024-02-01"], 1, " d ago, at most 7 d"),
        (["1", "--unit", "cps"], 1, "unit: cps needs sensor.cpm_per_usvh to be converted to usvh, the unit of this"),
        (["1", "--unit", "counts"], 1, "unit: counts cannot be converted to usvh, the unit of this node's readings"),
        (["9e299", "--unit", "uSv/h"], 1, "value: 9e+299 uSv/h is not a valid reading"),
        (["1", "--follow"], 2, "--follow: readings come from stdin, expected no value"),
    ],
)
def test_what_is_no_reading_is_an_error_in_words(
    lonely: RunningNode, arguments: list[str], code: int, error: str
) -> None:
    before = lonely.status()
    said = command(lonely.directory, "measure", *arguments, "-c", "n7.yaml")
    assert (said.returncode, said.stdout) == (code, b"")
    (line,) = said.stderr.decode().splitlines()
    assert error in line
    after = lonely.status()
    for status in (before, after):
        del status["store"]["quota_bytes"]  # of what the disk has, which others use too
    assert (after["reading"], after["store"]) == (before["reading"], before["store"])
    if code == 1:
        assert after["handed_in"]["last_refusal"] == line


@pytest.fixture(scope="module")
def lonely(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningNode]:
    """A drone to which nothing happens."""
    node = alone(tmp_path_factory.mktemp("lonely"), sensor=PROGRAM).start()
    yield node
    assert node.signal(signal.SIGTERM) == 0


def test_an_operator_in_the_south_needs_no_tricks(lonely: RunningNode) -> None:
    said = command(lonely.directory, "measure", "0.1", "--unit", "µSv/h", "--at", "-35.5,149.25,584.5", "-c", "n7.yaml")
    assert (said.returncode, said.stderr) == (0, b"")
    assert lonely.listing()[said.stdout.decode().strip()].place == (-35.5, 149.25)


def test_follow_answers_each_line_and_goes_on_after_a_bad_one(tmp_path: Path, tidy: Tidy) -> None:
    node = tidy(alone(tmp_path, sensor=PROGRAM))
    lines = [
        json.dumps({"value": 0.25, "unit": "uSv/h", **HERE}),
        "0.25 uSv/h",
        '{"value": 0,25, "unit": "uSv/h"}',
        '{"value": NaN, "unit": "uSv/h"}',
        '{"value": "0.25", "unit": "uSv/h"}',
        '{"value": 0.25, "unit": "uSv/h", "tiem": 3}',
        '{"value": 0.25, "unit": "uSv/h", "command": "put"}',
        '{"value": 0.25, "unit": "uSv/h", "time": 1764240000000}',
        '{"value": 0.25, "unit": "uSv/h", "latitude": 47.5}',
        '{"value": 0.25, "unit": ["uSv/h"]}',
        "[" * 2000,
        "",
        "\x00\x1b[2J",
        json.dumps({"value": 0.5, "unit": "uSv/h", **HERE}),
    ]
    said = "".join(f"{line}\n" for line in lines).encode()
    # Without a node every line is refused, and has its answer.
    done = command(tmp_path, "measure", "-c", "n7.yaml", "--follow", stdin=said)
    assert done.returncode == 1
    answers = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(answers) == len(lines)
    assert "no running node" in answers[0]["error"]
    node.start()
    done = process(tmp_path, "measure", "-c", "n7.yaml", "--follow", stdin=said)
    assert (done.returncode, done.stderr) == (1, b"")
    answers = [json.loads(line) for line in done.stdout.splitlines()]
    assert [answer["ok"] for answer in answers] == [True, *[False] * (len(lines) - 2), True]
    assert all("\n" not in answer["error"] and answer["error"] for answer in answers[1:-1])
    assert answers[5]["error"] == "tiem: unknown key (did you mean 'time'?)"
    handed_in = node.status()["handed_in"]
    assert (handed_in["readings"], handed_in["refused"]) == (2, len(lines) - 2)
    assert handed_in["last_refusal"] == answers[-2]["error"]
    assert {entry.reading for entry in node.listing().values()} == {0.25, 0.5}
    good = command(tmp_path, "measure", "-c", "n7.yaml", "--follow", stdin=f"{lines[0]}\n".encode())
    assert (good.returncode, command(tmp_path, "measure", "-c", "n7.yaml", "--follow").returncode) == (0, 0)


def test_follow_answers_a_long_line_once(lonely: RunningNode) -> None:
    start, end = b'{"unit": "uSv/h", "value": 0.', b"}"
    longest = start + (4096 - len(start) - len(end)) * b"5" + end
    said = b"\n".join(
        [
            longest,
            longest.replace(b"5", b"55", 1),
            2_000_000 * b"5",
            b'{"value": 1, "unit": "uSv/h"}',
        ]
    )
    done = command(lonely.directory, "measure", "-c", "n7.yaml", "--follow", stdin=said + b"\n" + 5000 * b"5")
    answers = [json.loads(line) for line in done.stdout.splitlines()]
    assert [answer["ok"] for answer in answers] == [True, False, False, True, False]
    assert answers[1] == answers[2] == answers[4] == {"ok": False, "error": "line too long, at most 4096 bytes"}


@pytest.mark.parametrize(
    "line",
    [
        b'{"command": "measure", "value": "1", "unit": "uSv/h"}',
        b'{"command": "measure", "value": NaN, "unit": "uSv/h"}',
        b'{"command": "measure", "value": 0,12, "unit": "uSv/h"}',
        b'{"command": "measure", "value": [1], "unit": "uSv/h"}',
        b'{"command": "measure", "value": 1, "unit": "uSv/h", "tiem": 3}',
    ],
)
def test_a_malformed_reading_on_the_socket_counts_as_refused(lonely: RunningNode, line: bytes) -> None:
    before = (lonely.status()["handed_in"] or {"refused": 0})["refused"]
    with socket.socket(socket.AF_UNIX) as sock:
        sock.settimeout(PATIENCE_S)
        sock.connect(os.path.relpath(lonely.directory / "n7.sock"))
        sock.sendall(line + b"\n")
        error = json.loads(sock.makefile().readline())["error"]
    handed_in = lonely.status()["handed_in"]
    assert handed_in["refused"] == before + 1
    assert error == f"not a request: {handed_in['last_refusal']}"


@pytest.mark.parametrize(
    ("line", "error"),
    [
        (b"\0\0{\0", "Expecting value: line 1 column 1 (char 0)"),
        (b'{"value": 1, "unit": "\xb5Sv/h"}', "not UTF-8"),
        (b'{"value": ' + 3000 * b"9" + 2000 * b"9" + b', "unit": "uSv/h"}', "line too long, at most 4096 bytes"),
    ],
)
def test_follow_says_what_is_no_json(lonely: RunningNode, line: bytes, error: str) -> None:
    done = command(lonely.directory, "measure", "-c", "n7.yaml", "--follow", stdin=line + b"\n")
    assert json.loads(done.stdout)["error"].removeprefix("expected a JSON object on each line: ") == error


def test_a_number_with_too_many_digits_on_the_socket_is_named(lonely: RunningNode) -> None:
    with socket.socket(socket.AF_UNIX) as sock:
        sock.settimeout(PATIENCE_S)
        sock.connect(os.path.relpath(lonely.directory / "n7.sock"))
        sock.sendall(b'{"command": "measure", "unit": "uSv/h", "value": ' + 5000 * b"9" + b"}\n")
        error = json.loads(sock.makefile().readline())["error"]
    assert error == "not a request: a number with too many digits"


def test_follow_outlives_the_node(tmp_path: Path, tidy: Tidy) -> None:
    node = tidy(alone(tmp_path, sensor=PROGRAM)).start()
    following = [sys.executable, "-m", "rass_mav", "measure", "-c", "n7.yaml", "--follow"]
    with subprocess.Popen(
        following, cwd=tmp_path, env=environment(), stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as program:
        assert program.stdin is not None
        assert program.stdout is not None

        def hand_in() -> bool:
            assert program.stdin is not None
            assert program.stdout is not None
            program.stdin.write(json.dumps({"value": 1, "unit": "uSv/h", **HERE}).encode() + b"\n")
            program.stdin.flush()
            ready, _, _ = select.select([program.stdout], [], [], PATIENCE_S)
            assert ready
            return bool(json.loads(program.stdout.readline())["ok"])

        assert hand_in()
        assert node.signal(signal.SIGKILL) == -signal.SIGKILL
        assert not hand_in()
        node.start()
        assert hand_in()
        program.stdin.close()
        assert program.wait(PATIENCE_S) == 1
    assert len(node.listing()) == 2


def test_a_runaway_program_fills_no_store_and_the_risk_follows_it(tmp_path: Path, tidy: Tidy) -> None:
    node = tidy(alone(tmp_path, sensor=PROGRAM, risk={"low": 0, "high": 1000})).start()
    refused = []
    with node.client() as client:
        for number in range(MOST_DATA + 50):
            try:
                client.ask("measure", value=number, unit="uSv/h", time=time.time())
            except RefusedError as error:
                refused.append(str(error))
    assert len(refused) == 50
    assert refused[0].startswith(f"no datum: at most {MOST_DATA} readings in 60 s become separate data; the next ")
    assert refused[0].endswith(" s; the risk follows it")
    status = node.status()
    assert status["reading"]["value"] == MOST_DATA + 49
    assert len(node.listing()) == MOST_DATA
    assert (status["handed_in"]["data"], status["handed_in"]["refused"]) == (MOST_DATA, 50)
    assert (
        f"{MOST_DATA} of them as separate data; 50 refused, the last: no datum: "
        in command(tmp_path, "status", "n7.yaml").stdout.decode()
    )
    # Readings of the moment make no data of their own, so there may be many.
    with node.client() as client:
        for _ in range(3 * MOST_DATA):
            assert client.ask("measure", value=5, unit="uSv/h")["id"] is None
    assert len(node.listing()) == MOST_DATA


def test_what_programs_hand_in_leaves_space_for_the_nodes_own_measurements(tmp_path: Path, tidy: Tidy) -> None:
    node = tidy(
        alone(tmp_path, sensor=PROGRAM, store={"capacity_items": 20, "own_share": 0.5}, data={"interval_steps": 2})
    ).start()
    made = 0

    def flood() -> None:
        nonlocal made
        with node.client() as client:
            for _ in range(21):
                client.ask("measure", value=2, unit="uSv/h", time=time.time() - 30.0)
                made += 1

    with pytest.raises(RefusedError, match="the store is full, except for the space reserved for this node's"):
        flood()
    assert made <= 10

    def goes_on() -> bool:
        node.ask("measure", value=3, unit="uSv/h")
        return len([m for m in measured(node) if m["reading"] == 3.0]) >= 5

    node.until(goes_on)


@pytest.mark.parametrize("policy", ["stigmergy", "rass-literal"])
def test_it_is_the_same_under_other_policies(tmp_path: Path, tidy: Tidy, policy: str) -> None:
    node = tidy(alone(tmp_path, sensor=PROGRAM, policy={"name": policy})).start()
    id = node.ask("measure", value=2, unit="uSv/h", **HERE)["id"]
    assert node.listing()[id].place == (-35.5, 149.25)
    assert node.status()["risk"] == 1.0


def test_a_node_has_one_detector(tmp_path: Path, tidy: Tidy, vehicle: Vehicle) -> None:
    node = tidy(flying(tmp_path, vehicle)).start()
    # While the autopilot sends no readings, programs may.
    assert node.ask("measure", value=1, unit="uSv/h")["unit"] == "usvh"

    def heard() -> bool:
        vehicle.say(autopilot_heartbeat(), named_value_float("RAD", 25.0, 1000))
        return bool(node.status()["reading"]["value"] == 25.0)

    node.until(heard)
    with pytest.raises(RefusedError, match=r"the autopilot sends readings \(RAD\): to submit your own, set sensor"):
        node.ask("measure", value=1, unit="uSv/h")
    assert node.status()["reading"]["value"] == 25.0
    assert node.signal(signal.SIGTERM) == 0
    counter = tidy(alone(tmp_path, sensor={"type": "gmc", "port": str(tmp_path / "tty")})).start()
    with pytest.raises(
        RefusedError, match=r"readings come from sensor\.type gmc: to submit your own, set sensor\.type to program"
    ):
        counter.ask("measure", value=1, unit="uSv/h")


def test_with_programs_the_autopilots_readings_are_ignored_and_status_says_it(
    tmp_path: Path, tidy: Tidy, vehicle: Vehicle
) -> None:
    node = tidy(flying(tmp_path, vehicle, sensor={"type": "program", "cpm_per_usvh": 60.0})).start()

    def ignored() -> bool:
        vehicle.say(autopilot_heartbeat(), named_value_float("RAD", 25.0, 1000))
        return bool(node.status()["ignored_readings"])

    node.until(ignored)
    assert node.ask("measure", value=2, unit="cps")["value"] == 2.0
    status = node.status()
    (row,) = status["ignored_readings"]
    assert (row["system_id"], row["component_id"], row["name"], row["named"]) == (42, 1, "RAD", True)
    assert (status["reading"]["value"], status["reading"]["unit"]) == (2.0, "usvh")
    assert (
        "ignored: NAMED_VALUE_FLOAT RAD of system 42, component 1, "
        in command(tmp_path, "status", "n7.yaml").stdout.decode()
    )


def test_a_setting_names_the_component_that_sends_the_reading(tmp_path: Path, tidy: Tidy, vehicle: Vehicle) -> None:
    node = tidy(flying(tmp_path, vehicle, mavlink={"reading_component": 158, "reading_name": "DOSE"})).start()

    def heard() -> bool:
        vehicle.say(autopilot_heartbeat(), named_value_float("DOSE", 1.0, 1000))
        vehicle.say(named_value_float("DOSE", 7.5, 1000), component=158)
        vehicle.say(named_value_float("DOSE", 2.0, 1000), system=43, component=158)
        vehicle.say(named_value_float("TEMP", 20.0, 1000), component=158)
        status = node.status()
        return status["reading"] is not None and len(status["ignored_readings"]) == 3

    node.until(heard)
    status = node.status()
    assert status["reading"]["value"] == 7.5
    assert {(row["system_id"], row["component_id"], row["name"]) for row in status["ignored_readings"]} == {
        (42, 1, "DOSE"), (43, 158, "DOSE"), (42, 158, "TEMP"),
    }  # fmt: skip
    shown = command(tmp_path, "status", "n7.yaml").stdout.decode()
    assert "ignored: NAMED_VALUE_FLOAT DOSE of system 43, component 158, " in shown
    assert "TEMP" not in shown, "a vehicle sends much that is no reading"


class Flown:
    """A driver on a timeline that the test moves, with a computer whose date the test chooses."""

    def __init__(self, wall: Callable[[], float] = time.time) -> None:
        self.now = 1000.0
        store = MemoryStore(1)
        self.agent = build_node(replace(settings(7), sensor_unit="usvh"), store, random.Random(1), now=self.now)
        clock = LivedClock(store, TimeSources(wall=wall, trusted=lambda: False))
        self._executor = ThreadPoolExecutor(1)
        self.driver = Driver(self.agent, [], None, lambda: self.now, self._executor, lived=clock)
        self.track = Track(self.driver)
        self.measures = Measures(self.driver, SensorSettings(type="program"), self.track)

    def fly(self, latitude: float) -> None:
        vehicle = FrameWriter(7, 1)
        for message in (autopilot_heartbeat(), global_position_int(latitude, 8.0, 400.0, 20.0, 1000)):
            self.agent.vehicle_bytes(vehicle.message(message), self.now)
        self.track.step(self.now)

    async def take(self, value: float, **fields: Any) -> dict[str, Any]:
        return await self.measures.take(HandedReading(value=value, unit="uSv/h", **fields))

    def latitude(self, taken: dict[str, Any]) -> float | None:
        return decode_measurement(some(self.agent.store.get(parse_name(taken["id"])[0])).payload).latitude

    async def __aenter__(self) -> Flown:
        self._task = asyncio.create_task(self.driver.run())
        return self

    async def __aexit__(self, *failure: object) -> None:
        self.driver.stop()
        await asyncio.wait_for(self._task, PATIENCE_S)
        self._executor.shutdown()


async def test_a_reading_of_some_time_ago_was_measured_where_the_vehicle_was_then() -> None:
    async with Flown() as flown:
        for latitude in (47.0, 47.5, 48.0):
            flown.now += 30.0
            flown.fly(latitude)
        ago = {age: flown.latitude(await flown.take(1.0, time=time.time() - age)) for age in (0, 30, 45, 60, 1000)}
        assert ago == {0: 48.0, 30: 47.5, 45: None, 60: 47.0, 1000: None}


def test_a_reading_that_is_a_datum_is_in_no_measurement_at_another_place() -> None:
    given = replace(settings(7), sensor_unit="usvh", data=DataSettings(interval_steps=2))
    agent = build_node(given, MemoryStore(1), random.Random(1), now=0.0)
    vehicle, now = FrameWriter(7, 1), 0.0

    def seen() -> list[tuple[float | None, float | None]]:
        data = (decode_measurement(some(agent.store.get(id)).payload) for id in agent.node.holdings)
        return [(measured.reading, measured.latitude) for measured in data]

    def fly() -> None:
        nonlocal now
        for _ in range(4):
            now += given.step_s
            for message in (autopilot_heartbeat(), global_position_int(48.5, 8.0, 400.0, 20.0, 1000)):
                agent.vehicle_bytes(vehicle.message(message), now)
            agent.step(now)

    agent.record(agent.reading(3.0, now), Position(-35.5, 149.25, 584.5, now), now, own=False)
    fly()
    assert seen() == [(3.0, -35.5)]
    agent.reading(0.5, now)
    fly()
    assert seen() == [(3.0, -35.5), (0.5, 48.5), (0.5, 48.5)]
    now += given.risk.stale_s
    fly()
    assert seen()[3:] == [(None, 48.5)] * 2, "the vehicle's place is stored as long as no reading is known"


async def test_readings_that_overtake_each_other_drive_the_risk_and_old_ones_do_not() -> None:
    async with Flown() as flown:
        assert (await flown.take(0.5))["drives_risk"]
        assert (await flown.take(0.75, time=time.time() - 1.0))["drives_risk"]
        # With the gain of 0.1 that the policy has.
        assert flown.agent.node.risk.risk(flown.now) == pytest.approx(0.525)
        assert not (await flown.take(0.25, time=time.time() - 5.0))["drives_risk"], "a newer one is known"
        flown.now += 60.0
        assert (await flown.take(0.25, time=time.time() - 5.0))["drives_risk"]
        assert not (await flown.take(0.5, time=time.time() - 15.0))["drives_risk"]
        assert flown.agent.node.risk.risk(flown.now) == 0.25


async def test_where_nobody_knows_the_date_a_time_says_nothing() -> None:
    async with Flown(wall=lambda: 3600.0) as flown:
        for when in (3599.0, time.time()):
            with pytest.raises(ControlError, match="this computer does not know the date: omit the time"):
                await flown.take(0.5, time=when)
        assert (await flown.take(0.5))["drives_risk"]


@pytest.mark.no_cover
@tried(deadline=None, max_examples=150)
@given(
    st.dictionaries(
        st.sampled_from(["value", "unit", "time", "latitude", "longitude", "altitude", "\x1b", "x" * 99]),
        st.one_of(
            st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=30), st.sampled_from(list(STATED)),
            st.floats(0, 1e12), st.floats(-90, 90), st.lists(st.integers(), max_size=2),
        ),
    ),
    st.booleans(),
)  # fmt: skip
def test_whatever_a_program_says_is_a_reading_or_an_error(
    lonely: RunningNode, fields: dict[str, Any], whole: bool
) -> None:
    if whole:
        fields = {"value": 1.0, "unit": "uSv/h", **fields}
    try:
        taken = lonely.ask("measure", **fields)
    except RefusedError as error:
        assert str(error).isprintable()  # noqa: PT017
    else:
        assert taken["value"] >= 0.0
        assert build(fields, HandedReading).unit in STATED
    assert lonely.status()["faults"]["count"] == 0

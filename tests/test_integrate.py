"""The interface for other programs: output against the schemas in docs/schemas, and the programs in docs/examples."""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from jsonschema import Draft202012Validator
from jsonschema.exceptions import ValidationError
from referencing import Registry, Resource

from rass_mav.app.status import INTERFACE
from rass_mav.core.datum import Kind
from rass_mav.ground.attention.watch import Watch
from rass_mav.lab.swarm.autopilot import autopilot_heartbeat
from rass_mav.mavlink.frames import FrameWriter
from rass_mav.sensor.dose import STATED
from rass_mav.wire.nodestatus import NodeStatus, encode_status
from tests.app.app_nodes import RunningNode, Tidy, command, free_ports, said_by
from tests.environment import environment
from tests.ground.mission_stores import NOW, archive, mission, put, stored
from tests.patience import PATIENCE_S
from tests.telemetry import global_position_int, named_value_float

ROOT = Path(__file__).parents[1]
SCHEMAS = {path.stem: json.loads(path.read_text(encoding="utf-8")) for path in (ROOT / "docs/schemas").glob("*.json")}
EXAMPLES = sorted((ROOT / "docs/examples").glob("*.py"))
_REGISTRY: Registry[Any] = Registry().with_resources(
    (schema["$id"], Resource.from_contents(schema)) for schema in SCHEMAS.values()
)


def check(name: str, value: Any) -> None:
    """Raises `ValidationError`."""
    Draft202012Validator(SCHEMAS[name], registry=_REGISTRY).validate(value)


def unnamed(schema: dict[str, Any], value: Any, path: str = "") -> Iterator[str]:
    """Keys of objects that the schema does not name."""
    if isinstance(value, list):
        for item in value:
            yield from unnamed(schema.get("items", {}), item, f"{path}[]")
    if isinstance(value, dict) and "properties" in schema:
        for key, item in value.items():
            if key not in schema["properties"]:
                yield f"{path}.{key}"
            else:
                yield from unnamed(schema["properties"][key], item, f"{path}.{key}")


# -- the schemas -------------------------------------------------------------------------------------------------------


def test_the_schemas_are_schemas_of_this_version() -> None:
    assert set(SCHEMAS) == {"condition", "datum", "event", "list", "measure", "measured", "report", "status"}
    for name, schema in SCHEMAS.items():
        Draft202012Validator.check_schema(schema)
        assert schema["$id"] == f"urn:rass-mav:interface:{INTERFACE}:{name}"
    assert set(SCHEMAS["measure"]["properties"]["unit"]["enum"]) == STATED.keys()


def test_some_of_everything_is_what_the_schemas_say(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status = NodeStatus(3, 1, 2, None, 0.5, 2, 88, (47.5, 8.25), {1: 0.9, 3: 0.5}, {7: 1}, next_hop=1)
    data = [*mission(), put(200, Kind.STATUS, encode_status(status)), put(201, 33, b"of a later version")]
    path = stored(tmp_path / "rass-1.db", data)
    done = command(tmp_path, "ls", path.name, "--json")
    listed = json.loads(done.stdout)
    check("list", listed)
    kinds = {datum["kind"] for datum in listed["data"]}
    assert {"measurement", "file", "bytes", "status", 33} <= kinds
    for datum in listed["data"]:
        check("datum", datum)
        assert list(unnamed(SCHEMAS["datum"], datum)) == []
    with archive(path) as opened:
        watch = Watch.of(opened)
        report = json.loads(json.dumps(watch.plain(NOW, opened.date)))
    check("report", report)
    assert report["attention"]
    assert watch.events()
    for condition in report["attention"]:
        assert list(unnamed(SCHEMAS["condition"], condition)) == []
    for event in watch.events():
        check("event", event.plain())
        assert list(unnamed(SCHEMAS["event"], event.plain())) == []
    # What is new in the output must be added to the schema.
    assert list(unnamed(SCHEMAS["report"], report)) == []


@pytest.mark.parametrize(
    ("name", "spoil"),
    [
        ("datum", lambda datum: datum.pop("id")),
        ("datum", lambda datum: datum.update(hops=-1)),
        ("datum", lambda datum: datum.update(created="yesterday")),
        ("datum", lambda datum: datum["measurement"].update(unit="mR/h")),
        ("datum", lambda datum: datum["measurement"].pop("reading")),
        ("report", lambda report: report.pop("drones")),
        ("report", lambda report: report["drones"][0].update(missing=None)),
    ],
)
def test_the_schemas_notice_what_would_break_a_program(tmp_path: Path, name: str, spoil: Callable[[Any], Any]) -> None:
    with archive(stored(tmp_path / "rass-1.db", mission())) as opened:
        datum = next(entry.plain() for entry in opened.entries() if entry.measurement is not None)
        value = json.loads(json.dumps({"datum": datum, "report": Watch.of(opened).plain(NOW, opened.date)}[name]))
    check(name, value)
    spoil(value)
    with pytest.raises(ValidationError):
        check(name, value)


def test_what_real_nodes_say_is_what_the_schemas_say(tmp_path: Path, tidy: Tidy) -> None:
    vehicle, first, second = free_ports(3)
    base = tidy(
        RunningNode(
            tmp_path, 1, node={"role": "base"},
            links=[{"listen": f"127.0.0.1:{first}", "peers": [{"id": 7, "address": f"127.0.0.1:{second}"}]}],
        )
    ).start()  # fmt: skip
    drone = tidy(
        RunningNode(
            tmp_path, 7, autopilot={"url": f"udpin:127.0.0.1:{vehicle}"}, sensor={"type": "program"},
            links=[{"listen": f"127.0.0.1:{second}", "peers": [{"id": 1, "address": f"127.0.0.1:{first}"}]}],
            data={"interval_steps": 4, "status_s": 0.5},
        )
    ).start()  # fmt: skip
    check("status", drone.status())
    (tmp_path / "note.txt").write_bytes(b"small")
    (tmp_path / "photo.jpg").write_bytes(os.urandom(100_000))
    for arguments in (["--line", "all well", "--priority", "9", "--ttl", "2h"], ["note.txt"], ["photo.jpg"]):
        assert command(tmp_path, "put", "-c", "n7.yaml", *arguments).returncode == 0
    readings: list[dict[str, Any]] = [
        {"value": 0.25, "unit": "uSv/h"},
        {"value": 0.5, "unit": "\u00b5Sv/h", "time": time.time()},
        {"value": 1, "unit": "mSv/h", "latitude": -35.5, "longitude": 149.25, "altitude": 584.5},
    ]
    refused: list[dict[str, Any]] = [
        {"value": -1, "unit": "uSv/h"},
        {"value": 1, "unit": "mR/h"},
        {"unit": "uSv/h"},
        {"value": 1},
    ]
    refused += [{"value": 1, "unit": "uSv/h", "latitude": 1.0}, {"value": 1, "unit": "uSv/h", "tiem": 1}]
    lines = "".join(f"{json.dumps(reading)}\n" for reading in [*readings, *refused]).encode()
    done = command(tmp_path, "measure", "-c", "n7.yaml", "--follow", stdin=lines)
    answers = [json.loads(line) for line in done.stdout.splitlines()]
    assert [answer["ok"] for answer in answers] == [True] * len(readings) + [False] * len(refused)
    answers.append(json.loads(command(tmp_path, "measure", "1", "--unit", "uSv/h", "-c", "n7.yaml", "--json").stdout))
    for answer in answers:
        check("measured", answer)
    for reading in readings:
        check("measure", reading)
    for reading in refused:
        with pytest.raises(ValidationError):
            check("measure", reading)

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as autopilot:

        def placed() -> bool:
            for message in (
                autopilot_heartbeat(), global_position_int(48.5, 2.25, 330.0, 300.0, 1000),
                named_value_float("RAD", 1.0, 1000),
            ):  # fmt: skip
                autopilot.sendto(FrameWriter(42, 1).message(message), ("127.0.0.1", vehicle))
            status = drone.status()
            return bool(status["position"] and status["ignored_readings"] and status["hop_count"] == 1)

        drone.until(placed)
    with said_by(tmp_path, "ls", "n1.yaml", "--follow", "--json") as followed:
        wanted = {"measurement", "file", "bytes", "status"}
        while wanted:
            datum = json.loads(next(followed))
            check("datum", datum)
            assert list(unnamed(SCHEMAS["datum"], datum)) == []
            wanted.discard(datum["kind"])
    for node in (drone, base):
        status = json.loads(command(tmp_path, "status", node.config, "--json").stdout)
        check("status", status)
        # A new field must be described in the schema, from which docs/reference/status.md is made.
        assert list(unnamed(SCHEMAS["status"], status)) == []
    check("list", json.loads(command(tmp_path, "ls", "n1.yaml", "--json").stdout))
    report = json.loads(command(tmp_path, "report", "n1.yaml", "--json").stdout)
    check("report", report)
    assert list(unnamed(SCHEMAS["report"], report)) == []
    assert not report["drone_store"]
    # What the drone has handed over counts as missing in its own store.
    card = json.loads(command(tmp_path, "report", "n7.yaml", "--json").stdout)
    assert card["missing"]
    assert card["drone_store"]
    for node in (drone, base):
        assert node.signal(signal.SIGTERM) == 0


# -- the programs ------------------------------------------------------------------------------------------------------

PLACE = {"latitude": 47.5, "longitude": 8.25, "altitude": 400.0}


def datum(number: int, reading: float | None, unit: str = "usvh", place: dict[str, float] | None = None) -> str:
    measurement = {
        **(place or dict.fromkeys(PLACE)), "reading": reading, "unit": unit,
        "risk": 0.5, "local": None, "error_m": None,
    }  # fmt: skip
    whole = {
        "id": f"7-0123abcd-{number}", "kind": "measurement", "size": 21, "hops": 1, "created": 1.8e9,
        "utc": "2027-01-15T08:00:00.000Z", "age_s": 3.0, "measurement": measurement,
    }  # fmt: skip
    check("datum", whole)
    return json.dumps(whole) + "\n"


def text_datum() -> str:
    return (
        json.dumps({"id": "9-0123abcd-1", "kind": "bytes", "size": 2, "hops": 1, "created": 1.8e9, "age_s": 3.0}) + "\n"
    )


@contextmanager
def program(name: str, *arguments: str, path: Path | None = None) -> Iterator[subprocess.Popen[str]]:
    env = environment(**({} if path is None else {"PYTHONPATH": str(path)}))
    with subprocess.Popen(
        [sys.executable, str(ROOT / "docs/examples" / name), *arguments], env=env, text=True,
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    ) as running:  # fmt: skip
        try:
            yield running
        finally:
            running.kill()


def done(running: subprocess.Popen[str], lines: Iterable[str]) -> str:
    """What it prints about these lines, when it has ended well."""
    said, errors = running.communicate("".join(lines), timeout=PATIENCE_S)
    assert (running.returncode, errors) == (0, "")
    return said


def test_they_are_short() -> None:
    assert [path.stem for path in EXAMPLES] == ["mqtt_bridge", "producer", "ros2_bridge", "subscriber"]
    for path in EXAMPLES:
        assert len(path.read_text(encoding="utf-8").splitlines()) < 40, path


def test_the_subscriber_tells_of_high_readings() -> None:
    lines = [
        text_datum(), datum(1, 0.5, place=PLACE), datum(2, 2.5, place=PLACE), datum(3, 99.0, "cpm"), datum(4, None),
        datum(5, 7.0),
    ]  # fmt: skip
    with program("subscriber.py", "1.0") as running:
        assert done(running, lines).splitlines() == [
            "drone 7: 2.5 uSv/h at 47.500000 8.250000, 2027-01-15T08:00:00.000Z",
            "drone 7: 7 uSv/h at an unknown place, 2027-01-15T08:00:00.000Z",
        ]


def test_the_producer_hands_in_and_says_what_was_refused(tmp_path: Path, tidy: Tidy) -> None:
    (port,) = free_ports(1)
    link = {"listen": f"127.0.0.1:{port}", "peers": [{"address": "127.0.0.1:9"}]}
    node = tidy(RunningNode(tmp_path, 7, links=[link], sensor={"type": "program"})).start()
    with program("producer.py", os.path.relpath(tmp_path / "n7.sock")) as running:
        said, errors = running.communicate("0.25\n0,25\n-1\n0.5\n", timeout=PATIENCE_S)
    assert (running.returncode, said) == (0, "")
    assert errors.splitlines() == [
        "0,25: could not convert string to float: '0,25'",
        "-1: not a request: value: expected a number >= 0, got -1.0",
    ]
    status = node.status()
    assert (status["reading"]["value"], status["handed_in"]["readings"]) == (0.5, 2)


def test_the_producer_submits_again_what_got_no_answer(tmp_path: Path) -> None:
    heard = []
    with socket.socket(socket.AF_UNIX) as node:
        node.bind(os.path.relpath(tmp_path / "n.sock"))
        node.listen()
        node.settimeout(PATIENCE_S)
        with program("producer.py", os.path.relpath(tmp_path / "n.sock")) as running:
            assert running.stdin is not None
            began = time.time()
            running.stdin.write("0.25\n")
            running.stdin.flush()
            for answer in (b"", b'{"ok": true}\n'):
                client, _ = node.accept()
                with client, client.makefile("rb") as requests:
                    heard.append((json.loads(requests.readline()), time.time()))
                    client.sendall(answer)
            assert done(running, []) == ""
    (first, heard_at), (second, _) = heard
    assert first == {"command": "measure", "value": 0.25, "unit": "uSv/h"}
    assert began <= second.pop("time") <= heard_at
    assert second == first


class Broker:
    """As much of an MQTT 3.1.1 broker as a publisher needs (docs.oasis-open.org/mqtt/mqtt/v3.1.1)."""

    def __init__(self) -> None:
        self.published: list[tuple[str, str]] = []
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port = self._server.getsockname()[1]
        self.thread = threading.Thread(target=self._serve)
        self.thread.start()

    def _serve(self) -> None:
        client, _ = self._server.accept()
        with client, self._server, client.makefile("rb") as stream:
            client.settimeout(PATIENCE_S)
            while head := stream.read(1):
                size, shift = 0, 0
                while (more := stream.read(1)[0]) & 0x80:
                    size, shift = size | (more & 0x7F) << shift, shift + 7
                body = stream.read(size | more << shift)
                kind = head[0] >> 4
                if kind == 1:  # CONNECT
                    client.sendall(b"\x20\x02\x00\x00")
                elif kind == 3:  # PUBLISH with QoS 1
                    assert head[0] & 0x06 == 0x02
                    (length,) = struct.unpack_from(">H", body)
                    topic, number, payload = body[2 : 2 + length], body[2 + length : 4 + length], body[4 + length :]
                    self.published.append((topic.decode(), payload.decode()))
                    client.sendall(b"\x40\x02" + number)
                elif kind == 12:  # PINGREQ
                    client.sendall(b"\xd0\x00")


def test_the_bridge_to_mqtt_publishes_each_datum() -> None:
    broker = Broker()
    lines = [datum(1, 0.5, place=PLACE), text_datum()]
    with program("mqtt_bridge.py", f"127.0.0.1:{broker.port}") as running:
        assert done(running, lines) == ""
    broker.thread.join(PATIENCE_S)
    assert broker.published == [("rass/7/measurement", lines[0].strip()), ("rass/9/bytes", lines[1].strip())]


def test_the_bridge_to_mqtt_says_that_there_is_no_broker() -> None:
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{unused.getsockname()[1]}"
        with program("mqtt_bridge.py", address) as running:
            said, errors = running.communicate("", timeout=PATIENCE_S)
    assert (running.returncode, said) == (1, "")
    assert errors == f"{address}: no broker: [Errno 111] Connection refused\n"


#: ROS 2 is no Python package that a test could install. This has the few names that the bridge uses, and prints.
RCLPY = """
class Publisher:
    def __init__(self, kind, topic, depth):
        self.kind, self.topic = kind, topic
    def publish(self, message):
        assert type(message) is self.kind
        print(self.kind.__name__, self.topic, sorted(vars(message).items()), flush=True)
class Node:
    def create_publisher(self, kind, topic, depth):
        return Publisher(kind, topic, depth)
def init(): pass
def create_node(name): return Node()
"""
MESSAGE = """
class {}:
    def __init__(self, **fields):
        assert set(fields) <= {{{}}}
        self.__dict__.update(fields)
"""


def test_the_bridge_to_ros_2_publishes_data_readings_and_places(tmp_path: Path) -> None:
    for package in ("std_msgs", "sensor_msgs"):
        (tmp_path / package).mkdir()
        (tmp_path / package / "__init__.py").touch()
    (tmp_path / "rclpy.py").write_text(RCLPY)
    (tmp_path / "std_msgs/msg.py").write_text(MESSAGE.format("String", "'data'") + MESSAGE.format("Float64", "'data'"))
    fields = "'header', 'status', 'latitude', 'longitude', 'altitude', 'position_covariance'"
    (tmp_path / "sensor_msgs/msg.py").write_text(MESSAGE.format("NavSatFix", fields))
    lines = [text_datum(), datum(1, 0.5, place=PLACE), datum(2, 20.0, "cpm")]
    with program("ros2_bridge.py", path=tmp_path) as running:
        said = done(running, lines).splitlines()
    assert [line.split(" [")[0] for line in said] == [
        "String rass/data", "String rass/data", "Float64 rass/drone_7/usvh", "NavSatFix rass/drone_7/fix",
        "String rass/data",
    ]  # fmt: skip
    assert said[2].endswith("[('data', 0.5)]")
    assert said[3].endswith("[('altitude', 400.0), ('latitude', 47.5), ('longitude', 8.25)]")


def test_a_stream_that_goes_on_is_told_at_once() -> None:
    with program("subscriber.py", "1.0") as running:
        assert running.stdin is not None
        assert running.stdout is not None
        running.stdin.write(datum(1, 2.5))
        running.stdin.flush()
        ready, _, _ = select.select([running.stdout], [], [], PATIENCE_S)
        assert ready
        assert running.stdout.readline().startswith("drone 7: 2.5 uSv/h")

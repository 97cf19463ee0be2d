"""Real `rass-mav run` processes over UDP on this host."""

from __future__ import annotations

import json
import math
import os
import signal
import socket
import stat
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from rass_mav.lab.swarm.autopilot import autopilot_heartbeat
from rass_mav.mavlink.frames import FrameReader, FrameWriter
from tests.environment import environment
from tests.patience import PATIENCE_S
from tests.telemetry import global_position_int, named_value_float

from .app_nodes import RunningNode, Tidy, command, free_ports, line_of, process, said_by

STATUSTEXT = 253
HEARTBEAT = 0


def put(node: RunningNode, payload: bytes) -> str:
    return str(node.ask("put", payload=payload)["id"])


@pytest.mark.processes_measured
def test_what_is_put_at_the_far_end_of_a_line_arrives_at_the_base(tmp_path: Path, tidy: Tidy) -> None:
    base, middle, far = (tidy(node).start() for node in line_of(tmp_path, [1, 2, 3]))
    photo = os.urandom(5000)
    (tmp_path / "photo.jpg").write_bytes(photo)

    said = command(tmp_path, "put", "-c", "n3.yaml", "--line", "all well")
    assert (said.returncode, said.stderr) == (0, b"")
    line_id = said.stdout.decode().strip()
    said = command(tmp_path, "put", "-c", "n3.yaml", "photo.jpg", "--json", "--priority", "1", "--ttl", "1.5h")
    photo_id = json.loads(said.stdout)["id"]
    said = process(tmp_path, "put", "-c", "n3.yaml", "-", stdin=b"\0\xff stdin\n")
    stdin_id = said.stdout.decode().strip()

    base.until(lambda: {line_id, photo_id, stdin_id} <= set(base.listing()))
    assert command(tmp_path, "get", "-c", "n1.yaml", line_id).stdout == b"all well"
    assert command(tmp_path, "get", "-c", "n1.yaml", stdin_id).stdout == b"\0\xff stdin\n"
    said = command(tmp_path, "get", "-c", "n1.yaml", photo_id, "-o", "copy.jpg", "--json")
    assert (tmp_path / "copy.jpg").read_bytes() == photo
    assert json.loads(said.stdout)["name"] == "photo.jpg"

    listed = json.loads(command(tmp_path, "ls", "n1.yaml", "--json").stdout)["data"]
    assert {(e["id"], e["kind"], e["hops"]) for e in listed} == {
        (line_id, "bytes", 2), (photo_id, "file", 2), (stdin_id, "bytes", 2),
    }  # fmt: skip
    assert {e["id"]: (e["priority"], e["ttl_s"], e["size"]) for e in listed if "priority" in e} == {
        photo_id: (1, 5400, 5000 + len("photo.jpg") + 1)
    }
    assert "file photo.jpg (priority 1, ttl 5400 s)\n" in command(tmp_path, "ls", "n1.yaml").stdout.decode()

    # On a busy machine a beacon may be late, and a neighbour gone for a moment.
    middle.until(lambda: [n["node_id"] for n in middle.status()["neighbours"]] == [1, 3])
    status: dict[str, Any] = {}
    # An unknown risk is the worst, so a way of two hops costs 2 (0.05 - log(1 - 0.999)); data that wait cost more.
    cost = 2 * (0.05 - math.log(0.001))

    def has_route() -> bool:
        status.update(far.status())
        return bool(status["hop_count"] == 2 and status["cost"] == pytest.approx(cost, abs=1e-5))

    far.until(has_route)
    assert (status["hop_count"], status["next_hop"], status["role"]) == (2, 2, "drone")
    assert [n["node_id"] for n in status["neighbours"]] == [2]
    assert status["links"][0]["sent"] > 0
    assert status["malformed"] == 0
    base.until(lambda: far.status()["store"]["items"] == 0)
    human = command(tmp_path, "status", "n3.yaml").stdout.decode()
    assert f"\nnode 3 (drone), epoch {status['epoch']}" in f"\n{human}"

    for node in (base, middle, far):
        assert node.signal(signal.SIGTERM) == 0
        assert "Traceback" not in node.log()
        assert not (tmp_path / f"{node.name}.sock").exists()


def test_what_was_answered_survives_kill_9(tmp_path: Path, tidy: Tidy) -> None:
    base, middle, far = (tidy(node) for node in line_of(tmp_path, [1, 2, 3]))
    middle.start()
    far.start()
    sent = {}
    for number in range(10):
        payload = b"at the middle %d" % number
        sent[put(middle, payload)] = payload
    # The moment after the last answer.
    assert middle.signal(signal.SIGKILL) == -signal.SIGKILL
    assert (tmp_path / "n2.sock").exists(), "a killed node leaves its socket file behind"
    for number in range(5):
        payload = b"at the far end %d " % number + os.urandom(300)
        sent[put(far, payload)] = payload
    middle.start()
    base.start()
    base.until(lambda: set(base.listing()) >= set(sent))
    # And once more, while data are on their way through it.
    for number in range(5):
        payload = b"under way %d" % number
        sent[put(far, payload)] = payload
    middle.signal(signal.SIGKILL)
    middle.start()
    base.until(lambda: set(base.listing()) >= set(sent))
    assert {id: base.content(id) for id in base.listing()} == sent
    epochs = {id.split("-")[1] for id in sent}
    assert len(epochs) == 2, "a restarted node goes on in its store's epoch"
    for node in (base, middle, far):
        assert node.signal(signal.SIGTERM) == 0


@pytest.mark.processes_measured
def test_a_measurement_carries_what_the_autopilot_says(tmp_path: Path, tidy: Tidy) -> None:
    (vehicle, peer, listen) = free_ports(3)
    drone = tidy(
        RunningNode(
            tmp_path,
            7,
            autopilot={"url": f"udpin:127.0.0.1:{vehicle}"},
            links=[{"listen": f"127.0.0.1:{listen}", "peers": [{"address": f"127.0.0.1:{peer}"}]}],
            risk={"low": 0, "high": 100},
            data={"interval_steps": 1},
            store={"capacity_items": 1000},
        )
    ).start()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as autopilot:
        autopilot.settimeout(PATIENCE_S)
        autopilot.bind(("127.0.0.1", 0))
        writer = FrameWriter(42, 1)

        def fly() -> bool:
            for message in (
                autopilot_heartbeat(),
                global_position_int(48.8584, 2.2945, 330.0, relative_altitude=300.0, boot_ms=1000),
                named_value_float("RAD", 25.0, 1000),
            ):
                autopilot.sendto(writer.message(message), ("127.0.0.1", vehicle))
            entries = drone.listing().values()
            return any(entry.reading == 25.0 and entry.place is not None for entry in entries)

        drone.until(fly)
        heard = FrameReader().feed(autopilot.recv(300))
        assert [frame.message_id for frame in heard] == [HEARTBEAT]
        # The node takes over the autopilot's system id, as a companion should.
        drone.until(lambda: fly() and FrameReader().feed(autopilot.recv(300))[0].system_id == 42)
        assert heard[0].component_id == 191
    status = drone.status()
    assert status["autopilot"]["system_id"] == 42
    assert status["reading"]["value"] == 25.0
    assert status["position"]["latitude"] == pytest.approx(48.8584)
    assert (status["risk"], status["risk_known"]) == (0.25, True)
    listed = command(tmp_path, "ls", "n7.yaml").stdout.decode().splitlines()
    assert any("reading 25, risk 0.250, at 48.8584000 2.2945000 330.0 m" in line for line in listed)
    assert drone.signal(signal.SIGINT) == 0


def test_a_second_node_under_the_same_id_is_reported(tmp_path: Path, tidy: Tidy) -> None:
    first_port, second_port = free_ports(2)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ground:
        ground.settimeout(PATIENCE_S)
        ground.bind(("127.0.0.1", 0))
        first = tidy(
            RunningNode(
                tmp_path, 5, "first",
                autopilot={"url": f"udpout:127.0.0.1:{ground.getsockname()[1]}"},
                links=[{"listen": f"127.0.0.1:{first_port}", "peers": [{"address": f"127.0.0.1:{second_port}"}]}],
            )
        ).start()  # fmt: skip
        rival = tidy(
            RunningNode(
                tmp_path, 5, "rival",
                links=[{"listen": f"127.0.0.1:{second_port}", "peers": [{"address": f"127.0.0.1:{first_port}"}]}],
            )
        ).start()  # fmt: skip
        reader = FrameReader()
        texts = b""
        while b"node id 5" not in texts:
            for frame in reader.feed(ground.recv(300)):
                if frame.message_id == STATUSTEXT:
                    assert frame.payload[0] == 2, "MAV_SEVERITY_CRITICAL"
                    texts += frame.payload[1:51]
    assert texts.startswith(b"RASS: two nodes have node id 5")
    assert "two nodes have node id 5" in first.log()
    assert [r["life"] for r in first.status()["rivals"]] == [rival.about["life"]]
    first.signal(signal.SIGTERM)
    rival.signal(signal.SIGTERM)


def fails(tmp_path: Path, config: str, code: int) -> str:
    said = process(tmp_path, "run", config)
    assert said.returncode == code
    assert said.stdout == b""
    lines = said.stderr.decode().splitlines()
    assert len(lines) == 1, lines
    return lines[0]


def test_what_is_in_use_is_one_line_and_exit_code_1(tmp_path: Path, tidy: Tidy) -> None:
    port, other, vehicle = free_ports(3)
    links = [{"listen": f"127.0.0.1:{port}", "peers": [{"address": f"127.0.0.1:{other}"}]}]
    first = tidy(RunningNode(tmp_path, 1, links=links)).start(forked=False)
    RunningNode(tmp_path, 2, links=links)
    assert first.process is not None
    said = fails(tmp_path, "n2.yaml", 1)
    assert said.startswith(f"udp:127.0.0.1:{port}: address already in use by process {first.process.pid} (")
    assert "rass_mav run n1.yaml" in said
    assert said.endswith(f"rass-mav status CONFIG; or another program? ss -lunp 'sport = :{port}'")

    elsewhere = [{**links[0], "listen": "127.0.0.1:0"}]
    RunningNode(tmp_path, 3, links=elsewhere, store={"path": "n1.db"})
    assert fails(tmp_path, "n3.yaml", 1).startswith(f"{tmp_path / 'n1.db'}: in use by another node (process ")

    RunningNode(tmp_path, 4, links=elsewhere, control={"socket": "n1.sock"})
    assert fails(tmp_path, "n4.yaml", 1) == f"{tmp_path / 'n1.sock'}: another node is running there"

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", vehicle))
        RunningNode(tmp_path, 5, links=elsewhere, autopilot={"url": f"udpin:127.0.0.1:{vehicle}"})
        said = fails(tmp_path, "n5.yaml", 1)
        assert said.startswith(f"udpin:127.0.0.1:{vehicle}: address already in use by process {os.getpid()} (")

    RunningNode(tmp_path, 6, links=elsewhere, policy={"alpha": "ten"})
    assert fails(tmp_path, "n6.yaml", 2) == "n6.yaml: policy.alpha: expected a number >= 0, got 'ten'"

    RunningNode(tmp_path, 7, links=elsewhere, store={"path": "nowhere/n7.db"})
    assert fails(tmp_path, "n7.yaml", 1).startswith(f"{tmp_path / 'nowhere/n7.db'}")
    assert stat.S_IMODE((tmp_path / "n1.sock").stat().st_mode) == 0o600


def test_status_can_be_watched_an_object_a_line(tmp_path: Path, tidy: Tidy) -> None:
    node = tidy(RunningNode(tmp_path, 1, node={"role": "base"}, links=[])).start()
    with said_by(tmp_path, "status", "n1.yaml", "--watch", "--json") as lines:
        first, second = (json.loads(next(lines)) for _ in range(2))
    assert first["node_id"] == second["node_id"] == 1
    assert second["uptime_s"] > first["uptime_s"]
    assert node.signal(signal.SIGTERM) == 0


def test_a_reader_that_has_seen_enough_does_no_harm(tmp_path: Path, tidy: Tidy) -> None:
    node = tidy(RunningNode(tmp_path, 1, node={"role": "base"}, links=[])).start()
    for number in range(200):
        put(node, b"%d" % number)
    read, write = os.pipe()
    listing = subprocess.Popen(
        [sys.executable, "-m", "rass_mav", "ls", "n1.yaml"],
        cwd=tmp_path, env=environment(), stdout=write, stderr=subprocess.PIPE,
    )  # fmt: skip
    os.close(write)
    os.close(read)
    _, errors = listing.communicate(timeout=PATIENCE_S)
    assert errors == b""
    assert listing.returncode == 1
    assert len(node.listing()) == 200
    assert node.signal(signal.SIGTERM) == 0


@pytest.mark.processes_measured
def test_a_store_that_is_rubbish_is_set_aside_and_the_ground_is_told(tmp_path: Path, tidy: Tidy) -> None:
    node = RunningNode(tmp_path, 1, node={"role": "base"}, links=[])
    (tmp_path / "n1.db").write_bytes(b"rubbish" * 1000)
    tidy(node).start()
    assert (tmp_path / "n1.db.damaged-1").read_bytes() == b"rubbish" * 1000
    assert "RASS: damaged store set aside (n1.db.damaged-1)" in node.log()
    assert put(node, b"on it goes") in node.listing()
    assert node.signal(signal.SIGTERM) == 0


@pytest.mark.processes_measured
def test_what_a_running_node_refuses_is_one_line(tmp_path: Path, tidy: Tidy) -> None:
    node = tidy(RunningNode(tmp_path, 1, node={"role": "base"}, links=[])).start()
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as raw:
        raw.settimeout(PATIENCE_S)
        raw.connect(os.path.relpath(node.directory / "n1.sock"))
        answers = raw.makefile("rb")
        mistakes = ('"priority": 10', '"priority": -1', '"ttl_s": 0', '"ttl_s": 1e99', '"kind": 64')
        for line in (
            b"rubbish", b"{}", b"\xff\x00", b'{"command": "fly"}', b'{"command": "put", "payload": "?"}',
            *(b'{"command": "put", "payload": "eA==", %s}' % mistake.encode() for mistake in mistakes),
        ):  # fmt: skip
            raw.sendall(line + b"\n")
            answer = json.loads(answers.readline())
            assert answer["ok"] is False
            assert answer["error"].startswith("not a request: ")
        answers.close()
    said = command(tmp_path, "get", "-c", "n1.yaml", "1-00000000-0", "--json")
    missing = f"1-00000000-0: not in {tmp_path / 'n1.db'}"
    assert (said.returncode, said.stderr) == (1, f"{missing}\n".encode())
    assert json.loads(said.stdout) == {"error": [missing]}
    assert command(tmp_path, "get", "-c", "n1.yaml", "seven").returncode == 2
    (tmp_path / "empty").write_bytes(b"")
    assert command(tmp_path, "put", "-c", "n1.yaml", "-", stdin=b"").returncode == 2
    assert command(tmp_path, "put", "-c", "n1.yaml", "nowhere").stderr == b"nowhere: no such file or directory\n"
    for option, given in (("priority", "10"), ("priority", "-1"), ("ttl", "0s"), ("ttl", "195d"), ("ttl", "5")):
        said = command(tmp_path, "put", "-c", "n1.yaml", "--line", "x", f"--{option}={given}")
        assert (said.returncode, said.stderr.startswith(f"--{option}: expected ".encode())) == (2, True)
    assert command(tmp_path, "status", "--socket", "none.sock").returncode == 1
    assert json.loads(command(tmp_path, "check", "n1.yaml", "--json").stdout)["config"]["node"]["id"] == 1
    usage = command(tmp_path, "put", "-c", "n1.yaml")
    assert usage.returncode == 2
    assert len(usage.stderr.splitlines()) == 1
    for name in ("run", "check", "status", "put", "get", "ls"):
        assert b"example: rass-mav " + name.encode() in command(tmp_path, name, "--help").stdout
    assert node.status()["store"]["items"] == 0
    assert node.signal(signal.SIGTERM) == 0

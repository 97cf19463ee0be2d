"""A node and an autopilot that sign what they send to each other. The autopilot's end is pymavlink alone."""

from __future__ import annotations

import re
import signal
import socket
from pathlib import Path
from typing import Any

import pytest
import yaml
from pymavlink.dialects.v20 import common

from rass_mav.app.config import load_config
from rass_mav.app.signing import KeptTimestamp, last_timestamp, sign, signed_from, signing_key
from rass_mav.errors import ConfigError
from rass_mav.ground.commands.status import status_lines
from rass_mav.link.address import parse_vehicle_url
from rass_mav.link.vehicle import open_vehicle
from rass_mav.mavlink.frames import FrameReader
from rass_mav.mavlink.messages import HEARTBEAT, companion_heartbeat
from rass_mav.mavlink.signedport import SignedPort
from rass_mav.store.memory import MemoryStore
from rass_mav.trust.keys.autopilot import autopilot_key
from rass_mav.trust.keys.keyring import Keyring
from tests.agent.agent_net import GROUND, agent_with_keys
from tests.agent.picture import picture
from tests.mavlink import pymav
from tests.mock_vehicle import MockVehicle
from tests.store.store_helpers import open_store

from .app_nodes import RunningNode, Tidy, command, free_ports

OWN = GROUND.node(7, 1)
KEY = signing_key(Keyring(OWN, None))
AUTOPILOT_KEY = autopilot_key(OWN.secret).reveal()
BEGIN = 37_000_000_000_000
LINKS = [{"listen": "127.0.0.1:0", "peers": [{"address": "127.0.0.1:9"}]}]


def says(mav: Any, message: Any) -> bytes:
    return bytes(message.pack(mav))


HEARTBEAT_OF_ITS = common.MAVLink_heartbeat_message(2, 3, 0, 0, 3, 3)
POSITION = common.MAVLink_global_position_int_message(1000, 488584000, 22945000, 35000, 0, 0, 0, 0, 0)
ELSEWHERE = common.MAVLink_global_position_int_message(2000, 0, 900000000, 35000, 0, 0, 0, 0, 0)
READING = common.MAVLink_named_value_float_message(3000, b"RAD", 1e6)


def test_what_is_forged_repeated_unsigned_or_late_changes_nothing() -> None:
    agent = agent_with_keys(7, mavlink={"system_id": 1}, data={"interval_steps": 0})
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as end:
        end.bind(("127.0.0.1", 0))
        vehicle = open_vehicle(parse_vehicle_url(f"udpout:127.0.0.1:{end.getsockname()[1]}"))
        sign(agent, vehicle, SignedPort(KEY, BEGIN))
        vehicle.close()
    autopilot = pymav.sender(1, 1, 0, (AUTOPILOT_KEY, 2, BEGIN + 60))
    recorded = [says(autopilot, message) for message in (HEARTBEAT_OF_ITS, ELSEWHERE, POSITION)]
    for frame in recorded:
        agent.vehicle_bytes(frame, 1.0)
    assert agent.telemetry.position is not None
    assert agent.telemetry.position.latitude == pytest.approx(48.8584)

    def state() -> object:
        return picture([agent, agent.node, agent.store, agent.telemetry], without=(FrameReader,))

    before = state()
    bad = [
        *recorded,
        *(says(pymav.sender(1, 1), message) for message in (HEARTBEAT_OF_ITS, ELSEWHERE, READING)),
        says(pymav.sender(1, 1, 0, (bytes(32), 2, BEGIN + 1000)), ELSEWHERE),
        says(pymav.sender(1, 1, 0, (AUTOPILOT_KEY, 2, BEGIN + 1)), ELSEWHERE),
        says(pymav.sender(1, 1, 0, (AUTOPILOT_KEY, 3, BEGIN - 1)), READING),
    ]
    for frame in bad:
        agent.vehicle_bytes(frame, 2.0)
    assert state() == before
    check = agent.vehicle_reader.check
    assert isinstance(check, SignedPort)
    assert (check.unsigned, check.forged, check.old) == (3, 1, 5)
    agent.vehicle_bytes(says(autopilot, READING), 3.0)
    assert agent.last_reading is not None


def test_frames_are_signed_in_the_order_in_which_they_leave() -> None:
    """Some wait for the disk, and others overtake them."""
    agent = agent_with_keys(7)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as end:
        end.bind(("127.0.0.1", 0))
        end.settimeout(5.0)
        vehicle = open_vehicle(parse_vehicle_url(f"udpout:127.0.0.1:{end.getsockname()[1]}"))
        sign(agent, vehicle, SignedPort(KEY, BEGIN))
        frames = [agent.vehicle_writer.message(companion_heartbeat()) for _ in range(3)]
        autopilot = pymav.sender(1, 1, 0, (AUTOPILOT_KEY, 2, BEGIN))
        for frame in reversed(frames):
            vehicle.send(frame)
            assert autopilot.decode(bytearray(end.recv(300))).get_signed()
        vehicle.close()


def test_the_store_keeps_the_timestamp_once_a_minute_and_at_the_end(tmp_path: Path) -> None:
    path = tmp_path / "n.db"
    assert last_timestamp(path) == 0
    store = open_store(path)
    signing = signed_from(store, KEY)
    kept = KeptTimestamp(store, signing)
    times = []
    for now in range(150):
        signing.sign(b"\xfd" + bytes(11))
        kept.step(float(now))
        times.append(store.get_meta("autopilot_timestamp"))
    assert times == [1] * 60 + [61] * 60 + [121] * 30
    kept.note()
    store.close()
    assert last_timestamp(path) == 150
    store = open_store(path)
    assert signed_from(store, KEY).next == 150
    store.close()


def test_a_fresh_store_knows_no_timestamp() -> None:
    assert signed_from(MemoryStore(1), KEY).next == 0


@pytest.mark.parametrize(
    ("sections", "said"),
    [
        ({"keys": None}, "needs keys.file, the drone's key file (rass-mav keys drone)"),
        ({"autopilot": {"signing": True}}, "needs autopilot.url"),
        ({"node": {"id": 7, "role": "base"}}, "applies to drones only"),
        (
            {"links": [{"type": "autopilot"}], "mavlink": {"autopilot_id": 7}},
            "such an autopilot does not forward the swarm's frames: give links[0] a radio of its own at this computer "
            "(type udp or serial), or turn signing off (rass-mav params signing --off)",
        ),
    ],
    ids=["no keys", "no autopilot", "a base", "the swarm behind it"],
)
def test_what_does_not_go_with_signing(sections: dict[str, Any], said: str, tmp_path: Path) -> None:
    file = tmp_path / "n.yaml"
    good = {
        "node": {"id": 7}, "autopilot": {"url": "tcp:127.0.0.1:1", "signing": True}, "keys": {"file": "drone-7.keys"},
        "links": LINKS,
    }  # fmt: skip
    file.write_text(yaml.safe_dump(good))
    load_config(file)
    file.write_text(yaml.safe_dump(good | sections))
    with pytest.raises(ConfigError) as caught:
        load_config(file)
    assert caught.value.lines() == [f"{file}: autopilot.signing: {said}"]


def test_a_node_and_its_autopilot_over_restarts_of_both(
    tmp_path: Path, tidy: Tidy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert command(tmp_path, "keys", "new", "m").returncode == 0
    assert command(tmp_path, "keys", "drone", "7", "-d", "m").returncode == 0
    passphrase = command(tmp_path, "keys", "autopilot", "7", "-d", "m").stdout.decode().split("\n")[0]
    [port] = free_ports(1)
    node = RunningNode(
        tmp_path, 7, autopilot={"url": f"udpin:127.0.0.1:{port}", "signing": True}, keys={"file": "m/drone-7.keys"},
        links=LINKS, node={"step_s": 0.2},
    )  # fmt: skip
    vehicle = MockVehicle()
    vehicle.key = pymav.sha256(passphrase)
    vehicle.reading = 5.0
    vehicle.reboot(BEGIN)

    def well() -> bool:
        status = node.status()
        known = status["autopilot"]
        return (
            bool(known)
            and known["signed"]
            and known["version"] == [4, 6, 3]
            and known["heartbeat_age_s"] < 2.0
            and status["reading"] is not None
        )

    with vehicle.on_udp(port):
        tidy(node).start()
        node.until(well)
        before = vehicle.timestamp
        node.signal(signal.SIGKILL)
        node.start()
        node.until(well)
        assert node.status()["vehicle"]["signing"]["forged"] == 0
        # It has saved its timestamp long ago, and is elsewhere.
        vehicle.position = (10.0, 20.0)
        vehicle.reboot(before - 120 * 100_000)
        node.until(lambda: well() and round(node.status()["position"]["latitude"], 4) == 10.0)
        refused = node.status()["vehicle"]["signing"]
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            for _ in range(3):
                stranger.sendto(says(pymav.sender(1, 1), ELSEWHERE), ("127.0.0.1", port))
        node.until(lambda: node.status()["vehicle"]["signing"]["unsigned"] >= refused["unsigned"] + 3)
        status = node.status()
        assert round(status["position"]["longitude"], 4) == 20.0
        [line] = [line for line in status_lines(status) if line.startswith("link udpin:")]
        assert re.search(r"out; signed, ignored \d+ unsigned", line)
    assert passphrase not in node.log()
    assert node.signal(signal.SIGTERM) == 0
    assert last_timestamp(tmp_path / "n7.db") >= before


def test_the_first_frame_on_the_port_is_a_signed_heartbeat() -> None:
    agent = agent_with_keys(7)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as end:
        end.bind(("127.0.0.1", 0))
        vehicle = open_vehicle(parse_vehicle_url(f"udpout:127.0.0.1:{end.getsockname()[1]}"))
        sign(agent, vehicle, SignedPort(KEY, BEGIN))
        vehicle.send(agent.greet_vehicle().frame)
        end.settimeout(5.0)
        frame = end.recv(300)
        vehicle.close()
    reader = FrameReader(SignedPort(KEY, 0))
    assert [heard.message_id for heard in reader.datagram(frame)] == [HEARTBEAT]

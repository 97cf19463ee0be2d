"""An AIRDOS03: messages packed as the README of its firmware lays them out."""

from __future__ import annotations

import signal
import socket
import struct
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.app.config import load_config
from rass_mav.errors import ConfigError, MalformedError
from rass_mav.lab.swarm.autopilot import autopilot_heartbeat
from rass_mav.mavlink.dialect import MavlinkMessage, common
from rass_mav.mavlink.frames import FrameWriter
from rass_mav.sensor.airdos import NOISE, PAYLOAD_TYPE, Airdos, decode_counts
from rass_mav.sensor.base import MAX_WAITING, SensorReading
from rass_mav.sensor.dose import DoseMeter, Tube
from tests.app.app_nodes import RunningNode, Tidy, command, free_ports


def start(cycle: int) -> bytes:
    return struct.pack("<BHH", 0x03, cycle, 1234)


def stop(cycle: int, events: int) -> bytes:
    return struct.pack("<BHIBHHH", 0x04, cycle, 1_764_240_000, 42, 4567, events, min(events, 300))


def hist(cycle: int, kind: int, channels: list[int]) -> bytes:
    return struct.pack("<BH32H", kind, cycle, *channels)


def cycle(number: int, events: int, low: list[int], high: list[int]) -> list[bytes]:
    """The messages of 10 s, in the order in which they are sent."""
    some = [bytes((0x07,)) + struct.pack("<HBBB3xHH", number, 0, 1, 1, 99, 70)] if events else []
    return [start(number), *some, stop(number, events), hist(number, 0x05, low), hist(number, 0x06, high)]


#: Messages of other kinds, with their sizes: STARTUP, TIMESYNC, ENV, ALIVE.
OTHERS = [
    struct.pack("<BBH16sBBBB5s", 0x01, 64, 300, b"0123456789abcdef", 1, 2, 1, 3, b""),
    struct.pack("<BB4I", 0x02, 1, 100, 1_764_240_000, 1_764_240_100, 100),
    struct.pack("<BHIBxff", 0x08, 3, 1_764_240_000, 1, 21.5, 40.0),
    struct.pack("<BIHIIBI", 0x09, 60, 6, 4000, 12, 1, 3),
]
LOW, HIGH = [1000] * NOISE + [2] * (32 - NOISE), [1] * 32


def detector(unit: str = "cpm") -> Airdos:
    return Airdos(DoseMeter(Tube(1.0, 0.0), "cps" if unit == "cps" else "cpm"), lambda: 5.0)


def say(airdos: Airdos, *messages: bytes) -> None:
    for message in messages:
        airdos.tunnel(1, 10, PAYLOAD_TYPE, message)


def test_the_sizes_are_those_of_the_readme() -> None:
    messages = [*OTHERS, start(0), stop(0, 0), hist(0, 5, LOW), hist(0, 6, HIGH)[:67]]
    assert [len(message) for message in messages] == [29, 18, 17, 20, 5, 14, 67, 67]


def test_ten_seconds_of_counts_are_a_reading() -> None:
    airdos = detector()
    assert airdos.state().trouble == "no AIRDOS03 heard at the autopilot's port"
    say(airdos, *OTHERS, *cycle(7, 16, LOW, HIGH))
    # 16 events, 26 channels of 2 and 32 of 1: 100 in 10 s. The noise is left out.
    assert airdos.receive() == [SensorReading(600.0, 5.0)]
    assert airdos.receive() == []
    assert airdos.state() == (True, 1, 0, 0, 0, 1, "")


def test_a_cycle_of_which_a_message_is_lost_is_none() -> None:
    airdos = detector("cps")
    messages = cycle(7, 16, LOW, HIGH)
    say(airdos, *messages[:-1])
    say(airdos, *cycle(8, 0, [0] * 32, [0] * 32))
    assert airdos.receive() == [SensorReading(0.0, 5.0)]
    # The same in another order.
    say(airdos, *reversed(cycle(9, 16, LOW, HIGH)))
    assert airdos.receive() == [SensorReading(10.0, 5.0)]


def test_only_the_detector_is_heard() -> None:
    airdos = detector()
    for message in cycle(7, 16, LOW, HIGH):
        for sender in ((1, 10, 33200), (2, 10, PAYLOAD_TYPE), (1, 1, PAYLOAD_TYPE)):
            airdos.tunnel(*sender, message)
    assert airdos.receive() == []
    assert not airdos.state().connected


def test_a_driver_that_never_comes_costs_little() -> None:
    airdos = detector()
    for number in range(200):
        say(airdos, *cycle(number, 0, [0] * 32, [0] * 32))
    assert len(airdos.receive()) == MAX_WAITING


@given(st.one_of(st.binary(max_size=128), st.sampled_from(range(12)).flatmap(
    lambda kind: st.binary(max_size=127).map(lambda rest: bytes((kind,)) + rest))))  # fmt: skip
def test_any_bytes_are_counts_or_the_one_error(payload: bytes) -> None:
    try:
        found = decode_counts(payload)
    except MalformedError as error:
        assert "\n" not in str(error)  # noqa: PT017
    else:
        assert found is None or found[2] >= 0
    airdos = detector()
    say(airdos, payload)
    assert airdos.receive() == []


def test_messages_that_are_none_are_counted() -> None:
    airdos = detector()
    say(airdos, b"", b"\x04", stop(1, 2) + b"\0", b"\x0a")
    assert airdos.state().malformed == 4
    assert airdos.state().trouble.startswith("expected a message of an AIRDOS03, got ")


DRONE = "node: {id: 7}\nautopilot: {url: 'udpin:127.0.0.1:14550'}\nlinks: [{peers: [{address: '10.0.0.1:14600'}]}]\n"


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (DRONE + "sensor: {type: airdos}", r"sensor\.unit: expected cps or cpm with sensor\.type airdos, or sensor"),
        (DRONE.replace("autopilot:", "ground:") + "sensor: {type: airdos, unit: cps}", "airdos needs autopilot.url"),
        (DRONE + "sensor: {type: airdos, unit: cps, port: a}", "port: has no effect with sensor.type airdos"),
        (
            "node: {id: 7}\nautopilot: {url: 'udpin:127.0.0.1:14550'}\nmavlink: {autopilot_id: 7}\n"
            "links: [{type: autopilot}]\nsensor: {type: airdos, unit: cps}",
            r"airdos cannot be told apart from those of neighbours, whose frames arrive on links\[0\]",
        ),
    ],
)
def test_configurations_in_which_it_would_mislead(tmp_path: Path, text: str, problem: str) -> None:
    path = tmp_path / "node.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=problem):
        load_config(path)


def tunnel(payload: bytes) -> MavlinkMessage:
    return common.MAVLink_tunnel_message(1, 1, PAYLOAD_TYPE, len(payload), list(payload.ljust(128, b"\0")))


def test_a_node_hears_it_at_the_autopilots_port(tmp_path: Path, tidy: Tidy) -> None:
    vehicle, listen = free_ports(2)
    node = tidy(
        RunningNode(
            tmp_path, 7, autopilot={"url": f"udpin:127.0.0.1:{vehicle}"},
            links=[{"listen": f"127.0.0.1:{listen}", "peers": [{"address": "127.0.0.1:9"}]}],
            sensor={"type": "airdos", "unit": "usvh", "cpm_per_usvh": 6000}, risk={"low": 0, "high": 0.4},
        )
    ).start()  # fmt: skip
    numbers = iter(range(1 << 16))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:

        def heard() -> bool:
            number = next(numbers)
            # As it comes from a vehicle with another id: the autopilot passes on what the detector has sent.
            for message in (autopilot_heartbeat(),):
                sock.sendto(FrameWriter(42, 1).message(message), ("127.0.0.1", vehicle))
            for payload in cycle(number, 16, LOW, HIGH):
                sock.sendto(FrameWriter(1, 10).message(tunnel(payload)), ("127.0.0.1", vehicle))
            return node.status()["reading"] is not None

        node.until(heard)
    status = node.status()
    assert (status["reading"]["value"], status["reading"]["unit"]) == (pytest.approx(0.1), "usvh")
    assert status["risk"] == pytest.approx(0.25)
    assert (status["sensor"]["malformed"], status["sensor"]["trouble"]) == (0, "")
    assert "sensor airdos: open, " in command(tmp_path, "status", "n7.yaml").stdout.decode()
    assert node.signal(signal.SIGTERM) == 0

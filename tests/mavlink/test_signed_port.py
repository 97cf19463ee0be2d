"""The port of an autopilot with MAVLink signing. The autopilot's end is pymavlink, which has the rules of ArduPilot."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from pymavlink.dialects.v20 import common

from rass_mav.mavlink.frames import FLAG_SIGNED, FrameReader, FrameWriter
from rass_mav.mavlink.messages import HEARTBEAT, companion_heartbeat
from rass_mav.mavlink.signedport import LEEWAY, MAX_STREAMS, MOST, PER_SECOND, SignedPort
from rass_mav.mavlink.signing import SETUP_SIGNING, SigningKey, setup_signing

from . import pymav

KEY = SigningKey(pymav.KEY)
BEGIN = 37_000_000_000_000


class Node:
    """Our end: what a node writes and reads."""

    def __init__(self, start: int = 0, key: bytes = pymav.KEY) -> None:
        self.port = SignedPort(SigningKey(key), start)
        self.reader = FrameReader(self.port)
        self.writer = FrameWriter(1, 191)
        self.writer.flags = FLAG_SIGNED

    def says(self) -> bytes:
        return self.port.sign(self.writer.message(companion_heartbeat()))

    def hears(self, frame: bytes) -> bool:
        return bool(self.reader.datagram(frame))

    @property
    def refused(self) -> tuple[int, int, int]:
        return self.port.unsigned, self.port.forged, self.port.old


class Autopilot:
    """Their end. `saved` is the timestamp on its disk."""

    def __init__(self, saved: int = BEGIN, *, link: int = 2, component: int = 1, key: bytes = pymav.KEY) -> None:
        self.mav = pymav.sender(1, component, 0, (key, link, 0))
        self.boot(saved)

    def boot(self, saved: int) -> None:
        """ArduPilot goes on a minute above what it has saved, and has forgotten whom it has heard."""
        self.mav.signing.timestamp = saved + 60 * PER_SECOND
        self.mav.signing.stream_timestamps = {}

    def says(self) -> bytes:
        return bytes(common.MAVLink_heartbeat_message(2, 3, 0, 0, 3, 3).pack(self.mav))

    def hears(self, frame: bytes) -> bool:
        try:
            return bool(self.mav.decode(bytearray(frame)).get_signed())
        except common.MAVError:
            return False

    @property
    def timestamp(self) -> int:
        return int(self.mav.signing.timestamp)


def test_a_node_follows_an_autopilot_whose_clock_is_a_minute_or_years_ahead() -> None:
    for saved in (0, BEGIN, MOST // 2):
        node, autopilot = Node(), Autopilot(saved)
        # Not yet: it is more than a minute behind, unless both begin at 0.
        assert autopilot.hears(node.says()) == (saved == 0)
        assert node.hears(autopilot.says())
        for _ in range(300):
            assert autopilot.hears(node.says())
            assert node.hears(autopilot.says())
        assert node.refused == (0, 0, 0)


def test_the_frames_are_those_of_pymavlink() -> None:
    node = Node(BEGIN)
    theirs = pymav.sender(1, 191, 0, (pymav.KEY, 0, BEGIN))
    for _ in range(3):
        assert node.says() == bytes(common.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3).pack(theirs))
        theirs.seq += 1


def test_a_node_that_starts_again_is_understood_whatever_it_has_kept() -> None:
    node, autopilot = Node(), Autopilot()
    assert node.hears(autopilot.says())
    for _ in range(1000):
        autopilot.hears(node.says())
        node.hears(autopilot.says())
    for start in (0, node.port.next - 900, node.port.next):
        again = Node(start)
        autopilot.hears(again.says())
        assert again.hears(autopilot.says())
        assert autopilot.hears(again.says())
        node = again


@pytest.mark.parametrize("later", [-3 * LEEWAY, -LEEWAY, 0, 5 * LEEWAY])
def test_an_autopilot_that_restarts_with_any_timestamp_is_understood_with_the_next_frames(later: int) -> None:
    node, autopilot = Node(), Autopilot()
    for _ in range(10):
        node.hears(autopilot.says())
        autopilot.hears(node.says())
    autopilot.boot(autopilot.timestamp + later)
    node.hears(autopilot.says())
    assert autopilot.hears(node.says())
    assert node.hears(autopilot.says())


@pytest.mark.parametrize("earlier", [1, LEEWAY // 2, 10 * LEEWAY])
def test_both_restart_and_the_autopilot_has_gone_back(earlier: int) -> None:
    node = Node(BEGIN)
    autopilot = Autopilot(BEGIN - LEEWAY - earlier)
    assert not node.hears(autopilot.says())
    assert autopilot.hears(node.says())
    assert node.hears(autopilot.says())


def unsigned(autopilot: Autopilot) -> bytes:
    return pymav.heartbeat()


def forged(autopilot: Autopilot) -> bytes:
    return Autopilot(autopilot.timestamp, key=bytes(32)).says()


def late(autopilot: Autopilot) -> bytes:
    return Autopilot(autopilot.timestamp - 3 * LEEWAY, link=9).says()


def old(autopilot: Autopilot) -> bytes:
    return Autopilot(autopilot.timestamp - LEEWAY - 100).says()


def from_the_end_of_time(autopilot: Autopilot) -> bytes:
    return Autopilot(MOST).says()


@pytest.mark.parametrize(
    ("frame", "counted"),
    [
        (unsigned, (1, 0, 0)), (forged, (0, 1, 0)), (late, (0, 0, 1)), (old, (0, 0, 1)),
        (from_the_end_of_time, (0, 0, 1)),
    ],
)  # fmt: skip
def test_what_is_refused_changes_nothing(frame: Callable[[Autopilot], bytes], counted: tuple[int, int, int]) -> None:
    node, autopilot = Node(), Autopilot()
    recorded = autopilot.says()
    assert node.hears(recorded)
    before = node.port.next, node.port.newest
    assert not node.hears(frame(autopilot))
    assert node.refused == counted
    assert not node.hears(recorded)
    assert (node.port.next, node.port.newest) == before
    assert node.hears(autopilot.says())


def test_what_was_recorded_before_a_restart_is_refused_after_it() -> None:
    node, autopilot = Node(), Autopilot()
    recorded = [autopilot.says() for _ in range(10)]
    assert all(map(node.hears, recorded))
    again = Node(node.port.next)
    assert not any(map(again.hears, recorded))
    assert again.refused == (0, 0, len(recorded))


def test_a_ground_station_behind_the_autopilot_is_taken_beside_it_and_raises_our_timestamps() -> None:
    node, autopilot = Node(BEGIN + 3 * LEEWAY), Autopilot(BEGIN + 3 * LEEWAY)
    assert node.hears(autopilot.says())
    station = Autopilot(BEGIN + 2 * LEEWAY, component=190)
    assert node.hears(station.says())
    ahead = Autopilot(BEGIN + 100 * LEEWAY, component=191)
    assert node.hears(ahead.says())
    assert node.port.next == ahead.timestamp
    assert node.hears(autopilot.says())


def test_a_radio_speaks_unsigned_about_itself_and_nothing_else() -> None:
    node = Node()
    radio = pymav.sender(51, 68)
    assert node.hears(bytes(common.MAVLink_radio_status_message(200, 200, 90, 30, 30, 0, 0).pack(radio)))
    assert not node.hears(bytes(common.MAVLink_heartbeat_message(2, 3, 0, 0, 3, 3).pack(radio)))
    assert node.refused == (1, 0, 0)


def test_mavlink_1_has_no_signatures() -> None:
    from pymavlink.dialects.v10 import common as v10

    frame = bytes(v10.MAVLink_heartbeat_message(2, 3, 0, 0, 3, 3).pack(v10.MAVLink(None, 1, 1)))
    node = Node()
    assert not node.hears(frame)
    assert node.refused == (1, 0, 0)


def test_the_table_of_streams_is_bounded() -> None:
    node = Node()
    for link in range(MAX_STREAMS):
        assert node.hears(Autopilot(link=link).says())
    one_more = Autopilot(link=MAX_STREAMS)
    assert not node.hears(one_more.says())
    assert node.refused == (0, 0, 1)


@pytest.mark.parametrize("key", [pymav.KEY, None])
def test_the_message_that_sets_a_key_is_that_of_pymavlink(key: bytes | None) -> None:
    timestamp = BEGIN if key else 0
    payload = setup_signing(KEY if key else None, timestamp, target_system=1, target_component=1)
    frame = FrameWriter(1, 191).frame(SETUP_SIGNING, payload)
    theirs: Any = common.MAVLink_setup_signing_message(1, 1, list(key or bytes(32)), timestamp)
    assert frame == bytes(theirs.pack(pymav.sender(1, 191)))


def test_the_heartbeat_of_an_open_port_is_unsigned() -> None:
    assert FrameWriter(1, 191).message(companion_heartbeat())[2] == 0
    assert Node().says()[7] == HEARTBEAT

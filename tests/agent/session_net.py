"""Nodes with keys, as far as sessions and words go, without agents around them."""

from __future__ import annotations

import random
from typing import cast

from rass_mav.core.datum import Datum, DatumId, make_datum
from rass_mav.core.messages import (
    Beacon,
    Committed,
    CopyStatus,
    CopyStatusEntry,
    CopyStatuses,
    Data,
    Handover,
    Message,
)
from rass_mav.core.store import Store
from rass_mav.mavlink.frames import FrameWriter, Stream
from rass_mav.mavlink.signing import Signer
from rass_mav.store.memory import MemoryStore
from rass_mav.trust.keys.identity import Ground, NodeKeys
from rass_mav.trust.keys.secret import Secret
from rass_mav.trust.pairs import PairTags, StrongContentHashes
from rass_mav.trust.sessions import Sessions
from rass_mav.trust.timestamps import Timestamps
from rass_mav.wire import MAX_TUNNEL, decode
from rass_mav.wire.introduction import Introduction, decode_introduction, encode_introduction
from tests.wire.samples import SAMPLES

BASE, CUSTODIAN, FORWARDER, CAPTURED = 1, 2, 3, 9
GROUND = Ground(Secret(bytes(range(32))))
STRANGER = Ground(Secret(bytes(32)))
#: Of the captured drone.
STREAM = (CAPTURED, 191, 0)
BEACON = cast(Beacon, SAMPLES["beacon-drone"])
PRINTS = StrongContentHashes()
D = make_datum(DatumId(CUSTODIAN, 0xCAFE, 7), 0, 0.0, b"measured")
E = make_datum(DatumId(CUSTODIAN, 0xCAFE, 8), 0, 0.0, b"another")


def keys_of(node_id: int, serial: int = 1, ground: Ground = GROUND) -> NodeKeys:
    return ground.node(node_id, 0 if node_id == BASE else serial)


class Speaker:
    """One node."""

    def __init__(self, node_id: int, *, serial: int = 1, store: Store | None = None, life: int = 0) -> None:
        self.id, self.serial = node_id, serial
        self.store = store or MemoryStore(node_id)
        self.out: set[tuple[int, int]] = set()
        """Node ids and serials that the ground has revoked."""
        rng = random.Random(f"{node_id}:{life}")
        self.sessions = Sessions(keys_of(node_id, serial), self.store, rng, 1.0, lambda *named: named in self.out)
        self.tags = PairTags(node_id, self.sessions)
        self.moves_to(node_id & 0xFF, node_id >> 8)

    def moves_to(self, system_id: int, link_id: int) -> None:
        """It sends in this stream from now on."""
        self.timestamps = Timestamps(self.store, Signer(bytes(32), link_id, 0), 0)
        self.sessions.connect(FrameWriter(system_id, 191), self.timestamps)

    @property
    def own(self) -> Stream:
        return self.sessions.own

    def says(self, message: Message, now: float = 0.0) -> bytes:
        if isinstance(message, Beacon) and message.sender == self.id:
            own = message._replace(life=self.store.life, number=self.timestamps.index + 1 & 0xFFFF)
            message = self.sessions.shown(own)
        [payload] = self.tags.encoded(message, self.store, now)
        assert len(payload) <= MAX_TUNNEL
        return payload

    def believes(self, payload: bytes, now: float = 0.0, stream: Stream = STREAM) -> Message | None:
        message = decode(payload, now)
        if isinstance(message, Beacon) and not self.sessions.believes(message, now, stream):
            return None
        return self.tags.believed(message, payload, now)

    def hears(self, introduction: Introduction, now: float, stream: Stream = STREAM) -> None:
        self.is_introduced(encode_introduction(introduction), now, stream)

    def is_introduced(self, payload: bytes, now: float, stream: Stream = STREAM) -> None:
        self.sessions.hear(decode_introduction(payload), now, stream)

    def knows(self, other: int) -> bool:
        known = self.sessions.get(other)
        return known is not None and known.proven is not None


class Air:
    """All hear each other, in steps of a second."""

    def __init__(self, *speakers: Speaker) -> None:
        self.speakers = list(speakers)
        self.now = 0.0
        self.introductions: list[bytes] = []

    def step(self) -> None:
        self.now += 1.0
        for speaker in self.speakers:
            payloads = speaker.sessions.due(self.now)
            self.introductions += payloads
            beacon = BEACON._replace(sender=speaker.id)
            for other in self.speakers:
                if other is not speaker:
                    for payload in payloads:
                        other.is_introduced(payload, self.now, speaker.own)
                    other.believes(speaker.says(beacon, self.now), self.now, speaker.own)
                    assert not other.sessions.disagreement()

    def steps(self, count: int) -> None:
        for _ in range(count):
            self.step()


def acquainted(*node_ids: int) -> list[Speaker]:
    air = Air(*(Speaker(node_id) for node_id in node_ids))
    air.steps(5)
    assert all(one.knows(other.id) for one in air.speakers for other in air.speakers if one is not other)
    return air.speakers


def offered(datum: Datum = D, number: int = 77, *, replica: bool = False) -> Data:
    return Data(CUSTODIAN, FORWARDER, (Handover(number, datum),), replica)


def answer(datum: Datum = D, number: int = 77, *, replica: bool = False, sender: int = FORWARDER) -> Committed:
    return Committed(sender, CUSTODIAN, ((number, PRINTS.of(datum, replica=replica)),), ())


def words() -> list[Message]:
    entries = [CopyStatusEntry(D.id, status) for status in (CopyStatus.PASSED_ON, CopyStatus.TAKEN)]
    return [CopyStatuses(FORWARDER, CUSTODIAN, (entry, CopyStatusEntry(E.id, CopyStatus.NONE))) for entry in entries]

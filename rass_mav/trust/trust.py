"""A node with keys: what they do for it over all its lives (`Trust`), and in one of them (`Keyed`).

A node without keys does not load this module, which needs PyNaCl.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from rass_mav.agent.seam import Keyless, all_but_radio
from rass_mav.core.messages import Beacon, Message
from rass_mav.core.pace import Pace
from rass_mav.core.participant import Participant
from rass_mav.core.seals import NoSeals
from rass_mav.core.store import Store
from rass_mav.mavlink.frames import FLAG_SIGNED, Frame, FrameWriter, Stream, timestamp_of
from rass_mav.mavlink.signing import SIGNATURE_SIZE, SignatureCheck, SigningKey
from rass_mav.mavlink.tunnel import tunnel_from_datagram
from rass_mav.trust.attestations import Attestations
from rass_mav.trust.key_updates import KeyUpdates
from rass_mav.trust.keys.attestation import Attestation
from rass_mav.trust.keys.identity import NodeKeys
from rass_mav.trust.keys.keyring import Keyring
from rass_mav.trust.pairs import PairTags
from rass_mav.trust.seals import DataKeys
from rass_mav.trust.sessions import Sessions
from rass_mav.trust.timestamps import COUNT_BITS, Timestamps
from rass_mav.wire.attestation import is_attestation
from rass_mav.wire.introduction import decode_introduction, is_introduction
from rass_mav.wire.key_updates import is_about_keys
from rass_mav.wire.tags import is_tagged

if TYPE_CHECKING:
    from rass_mav.trust.key_updates import KeyUpdates


class Signed:
    """The links of one life of a node, all together: a frame that leaves on several has the same timestamp on all."""

    __slots__ = ("_checks", "_payload_type", "key", "key_updates", "timestamps")

    def __init__(
        self, key_updates: KeyUpdates, writer: FrameWriter, store: Store, start: int, payload_type: int
    ) -> None:
        """:param key_updates: bring the key, and later ones.
        :param writer: its TUNNEL messages are signed from now on.
        :param start: 15 bits, where its beacons begin.
        :param payload_type: of the swarm's TUNNEL messages.
        """
        writer.tunnel_flags = FLAG_SIGNED
        self.key = key = key_updates.signing
        # A store that may have lost numbers has a new epoch, and so this node a new stream.
        self.timestamps = Timestamps(store, key.signer(store.epoch & 0xFF, 0), start)
        self.key_updates = key_updates
        self._payload_type = payload_type
        self._checks: list[SignatureCheck] = []

    def check(self, needed: Callable[[int], bool] = all_but_radio) -> SignatureCheck:
        """For a reader. `needed`: returns whether messages with this id must be signed; by default all but
        RADIO_STATUS, which the node's own radio sends."""
        check = SignatureCheck(self.key, needed, self._hear_other_key)
        self._checks.append(check)
        return check

    def use(self, key: SigningKey) -> None:
        """Sign with another link key from now on, and take no frames of the old one any more."""
        self.key = key
        self.timestamps.use(key)
        for check in self._checks:
            check.key = key

    def _hear_other_key(self, frame: bytes) -> None:
        opened = tunnel_from_datagram(frame)
        if opened is not None and opened[4] == self._payload_type:
            self.key_updates.hear_other_key(opened[5])


class Keyed(Keyless):
    """What a node's keys decide in one of its lives."""

    __slots__ = ("_rng", "_store", "_trust", "attestations", "content_hashes", "sessions", "signed", "tags")

    def __init__(self, trust: Trust, node_id: int, store: Store, rng: random.Random, step_s: float) -> None:
        self._trust = trust
        self._store = store
        self._rng = rng
        self.sessions = Sessions(trust.own, store, rng, step_s, trust.key_updates.is_revoked)
        """What is known of the other nodes."""
        self.tags = PairTags(node_id, self.sessions)
        """Prove this node's messages, and verify others'."""
        self.content_hashes = self.tags.content_hashes  # type: ignore[misc]  # of the class where there are no keys
        self.signed: Signed
        """The links. Set by `connect`."""
        self.attestations = Attestations(node_id, trust.attestation, store, rng)
        """What is known to be signed by the ground."""

    def seals(self, store: Store) -> NoSeals:
        return self._trust.seals(store)

    def connect(self, writer: FrameWriter, payload_type: int, start: int | None = None) -> None:
        start = self._rng.getrandbits(15) if start is None else start
        self.signed = Signed(self._trust.key_updates, writer, self._store, start, payload_type)
        self.sessions.connect(writer, self.signed.timestamps)

    def serve(self, node: Participant) -> None:
        self.attestations.serve(node)
        node.number_beacons(self.signed.timestamps.index)

    def begin(self, tell: Callable[[int, str], None]) -> None:
        self._trust.key_updates.begin(self.signed.use, tell)

    # -- what comes in -------------------------------------------------------------------------------------------------

    def check(self, needed: Callable[[int], bool] = all_but_radio) -> SignatureCheck:
        return self.signed.check(needed)

    def stamp(self, datagram: bytes) -> tuple[Stream, int] | None:
        if not datagram[2] & FLAG_SIGNED or not self.signed.key.made(datagram):
            return None
        return (datagram[5], datagram[6], datagram[-SIGNATURE_SIZE]), int.from_bytes(datagram[-12:-6], "little")

    def admit(self, stream: Stream, timestamp: int, payload: bytes, now: float) -> bool:
        if is_introduction(payload):
            # It shows itself whether it is new.
            return True
        if not self.sessions.admit(stream, timestamp, payload, now):
            return False
        if is_about_keys(payload):
            self.signed.key_updates.hear(self.sessions.quota_holder(stream), payload)
            return False
        return True

    def takes(self, payload: bytes, stream: Stream, now: float) -> bool:
        if is_introduction(payload):
            self.sessions.hear(decode_introduction(payload), now, stream)
            return True
        if is_attestation(payload):
            self.attestations.hear(payload, self.sessions.quota_holder(stream))
            return True
        return False

    def believe(
        self, message: Message, payload: bytes, stream: Stream, frame: Frame | None, now: float
    ) -> Message | None:
        if type(message) is Beacon and not self.sessions.believes(message, now, stream):
            return None
        believed = self.tags.believed(message, payload, now)
        if believed is None:
            return believed
        return self.attestations.admit(believed, payload, self.sessions.quota_holder(stream), frame)

    def proves(self, message: Message) -> bool:
        return is_tagged(message)

    def released(self) -> Sequence[tuple[Message, Frame | None]]:
        return self.attestations.released()

    # -- what goes out -------------------------------------------------------------------------------------------------

    def encoded(self, message: Message, store: Store, now: float) -> list[bytes]:
        return self.tags.encoded(message, store, now)

    def turn(self, messages: Sequence[Message]) -> tuple[list[bytes], Sequence[Message]]:
        node, key_updates = self.attestations.node, self.signed.key_updates
        key_payloads = key_updates.turn(() if node is None else node.routing.neighbours.values())
        messages = [
            self.sessions.shown(message)._replace(updates=key_updates.summary) if type(message) is Beacon else message
            for message in messages
        ]
        attestations, messages = self.attestations.turn(messages)
        return key_payloads + attestations, messages

    def introductions(self, now: float) -> list[bytes]:
        return self.sessions.due(now)

    def due(self, now: float, pace: Pace) -> list[bytes]:
        return self.signed.key_updates.due(now, pace.items) + self.sessions.due(now)

    def covers(self) -> bool:
        return self.signed.timestamps.cover()

    def sign(self, frame: bytes) -> bytes:
        # Signed earlier, what waits for the disk would be overtaken by too many others.
        return self.signed.timestamps.sign(frame)

    def refresh(self, frame: bytes, newest: int) -> tuple[bytes, int]:
        timestamp = timestamp_of(frame)
        if timestamp is None:
            return frame, newest
        if timestamp >> COUNT_BITS < newest >> COUNT_BITS:
            # A beacon has overtaken it: hearers would soon refuse it as late.
            frame = self.signed.timestamps.sign_again(frame)
            timestamp = timestamp_of(frame) or 0
        return frame, max(newest, timestamp)

    # -- for people ----------------------------------------------------------------------------------------------------

    @property
    def link_key(self) -> int:
        return self.signed.key_updates.link.number

    @property
    def twins(self) -> Mapping[int, float]:
        return self.sessions.twins

    def report(self, now: float) -> dict[str, Any]:
        return {
            "authentication": {**self.sessions.report(), "not_believed": self.tags.report()},
            "statement_signatures": self.attestations.report(),
            "streams": self.sessions.report_of_streams(now),
        }


class Trust(NamedTuple):
    """What a node's keys do for it. It outlives the node's lives."""

    key_updates: KeyUpdates
    """Bring the keys of its links."""
    own: NodeKeys
    """Prove it to other nodes."""
    seals: Callable[[Store], NoSeals]
    """What its keys do to data. Called for each life with its store."""
    attestation: Attestation
    """Of the ground, without which no base is believed."""

    def life(self, node_id: int, store: Store, rng: random.Random, step_s: float) -> Keyed:
        """What they do in a life that begins (`agent.seam.Keys`)."""
        return Keyed(self, node_id, store, rng, step_s)


def trust_of(keyring: Keyring, rng: random.Random, stored: Iterable[bytes] = (), *, accept_open: bool = False) -> Trust:
    """What the keys of a keyring do, all of it.

    :param rng: chooses among key updates.
    :param stored: key updates of earlier lives (`KeyUpdates`).
    :param accept_open: at a base, data without a seal count as made by the node that they name.
    """
    key_updates = KeyUpdates(keyring, rng, stored)
    return Trust(
        key_updates,
        keyring.own,
        DataKeys(keyring, key_updates.serials, accept_open=accept_open),
        Attestation(keyring),
    )

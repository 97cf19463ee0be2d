"""The other nodes that a node knows by their certificates, and how it comes to know them.

docs/protocol.md ("Introductions") has the rules. What comes here was signed with the link key, which a captured drone
has too. So everything is bounded: the table, what is verified in a step, and what is answered. Names are easy to
invent, proofs are not: a name without a proof takes no place from a node that has proved itself, and each stream of
frames may bring one.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from struct import Struct
from typing import Any, Protocol, TypeAlias

from rass_mav.core.messages import Beacon
from rass_mav.core.store import Store
from rass_mav.errors import ForgedError
from rass_mav.mavlink.frames import Stream
from rass_mav.trust.beaconkeys import HeardKeys, OwnKeys, salt_of
from rass_mav.trust.candidates import MAX_LATE, Candidates, Intake
from rass_mav.trust.keys.certificate import Certificate
from rass_mav.trust.keys.identity import NodeKeys
from rass_mav.trust.keys.pairs import Pair
from rass_mav.wire.introduction import (
    ASKED_BESIDE,
    INTRODUCTION,
    MAX_ASKED,
    MAX_PROOFS,
    Introduction,
    Whereabouts,
    encode_introduction,
    proof_claim,
)

#: Nodes remembered that have proved themselves: more than the neighbours of most, and all nodes of most missions.
MAX_KNOWN = 256
#: Questions in the name of one node that wait for a proof, each from another stream.
QUESTIONS_OF_ONE = 2
#: Introductions sent in a step.
MAX_SENT = 4
#: How often a node sends its certificate: as often as this at once, and once in so many steps in the long run.
CERTIFICATES_AT_ONCE, CERTIFICATE_STEPS = 3, 2
#: Steps until a node that does not answer is asked again, and the longest such time, seconds.
ASK_STEPS, MOST_ASK_S = 2, 8.0
#: Words that may be overtaken by so many others of their sender.
WINDOW = 128

#: Own nonces that count.
MAX_NONCES = 4
#: The serial of a drone that has replaced no other one.
FIRST_SERIAL = 1

#: Whether the ground has revoked the certificate of a node (id, serial).
IsRevoked: TypeAlias = Callable[[int, int], bool]

_ALL = (1 << WINDOW) - 1
# Node id and serial, where a certificate has them.
_NAMED = Struct("<HI")


class Links(Protocol):
    """The streams of frames (`trust.streams`)."""

    @property
    def own(self) -> Stream:
        """The node's own stream."""

    @property
    def index(self) -> int:
        """Of the node's own last beacon, over all its lives."""

    def begin_turn(self, number: int) -> int:
        """The node makes a beacon with this number (16 bits). Returns its index."""

    def prove(self, node_id: int, stream: Stream, index: int) -> None:
        """A node has just proved itself to this one in a stream, and the index of its last beacon."""

    def advance(self, node_id: int, index: int) -> None:
        """A beacon of a node was verified."""

    def forget(self, node_id: int) -> None:
        """What a node has proved counts no more."""


class Peer:
    """Another node."""

    __slots__ = ("ask_at", "bits", "certificate", "heard", "keys", "pair", "place", "proved_by", "suspected", "wait_s")

    def __init__(self) -> None:
        self.heard = 0.0
        """When a beacon in its name came, or its certificate, seconds."""
        self.certificate: Certificate | None = None
        self.pair: Pair | None = None
        """None: its certificate is not known."""
        self.place: int | None = None
        """The highest place of its words, 64 bits; None: it has not proved where it is."""
        self.bits = 0
        """Bit i: the word at `place` - i was heard, or must not be any more."""
        self.keys: HeardKeys | None = None
        """Those of its beacons; None as `place`."""
        self.proved_by = -1
        """Which nonce of this node was in its last proof: an earlier one proves nothing more."""
        self.suspected = True
        """Whether it should prove where it is: it has not yet, or it may have started again since."""
        self.ask_at = 0.0
        """From then on it can be asked again, seconds."""
        self.wait_s = 0.0
        """How long it was not asked after the last time."""

    def is_new(self, place: int) -> bool:
        """Whether a word was not heard before. From then on it was."""
        assert self.place is not None
        ahead = place - self.place
        if ahead > 0:
            self.bits = (self.bits << ahead | 1) & _ALL if ahead < WINDOW else 1
            self.place = place
            return True
        if ahead <= -WINDOW or self.bits >> -ahead & 1:
            return False
        self.bits |= 1 << -ahead
        return True

    def proves(self, place: int, keys: HeardKeys, nonce: int) -> None:
        """It is there now, and this is the place of its last word. `nonce`: which one of this node shows it."""
        self.proved_by = nonce
        self.keys = keys
        self.suspected = False
        self.wait_s = 0.0
        if self.place is None or self.place >> 32 != place >> 32 or place - self.place >= WINDOW:
            # All earlier words are old, whether they were heard or not.
            self.place, self.bits = place, _ALL


class PeerTable:
    """Those of one node. Time is an argument."""

    __slots__ = (
        "_asks",
        "_intake",
        "_is_revoked",
        "_keys",
        "_nonces",
        "_own_keys",
        "_peers",
        "_questions",
        "_rng",
        "_sent",
        "_sent_at",
        "_step",
        "_step_s",
        "_store",
        "_tokens",
        "_wanted",
        "forged",
        "links",
        "names",
        "place",
        "stale",
        "unproven",
    )  # fmt: skip

    def __init__(self, keys: NodeKeys, store: Store, rng: random.Random, step_s: float, is_revoked: IsRevoked) -> None:
        """`rng`: draws nonces. `step_s`: seconds."""
        self._keys = keys
        self._is_revoked = is_revoked
        self._store = store
        self._rng = rng
        self._step_s = step_s
        self._peers: dict[int, Peer] = {}
        """By node id."""
        self.names = Candidates()
        """Those that have not proved themselves."""
        self.links: Links
        """The streams of frames. Set before anything is heard or said."""
        self._asks: dict[int, None] = {}
        """Nodes to ask."""
        self._nonces: list[tuple[int, int]] = []
        """Own nonces, numbered from 0; the last one is the newest."""
        self._questions: dict[int, dict[Stream, int]] = {}
        """Nonces of others that wait for this node's proof, by node id, and by the stream that has brought them."""
        self._wanted = False
        """Whether somebody waits for this node's certificate."""
        self._sent_at = -math.inf
        """When that left last, seconds."""
        self._tokens = float(CERTIFICATES_AT_ONCE)
        """How often it may leave now."""
        self._step = -1
        self._sent = 0
        """Introductions sent in this step."""
        self._intake = Intake(rng)
        # A random start: nothing that was said in an earlier life has a place in this one.
        self.place = rng.getrandbits(32) << 32
        """Of this node's last word, 64 bits: its life, and a count."""
        self._own_keys = OwnKeys(keys.secret, keys.certificate.node_id, store.life, rng.getrandbits(64))
        self.unproven = 0
        """Beacons that their sender has not made, as far as is known, or that came too late."""
        self.forged = 0
        """Certificates and proofs by somebody else than they say."""
        self.stale = 0
        """Certificates that another one has replaced, or that are revoked."""

    def __len__(self) -> int:
        return len(self._peers)

    def disagreement(self) -> str:
        """What is inconsistent in its own tables, for tests; empty: nothing."""
        ids = self._peers.keys()
        if not {*self._asks, *self._questions, *self.names} <= ids:
            return "an unknown node is asked, or asks"
        of_one = max(map(len, self._questions.values()), default=0)
        full = len(self._intake) > MAX_LATE or len(self._nonces) > MAX_NONCES or of_one > QUESTIONS_OF_ONE
        return "too much is remembered" if full or len(ids) - len(self.names) > MAX_KNOWN else self.names.disagreement()

    @property
    def with_certificate(self) -> int:
        """How many of them have shown their certificate."""
        return sum(one.pair is not None for one in self._peers.values())

    def get(self, node_id: int) -> Peer | None:
        """What is known of a node."""
        peer = self._peers.get(node_id)
        if peer is not None and peer.certificate is not None and self._is_revoked(node_id, peer.certificate.serial):
            # Since its certificate came.
            self._forget(node_id)
            return None
        return peer

    # -- what comes in -------------------------------------------------------------------------------------------------

    def heard(self, node_id: int, now: float, stream: Stream) -> Peer:
        """A beacon in the name of a node. Returns what is known of it. `stream`: in which it came."""
        peer = self.get(node_id)
        if peer is None or peer.place is None:
            peer = self._named(node_id, stream)
        peer.heard = now
        if peer.suspected and now >= peer.ask_at:
            self._asks[node_id] = None
        return peer

    def believes(self, beacon: Beacon, now: float, stream: Stream) -> bool:
        """Whether another node, which has proved itself, has made a beacon, and it is its last one."""
        peer = self.heard(beacon.sender, now, stream)
        if peer.keys is None:
            return False
        made = peer.keys.verify(beacon.number, beacon.key, salt_of(beacon.sender, beacon.life))
        if made:
            self.links.advance(beacon.sender, peer.keys.index)
        else:
            self.unproven += 1
        if made is None or not peer.keys.next_end:
            # It may have started again, or it has begun another chain.
            self.ask(beacon.sender, now)
        return bool(made)

    def shown(self, beacon: Beacon) -> Beacon:
        """This node's own beacon, with its key."""
        return beacon._replace(key=self._own_keys.key(self.links.begin_turn(beacon.number)))

    def _named(self, node_id: int, stream: Stream) -> Peer:
        """A stream brings the name of a node that has not proved itself. The one that it has brought before is
        forgotten, unless another stream has brought it too."""
        gone = self.names.bring(node_id, stream)
        if gone is not None:
            self._forget(gone)
        peer = self._peers.get(node_id)
        if peer is None:
            peer = self._peers[node_id] = Peer()
        return peer

    def _forget(self, node_id: int) -> None:
        del self._peers[node_id]
        self.links.forget(node_id)
        self.names.release(node_id)
        self._asks.pop(node_id, None)
        self._questions.pop(node_id, None)

    def _has_proved(self, node_id: int) -> None:
        """A node has proved itself for the first time."""
        self.names.release(node_id)
        if len(self._peers) - len(self.names) > MAX_KNOWN:
            proven = (one for one in self._peers if one not in self.names and one != node_id)
            self._forget(min(proven, key=lambda one: self._peers[one].heard))

    def ask(self, node_id: int, now: float) -> None:
        """Ask a node for its certificate, and to prove that it is there; if it was asked a moment ago, later."""
        peer = self._peers.get(node_id)
        if peer is not None:
            peer.suspected = True
            if now >= peer.ask_at:
                self._asks[node_id] = None

    def hear(self, introduction: Introduction, now: float, stream: Stream) -> None:
        """Somebody introduces himself. All of it may be forged or old. `stream`: in which it came."""
        own, sender = self._keys.certificate.node_id, introduction.sender
        if sender == own:
            return
        self._begin_step(now)
        is_asked = own in introduction.asked
        if introduction.certificate:
            if _NAMED.unpack_from(introduction.certificate)[0] == sender:
                self._learn(introduction.certificate, now, stream, needed=is_asked)
            else:
                self.forged += 1
        if is_asked:
            self._on_question(introduction, now, stream)
        for node_id, tag in introduction.proofs:
            if node_id == own:
                self._on_proof(introduction, tag, stream)

    def _learn(self, packed: bytes, now: float, stream: Stream, *, needed: bool, late: bool = False) -> None:
        """A certificate. `needed`: even if no beacon of its node was heard. `late`: it has waited."""
        node_id, serial = _NAMED.unpack_from(packed)
        peer = self._peers.get(node_id)
        if peer is None and not needed:
            return
        if peer is not None and peer.certificate is not None:
            if peer.certificate.pack() == packed:
                return
            if serial <= peer.certificate.serial:
                self.stale += 1
                return
        if self._is_revoked(node_id, serial) or serial < (self._store.get_meta(_serial_key(node_id)) or 0):
            self.stale += 1
            return
        if not late and not self._intake.takes(node_id, stream, packed):
            return
        try:
            certificate = Certificate.unpack(packed, self._keys.ground)
            pair = Pair(self._keys, certificate)
        except ForgedError:
            self.forged += 1
            return
        if serial > FIRST_SERIAL:
            # After a restart, the keys of the drone that it replaces are worth nothing either.
            self._store.set_meta(_serial_key(node_id), serial)
        # Whatever was known is about its predecessor.
        self._named(node_id, stream)
        peer = Peer()
        peer.certificate, peer.pair, peer.heard = certificate, pair, now
        self._peers[node_id] = peer
        self.links.forget(node_id)
        self.ask(node_id, now)

    def _on_question(self, introduction: Introduction, now: float, stream: Stream) -> None:
        sender = introduction.sender
        if sender not in self._peers:
            self._named(sender, stream)
        nonces = self._questions.setdefault(sender, {})
        if introduction.nonce not in nonces.values():
            nonces[stream] = introduction.nonce
            if len(nonces) > QUESTIONS_OF_ONE:
                del nonces[self._rng.choice(list(nonces))]
        if introduction.wants:
            # If both ask at the same time, this node has answered already.
            self._wanted = self._wanted or now - self._sent_at >= 0.5 * self._step_s
            # It may have started again.
            self.ask(sender, now)

    def _on_proof(self, introduction: Introduction, tag: bytes, stream: Stream) -> None:
        sender, whereabouts = introduction.sender, introduction.whereabouts
        peer = self._peers.get(sender)
        if peer is None or peer.pair is None:
            return
        for number, nonce in self._nonces:
            if peer.pair.made(INTRODUCTION, proof_claim(nonce, whereabouts, stream), tag):
                # It may be repeated by somebody, when the node is not there any more.
                if number > peer.proved_by:
                    peer.proves(whereabouts.place, HeardKeys(*whereabouts[1:]), number)
                    self._asks.pop(sender, None)
                    if sender in self.names:
                        self._has_proved(sender)
                    self.links.prove(sender, stream, whereabouts.beacon)
                return
        self.forged += 1

    # -- what goes out -------------------------------------------------------------------------------------------------

    def due(self, now: float) -> list[bytes]:
        """The introductions that leave now, as TUNNEL payloads for everybody."""
        if not (self._asks or self._questions or self._wanted or self._intake):
            return []
        self._begin_step(now)
        out: list[bytes] = []
        while self._sent < MAX_SENT:
            certificate = self._shows_certificate(now)
            asked = self._to_ask(ASKED_BESIDE if certificate else MAX_ASKED)
            proofs = self._proofs(0 if certificate else MAX_PROOFS)
            if not (certificate or asked or proofs):
                break
            wants = any(self._peers[node_id].pair is None for node_id in asked)
            for node_id in asked:
                self._has_asked(node_id, now)
            own = self._keys.certificate
            shown, nonce = own.pack() if certificate else b"", self._nonces[-1][1] if asked else 0
            where = self._whereabouts()
            out.append(encode_introduction(Introduction(own.node_id, shown, asked, wants, nonce, where, proofs)))
            self._sent += 1
        return out

    def _begin_step(self, now: float) -> None:
        step = int(now / self._step_s)
        if step != self._step:
            passed = max(0, step - self._step)
            self._tokens = min(CERTIFICATES_AT_ONCE, self._tokens + passed / CERTIFICATE_STEPS)
            self._step, self._sent = step, 0
            for stream, packed in self._intake.begin_step():
                self._learn(packed, now, stream, needed=True, late=True)

    def _shows_certificate(self, now: float) -> bool:
        """Whether this node's certificate is in the next introduction: whose certificate is not known here does
        probably not know this one either."""
        fresh = now - self._sent_at < 0.5 * self._step_s
        lacking = not fresh and any(self._peers[node_id].pair is None for node_id in self._asks)
        if self._tokens < 1.0 or not (self._wanted or lacking):
            return False
        self._tokens -= 1.0
        self._wanted, self._sent_at = False, now
        return True

    def _to_ask(self, most: int) -> tuple[int, ...]:
        # Who has shown a certificate is not asked for it because others have not.
        lacking = [node_id for node_id in self._asks if self._peers[node_id].pair is None]
        asked = tuple(lacking or self._asks)[:most]
        newest = self._nonces[-1][0] if self._nonces else -1
        if asked and newest <= max(self._peers[node_id].proved_by for node_id in asked):
            self._nonces.append((newest + 1, self._rng.getrandbits(64)))
            del self._nonces[:-MAX_NONCES]
        return asked

    def _has_asked(self, node_id: int, now: float) -> None:
        del self._asks[node_id]
        peer = self._peers[node_id]
        peer.wait_s = min(2 * peer.wait_s, MOST_ASK_S) or ASK_STEPS * self._step_s
        peer.ask_at = now + peer.wait_s

    def _proofs(self, most: int) -> tuple[tuple[int, bytes], ...]:
        proofs: list[tuple[int, bytes]] = []
        for node_id in list(self._questions):
            peer = self._peers.get(node_id)
            if peer is None or peer.pair is None:
                continue
            nonces = self._questions[node_id]
            while nonces and len(proofs) < most:
                claim = proof_claim(nonces.pop(next(iter(nonces))), self._whereabouts(), self.links.own)
                proofs.append((node_id, peer.pair.tag(INTRODUCTION, claim)))
            if not nonces:
                del self._questions[node_id]
        return tuple(proofs)

    def _whereabouts(self) -> Whereabouts:
        index = self.links.index
        return Whereabouts(self.place, index, self._own_keys.key(index), self._own_keys.next_end(index))

    def report(self) -> dict[str, Any]:
        """For `status`."""
        return {
            "certificates": self.with_certificate,
            "forged": self.forged,
            "stale": self.stale,
            "beacons_refused": self.unproven,
        }


def _serial_key(node_id: int) -> str:
    return f"serial {node_id}"

"""Sessions: what a node with keys knows of each other node, how it comes to know it, and which frames it takes.

All that comes here was signed with the link key, which a captured drone has too: a signature shows neither who sent a
frame nor when. docs/reference/protocol-keys.md ("Signed links", "Beacon keys", "Introductions") has the rules:

- Another node is a *candidate* as soon as a beacon or a question came in its name, and *proven* when it has answered a
  challenge of this node. The answer is one tag by the key of the two nodes, over the challenge, the stream of frames in
  which it travels, and where the node is: its last tagged message, its last beacon, and the key of that. One round trip
  thus proves the pair and the stream, and from when on beacons, frames and tagged messages are new.
- Frames are taken only in the stream of a proven node, near its last verified beacon, and once. Nothing else moves a
  stream on, and only a proof sets it back.
- Frames are told apart by their contents, because every holder of the link key can use the timestamps of another node.
  Tagged messages are told apart by their places, because only the two nodes can make their tags.

Who displaces whom: a proven node gives way only to another proven one, the longest silent first. A candidate gives way
only to another one that the same stream brings, and a stream that has brought one to another stream, the longest silent
first. Names and streams, which are easy to invent, take no place from a node that has proved itself.
"""

from __future__ import annotations

import math
import random
from collections import Counter
from collections.abc import Callable
from enum import Enum
from struct import Struct
from typing import Any, NamedTuple, TypeAlias

from rass_mav.core.messages import Beacon
from rass_mav.core.store import Store
from rass_mav.errors import ForgedError
from rass_mav.mavlink.frames import FrameWriter, Stream
from rass_mav.trust.beaconkeys import MOST_AHEAD, HeardKeys, OwnKeys, salt_of
from rass_mav.trust.keys.certificate import Certificate
from rass_mav.trust.keys.identity import NodeKeys
from rass_mav.trust.keys.pairs import Pair
from rass_mav.trust.replay import ReplayWindow
from rass_mav.trust.timestamps import COUNT_BITS, Timestamps
from rass_mav.wire import beacon_sender
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

# What is remembered.
#: Proven nodes: more than the neighbours of most, and all nodes of most missions.
MAX_PROVEN = 256
#: Streams that may each have brought one candidate.
MAX_NAMES = 128
#: Other nodes with this node's system and component id.
MAX_TWINS = 16
#: Bound: Questions of one node that wait for a proof, each from another stream.
QUESTIONS_OF_ONE = 2
#: Bound: Places of tagged messages in a block of the replay window: at least so many others of its sender may overtake
#: one.
MESSAGES = 128
#: Fact: Timestamps in a block of the replay window: those between two beacons.
FRAMES = 1 << COUNT_BITS

# What is done in a step.
#: Certificates that are verified when they come. Each takes 0.1 ms here, 3 ms on a Pi Zero.
MAX_VERIFIED = 8
#: Bound: When more come, one of each of so many streams waits for the next step, which verifies so many of these as
#: well, chosen at random.
MAX_LATE, LATE_VERIFIED = 64, 4
#: Introductions sent.
MAX_SENT = 4
#: Bound: How often a node sends its certificate: as often as this at once, and once in so many steps in the long run.
CERTIFICATES_AT_ONCE, CERTIFICATE_STEPS = 3, 2

# How often a node is asked.
# Tuned: python -m tools.sensitivity trust.sessions
#: Steps until one that does not answer is asked again; twice as long each time, up to so many seconds.
ASK_STEPS, MOST_ASK_S = 2, 8.0

#: Fact: The serial of a drone that has replaced no other one.
FIRST_SERIAL = 1
#: Stands for all streams in which no node has proved itself: many of them together have one share.
UNPROVEN: Stream = (0, 0, 0)

#: Whether the ground has revoked the certificate of a node (id, serial).
IsRevoked: TypeAlias = Callable[[int, int], bool]

# Node id and serial, where a certificate has them.
_NAMED = Struct("<HI")


class Verdict(Enum):
    """What is known of a frame with a good signature. The values are the names in `status`."""

    NEW = "new"
    REPEATED = "repeated"
    """It was heard before."""
    LATE = "late"
    """It was overtaken by too many beacons, or its sender's disk was set back."""
    UNVERIFIED = "unverified"
    """No node has proved itself in this stream, or it was heard last too long ago."""
    TWIN = "twin"
    """It comes from another node with this node's system and component id, or is this node's own."""


class Refused(NamedTuple):
    """How many rightly signed frames changed nothing but this table, by verdict."""

    unverified: int
    repeated: int
    late: int
    twin: int


class Proven:
    """What a node has shown of itself with a proof."""

    __slots__ = ("frames", "keys", "messages", "stream")

    def __init__(self, where: Whereabouts, stream: Stream) -> None:
        self.stream = stream
        """In which it sends."""
        self.keys = HeardKeys(*where[1:])
        """Those of its beacons."""
        self.frames = ReplayWindow(FRAMES, where.beacon << COUNT_BITS)
        """By timestamps. It moves with the node's beacons."""
        self.messages = _all_heard(where.place)
        """By places."""

    @property
    def life(self) -> int:
        """The high half of the places of its tagged messages."""
        return self.messages.block * MESSAGES >> 32

    def again(self, where: Whereabouts, stream: Stream) -> None:
        """It has proved itself once more."""
        timestamp = where.beacon << COUNT_BITS
        if stream != self.stream:
            self.stream, self.frames = stream, ReplayWindow(FRAMES, timestamp)
        elif where.beacon < self.frames.block:
            self.frames.set_back(timestamp)
        else:
            self.frames.advance(timestamp)
        self.keys = HeardKeys(*where[1:])
        if where.place >> 32 == self.life:
            self.messages.advance(where.place)
        else:
            self.messages = _all_heard(where.place)


def _all_heard(place: int) -> ReplayWindow:
    """All messages up to this place are old, whether they were heard or not."""
    window = ReplayWindow(MESSAGES, place)
    window.floor = place + 1
    return window


class Session:
    """Another node."""

    __slots__ = (
        "ask_at", "asked_with", "certificate", "heard", "pair", "proved_with", "proven", "suspected", "wait_s",
    )  # fmt: skip

    def __init__(self) -> None:
        self.heard = 0.0
        """When a beacon in its name came, or its certificate, seconds."""
        self.certificate: Certificate | None = None
        self.pair: Pair | None = None
        """None: its certificate is not known."""
        self.proven: Proven | None = None
        """None: it is a candidate."""
        self.asked_with: int | None = None
        """The challenge in the last question to it."""
        self.proved_with: int | None = None
        """The challenge in its last proof, which proves nothing more."""
        self.suspected = True
        """Whether it should prove where it is: it has not yet, or it may have started again since."""
        self.ask_at = 0.0
        """From then on it can be asked again, seconds."""
        self.wait_s = 0.0
        """How long it was not asked after the last time."""

    def show(self, certificate: Certificate, pair: Pair, now: float) -> None:
        """Its certificate has come. Whatever was known is about its predecessor."""
        self.certificate, self.pair, self.heard = certificate, pair, now
        self.proven = self.proved_with = None
        self.suspected, self.ask_at, self.wait_s = True, 0.0, 0.0

    def prove(self, where: Whereabouts, stream: Stream) -> Proven:
        """It has answered the last question to it, in this stream."""
        self.proved_with = self.asked_with
        self.suspected, self.wait_s = False, 0.0
        if self.proven is None:
            self.proven = Proven(where, stream)
        else:
            self.proven.again(where, stream)
        return self.proven


class Sessions:
    """Those of one node. Time is an argument."""

    __slots__ = (
        "_asks", "_by_stream", "_challenge", "_is_revoked", "_keys", "_late", "_names", "_own_keys", "_questions",
        "_refused", "_rng", "_sent", "_sent_at", "_sessions", "_step", "_step_s", "_store", "_timestamps", "_tokens",
        "_verified", "_wanted", "_writer", "forged", "place", "stale", "twins", "unproven",
    )  # fmt: skip

    def __init__(self, keys: NodeKeys, store: Store, rng: random.Random, step_s: float, is_revoked: IsRevoked) -> None:
        """`rng`: draws challenges. `step_s`: seconds."""
        self._keys = keys
        self._is_revoked = is_revoked
        self._store = store
        self._rng = rng
        self._step_s = step_s
        self._writer: FrameWriter
        self._timestamps: Timestamps
        self._sessions: dict[int, Session] = {}
        """By node id."""
        self._by_stream: dict[Stream, tuple[Proven, ...]] = {}
        """The proven ones. Several nodes may share a stream."""
        self._names: dict[Stream, int] = {}
        """The candidate that a stream has brought, the longest silent stream first."""
        self._asks: dict[int, None] = {}
        """Nodes to ask."""
        self._challenge: int | None = None
        """In the questions to them, 64 bits."""
        self._questions: dict[tuple[int, Stream], int] = {}
        """Challenges of others that wait for this node's proof, by node id and the stream that has brought them."""
        self._late: dict[Stream, bytes] = {}
        """Certificates that wait to be verified."""
        self._wanted = False
        """Whether another node waits for this node's certificate."""
        self._sent_at = -math.inf
        """When that left last, seconds."""
        self._tokens = float(CERTIFICATES_AT_ONCE)
        """How often it may leave now."""
        self._step = -1
        self._sent = self._verified = 0
        """Introductions sent, and certificates verified when they came, in this step."""
        # A random start: nothing that was said in an earlier life has a place in this one.
        self.place = rng.getrandbits(32) << 32
        """Of this node's last tagged message, 64 bits: its life, and a count."""
        self._own_keys = OwnKeys(keys.secret, keys.certificate.node_id, store.life, rng.getrandbits(64))
        self.twins: dict[int, float] = {}
        """Other nodes with this node's system and component id, by node id: when the last beacon came, seconds."""
        self._refused: Counter[Verdict] = Counter()
        self.unproven = 0
        """Beacons that their sender has not made, as far as is known, or that came too late."""
        self.forged = 0
        """Certificates and proofs that the node they name has not made."""
        self.stale = 0
        """Certificates that another one has replaced, or that are revoked."""

    def connect(self, writer: FrameWriter, timestamps: Timestamps) -> None:
        """Before anything is heard or said: what sends the node's own stream, and signs it."""
        self._writer, self._timestamps = writer, timestamps

    @property
    def own(self) -> Stream:
        """The node's own stream."""
        return self._writer.system_id, self._writer.component_id, self._timestamps.link_id

    # -- what is known -------------------------------------------------------------------------------------------------

    def get(self, node_id: int) -> Session | None:
        """What is known of a node."""
        session = self._sessions.get(node_id)
        certificate = None if session is None else session.certificate
        if certificate is not None and self._is_revoked(node_id, certificate.serial):
            # Since it came.
            self._forget(node_id)
            return None
        return session

    def quota_holder(self, stream: Stream) -> Stream:
        """The account for what came in a stream: that of a node that has proved itself in this one, and in no other one
        since; or `UNPROVEN`, which stands for all others together."""
        return stream if stream in self._by_stream else UNPROVEN

    def _bring(self, node_id: int, stream: Stream) -> Session:
        """A stream brings the name of a node that has not proved itself. The one that it has brought before is
        forgotten, unless another stream has brought it too."""
        names = self._names
        gone = names.pop(stream, None)
        if gone is None and len(names) >= MAX_NAMES:
            gone = names.pop(next(iter(names)))
        names[stream] = node_id
        if gone is not None and gone != node_id and gone not in names.values():
            self._forget(gone)
        session = self._sessions.get(node_id)
        if session is None:
            session = self._sessions[node_id] = Session()
        return session

    def _release(self, node_id: int) -> None:
        """A node has proved itself, or is forgotten."""
        for stream in [stream for stream, name in self._names.items() if name == node_id]:
            del self._names[stream]

    def _leave_stream(self, session: Session) -> None:
        proven = session.proven
        if proven is not None:
            others = tuple(other for other in self._by_stream.pop(proven.stream) if other is not proven)
            if others:
                self._by_stream[proven.stream] = others

    def _forget(self, node_id: int) -> None:
        self._leave_stream(self._sessions.pop(node_id))
        self._release(node_id)
        self._asks.pop(node_id, None)
        for question in [question for question in self._questions if question[0] == node_id]:
            del self._questions[question]

    # -- frames and beacons that come in -------------------------------------------------------------------------------

    def admit(self, stream: Stream, timestamp: int, payload: bytes, now: float) -> bool:
        """Whether a frame is new, and from a node that has proved itself. If not, and it is a beacon, the node that it
        names is asked.

        :param stream: of a frame whose signature is good.
        :param timestamp: 48 bits.
        :param payload: of its TUNNEL, if it is of the swarm's type; otherwise empty.
        """
        verdict = self._judge(stream, timestamp, payload, now)
        if verdict is Verdict.NEW:
            return True
        self._refused[verdict] += 1
        if verdict is Verdict.UNVERIFIED or verdict is Verdict.LATE:
            sender = beacon_sender(payload)
            if sender is not None and sender != self._keys.certificate.node_id:
                self._hear_of(sender, now, stream)
                self.ask(sender, now)
        return False

    def _judge(self, stream: Stream, timestamp: int, payload: bytes, now: float) -> Verdict:
        if stream[0] == self._writer.system_id and stream[1] == self._writer.component_id:
            return self._hear_twin(stream, timestamp, payload, now)
        windows, index = [proven.frames for proven in self._by_stream.get(stream, ())], timestamp >> COUNT_BITS
        near = [window for window in windows if window.floor <= timestamp and index <= window.block + MOST_AHEAD]
        if not near:
            return Verdict.LATE if any(index < window.block for window in windows) else Verdict.UNVERIFIED
        # By its contents: two frames with one timestamp are two frames.
        mark = hash((timestamp, payload))
        new = [window.is_new(timestamp, mark) for window in near]
        return Verdict.NEW if all(new) else Verdict.REPEATED

    def _hear_twin(self, stream: Stream, timestamp: int, payload: bytes, now: float) -> Verdict:
        if stream == self.own and timestamp >> COUNT_BITS < self._timestamps.start:
            # A recording of an earlier life.
            return Verdict.LATE
        node_id = beacon_sender(payload)
        if node_id == self._keys.certificate.node_id:
            # It changes nothing but what the node knows of copies of its store.
            self._refused[Verdict.TWIN] += 1
            return Verdict.NEW
        if node_id is not None:
            self.twins.pop(node_id, None)
            self.twins[node_id] = now
            if len(self.twins) > MAX_TWINS:
                del self.twins[next(iter(self.twins))]
        return Verdict.TWIN

    def believes(self, beacon: Beacon, now: float, stream: Stream) -> bool:
        """Whether a node that has proved itself has made a beacon, and it is its last one; or it is in this node's own
        name."""
        if beacon.sender == self._keys.certificate.node_id:
            return True
        proven = self._hear_of(beacon.sender, now, stream).proven
        if proven is None:
            return False
        made = proven.keys.verify(beacon.number, beacon.key, salt_of(beacon.sender, beacon.life))
        if made:
            proven.frames.advance(proven.keys.index << COUNT_BITS)
        else:
            self.unproven += 1
        if made is None or not proven.keys.next_end:
            # It may have started again, or it has begun another chain.
            self.ask(beacon.sender, now)
        return bool(made)

    def _hear_of(self, node_id: int, now: float, stream: Stream) -> Session:
        """A beacon in the name of a node."""
        session = self.get(node_id)
        if session is None or session.proven is None:
            session = self._bring(node_id, stream)
        session.heard = now
        if session.suspected and now >= session.ask_at:
            self._asks[node_id] = None
        return session

    # -- introductions that come in ------------------------------------------------------------------------------------

    def hear(self, introduction: Introduction, now: float, stream: Stream) -> None:
        """An introduction. All of it may be forged or old. `stream`: in which it came."""
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
        session = self._sessions.get(node_id)
        if session is None and not needed:
            return
        if session is not None and session.certificate is not None:
            if session.certificate.pack() == packed:
                return
            if serial <= session.certificate.serial:
                self.stale += 1
                return
        if self._is_revoked(node_id, serial) or serial < (self._store.get_meta(_serial_key(node_id)) or 0):
            self.stale += 1
            return
        if not late and not self._verifies(stream, packed):
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
        session = self._bring(node_id, stream)
        self._leave_stream(session)
        session.show(certificate, pair, now)
        self.ask(node_id, now)

    def _verifies(self, stream: Stream, packed: bytes) -> bool:
        """Whether a certificate is verified now. If not, it may wait."""
        if self._verified < MAX_VERIFIED:
            self._verified += 1
            return True
        if stream not in self._late and len(self._late) >= MAX_LATE:
            del self._late[self._rng.choice(list(self._late))]
        self._late[stream] = packed
        return False

    def _on_question(self, introduction: Introduction, now: float, stream: Stream) -> None:
        sender, questions = introduction.sender, self._questions
        if sender not in self._sessions:
            self._bring(sender, stream)
        of_one = {question for question in questions if question[0] == sender}
        if all(questions[question] != introduction.nonce for question in of_one):
            questions[sender, stream] = introduction.nonce
            of_one.add((sender, stream))
            if len(of_one) > QUESTIONS_OF_ONE:
                del questions[self._rng.choice([question for question in questions if question in of_one])]
        if introduction.wants:
            # If both ask at the same time, this node has answered already.
            self._wanted = self._wanted or now - self._sent_at >= 0.5 * self._step_s
            # It may have started again.
            self.ask(sender, now)

    def _on_proof(self, introduction: Introduction, tag: bytes, stream: Stream) -> None:
        sender, where = introduction.sender, introduction.whereabouts
        session = self._sessions.get(sender)
        if session is None or session.pair is None or session.asked_with in (None, session.proved_with):
            # It was not asked, or has answered: an answer may be repeated when the node is gone.
            return
        if not session.pair.made(INTRODUCTION, proof_claim(session.asked_with, where, stream), tag):
            self.forged += 1
            return
        self._leave_stream(session)
        is_first = session.proven is None
        proven = session.prove(where, stream)
        self._by_stream[stream] = (*self._by_stream.get(stream, ()), proven)
        self._asks.pop(sender, None)
        if is_first:
            self._release(sender)
            ids = [node_id for node_id, one in self._sessions.items() if one.proven is not None]
            if len(ids) > MAX_PROVEN:
                ids.remove(sender)
                self._forget(min(ids, key=lambda node_id: self._sessions[node_id].heard))

    # -- what goes out -------------------------------------------------------------------------------------------------

    def shown(self, beacon: Beacon) -> Beacon:
        """This node's own beacon, with its key."""
        return beacon._replace(key=self._own_keys.key(self._timestamps.begin_turn(beacon.number)))

    def ask(self, node_id: int, now: float) -> None:
        """Ask a node for its certificate, and to prove that it is there; if it was asked a moment ago, later."""
        session = self._sessions.get(node_id)
        if session is not None:
            session.suspected = True
            if now >= session.ask_at:
                self._asks[node_id] = None

    def due(self, now: float) -> list[bytes]:
        """The introductions that leave now, as TUNNEL payloads for everybody."""
        if not (self._asks or self._questions or self._wanted or self._late):
            return []
        self._begin_step(now)
        out: list[bytes] = []
        while self._sent < MAX_SENT:
            certificate = self._shows_certificate(now)
            asked, wants = self._ask_now(ASKED_BESIDE if certificate else MAX_ASKED, now)
            proofs = self._proofs(0 if certificate else MAX_PROOFS)
            if not (certificate or asked or proofs):
                break
            own, challenge = self._keys.certificate, self._challenge if asked else None
            shown = own.pack() if certificate else b""
            where = self._whereabouts()
            out.append(
                encode_introduction(Introduction(own.node_id, shown, asked, wants, challenge or 0, where, proofs))
            )
            self._sent += 1
        return out

    def _begin_step(self, now: float) -> None:
        step = int(now / self._step_s)
        if step != self._step:
            passed = max(0, step - self._step)
            self._tokens = min(CERTIFICATES_AT_ONCE, self._tokens + passed / CERTIFICATE_STEPS)
            self._step, self._sent, self._verified = step, 0, 0
            late, self._late = list(self._late.items()), {}
            for stream, packed in self._rng.sample(late, min(len(late), LATE_VERIFIED)):
                self._learn(packed, now, stream, needed=True, late=True)

    def _shows_certificate(self, now: float) -> bool:
        """Whether this node's certificate is in the next introduction: whose certificate is not known here does
        probably not know this one either."""
        fresh = now - self._sent_at < 0.5 * self._step_s
        lacking = not fresh and any(self._sessions[node_id].pair is None for node_id in self._asks)
        if self._tokens < 1.0 or not (self._wanted or lacking):
            return False
        self._tokens -= 1.0
        self._wanted, self._sent_at = False, now
        return True

    def _ask_now(self, most: int, now: float) -> tuple[tuple[int, ...], bool]:
        """Which nodes are asked now, and whether for their certificates too."""
        # Who has shown a certificate is not asked for it because others have not.
        lacking = [node_id for node_id in self._asks if self._sessions[node_id].pair is None]
        asked = tuple(lacking or self._asks)[:most]
        sessions = [self._sessions[node_id] for node_id in asked]
        if any(session.proved_with == self._challenge for session in sessions):
            self._challenge = self._rng.getrandbits(64)
        for node_id, session in zip(asked, sessions, strict=True):
            del self._asks[node_id]
            session.asked_with = self._challenge
            session.wait_s = min(2 * session.wait_s, MOST_ASK_S) or ASK_STEPS * self._step_s
            session.ask_at = now + session.wait_s
        return asked, bool(lacking)

    def _proofs(self, most: int) -> tuple[tuple[int, bytes], ...]:
        proofs: list[tuple[int, bytes]] = []
        for question in list(self._questions):
            session = self._sessions[question[0]]
            if len(proofs) < most and session.pair is not None:
                claim = proof_claim(self._questions.pop(question), self._whereabouts(), self.own)
                proofs.append((question[0], session.pair.tag(INTRODUCTION, claim)))
        return tuple(proofs)

    def _whereabouts(self) -> Whereabouts:
        index = self._timestamps.index
        return Whereabouts(self.place, index, self._own_keys.key(index), self._own_keys.next_end(index))

    # -- for people, and for tests -------------------------------------------------------------------------------------

    @property
    def refused(self) -> Refused:
        """The counts so far."""
        return Refused(*(self._refused[Verdict(name)] for name in Refused._fields))

    def report(self) -> dict[str, Any]:
        """Of other nodes, for `status`."""
        return {
            "certificates": sum(one.pair is not None for one in self._sessions.values()),
            "forged": self.forged,
            "stale": self.stale,
            "beacons_refused": self.unproven,
        }

    def report_of_streams(self, now: float) -> dict[str, Any]:
        """Of their frames, for `status`."""
        return {
            "known": len(self._by_stream),
            "refused": self.refused._asdict(),
            "twins": [{"node_id": node_id, "age_s": round(now - at, 3)} for node_id, at in sorted(self.twins.items())],
        }

    def disagreement(self) -> str:
        """What is inconsistent, or too much, in its own tables; empty: nothing."""
        ids, candidates = self._sessions.keys(), {id for id, one in self._sessions.items() if one.proven is None}
        if not {*self._asks, *(question[0] for question in self._questions)} <= ids:
            return "an unknown node is asked, or asks"
        if set(self._names.values()) != candidates:
            return "the candidates are not those that streams have brought"
        proven = {one.proven for one in self._sessions.values() if one.proven is not None}
        if proven != {one for stream, those in self._by_stream.items() for one in those if one.stream == stream}:
            return "the streams are not those of the proven nodes"
        of_one = max(Counter(question[0] for question in self._questions).values(), default=0)
        full = len(ids) - len(candidates) > MAX_PROVEN or len(self._names) > MAX_NAMES or of_one > QUESTIONS_OF_ONE
        return (
            "too much is remembered" if full or max(len(self.twins) - MAX_TWINS, len(self._late) - MAX_LATE) > 0 else ""
        )


def _serial_key(node_id: int) -> str:
    return f"serial {node_id}"

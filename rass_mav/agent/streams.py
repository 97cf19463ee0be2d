"""Which signed frames are new: the streams of other nodes, and the challenges that show whether they are there now.

docs/protocol.md ("Signed links") has the rules. Only frames with a good signature come here, so a stranger can enter
nothing. What somebody has recorded and repeats changes this table, and nothing else in the node.

A captured drone has the key, and can invent any number of streams that answer challenges. It has one certificate. So
streams have ranks: those in which a node has proved itself, others that have answered a challenge, and strange ones.
Each rank has places of its own.
"""

from __future__ import annotations

import math
import random
from typing import Any, NamedTuple

from rass_mav.agent.timestamps import Timestamps
from rass_mav.errors import MalformedError
from rass_mav.mavlink.frames import FrameWriter, Stream
from rass_mav.wire import beacon_sender
from rass_mav.wire.challenge import (
    MAX_ANSWERED,
    MAX_ASKED,
    Asked,
    Challenge,
    decode_challenge,
    encode_challenge,
    is_challenge,
)

#: Timestamps below the highest that may still come, for frames that were reordered on the way.
WINDOW = 32
#: Streams remembered, of each rank: those in which nodes have proved themselves, other known ones, and strange ones.
MAX_PROVEN, MAX_UNPROVEN, MAX_STRANGE = 768, 64, 64
#: A strange stream keeps its place for so many steps: until it was asked, and has had time to answer.
STAY_STEPS = 6
#: A stream that was silent for longer is strange again, seconds: several of the longest turns.
SILENT_S = 600.0
#: A nonce is sent for this long, and accepted for as long again, seconds.
NONCE_S = 60.0
#: Own nonces that are remembered.
MAX_NONCES = 8
#: Steps until a stream that does not answer is asked again, and the longest such time, seconds.
ASK_STEPS, MOST_ASK_S = 2, 8.0
#: Challenges sent in one step.
MAX_CHALLENGES = 4
#: Other nodes with this node's system and component id that are remembered.
MAX_TWINS = 16

#: Stands for all streams in which no node has proved itself: nobody has a greater share with many of them.
UNPROVEN: Stream = (0, 0, 0)

_ALL = (1 << WINDOW) - 1


class _State:
    __slots__ = ("ask_at", "asked_at", "bits", "challenged", "heard", "highest", "known", "nonce", "since", "wait_s")

    def __init__(self, now: float) -> None:
        self.since = now
        """When it was entered, seconds."""
        self.known = False
        """It has answered a challenge."""
        self.highest = 0
        """The highest timestamp seen."""
        self.bits = _ALL
        """Bit i: the timestamp `highest` - i was taken, or must not be any more."""
        self.challenged = -1
        """Timestamp of the last challenge of this stream that was answered."""
        self.heard = 0.0
        """When a frame of it was last new, or it was strange, seconds."""
        self.ask_at = 0.0
        """From then on it can be asked again, seconds."""
        self.wait_s = 0.0
        """How long it was not asked after the last time."""
        self.nonce: int | None = None
        """The nonce with which it was last asked; None: it was not."""
        self.asked_at = 0.0
        """When that was drawn, seconds."""

    def take(self, timestamp: int) -> bool | None:
        """Whether a timestamp was not taken before. None: it is below the window, so nobody knows."""
        ahead = timestamp - self.highest
        if ahead > 0:
            self.bits = (self.bits << ahead | 1) & _ALL if ahead < WINDOW else 1
            self.highest = timestamp
            return True
        if ahead <= -WINDOW:
            return None
        bit = 1 << -ahead
        if self.bits & bit:
            return False
        self.bits |= bit
        return True


class Refused(NamedTuple):
    """How many rightly signed frames changed nothing but this table."""

    strange: int
    """Their stream has not answered a challenge yet."""
    again: int
    """Their timestamp had been taken."""
    late: int
    """Their timestamp was below the window."""
    twin: int
    """They came from another node with this node's system and component id."""


class Streams:
    """The streams that one node hears, and its own. Time is an argument."""

    __slots__ = (
        "_again", "_answers", "_asks", "_late", "_new", "_node_id", "_nonces", "_proven", "_proven_in", "_rng",
        "_step_s", "_strange", "_table", "_timestamps", "_twin", "_unproven", "_used", "_writer", "malformed", "twins",
    )  # fmt: skip

    def __init__(
        self, node_id: int, writer: FrameWriter, timestamps: Timestamps, rng: random.Random, step_s: float
    ) -> None:
        """`writer`: of the node's own stream, which `timestamps` signs. `rng`: draws nonces. `step_s`: seconds between
        two calls of `due`."""
        self._node_id = node_id
        self._writer = writer
        self._timestamps = timestamps
        self._rng = rng
        self._step_s = step_s
        self._table: dict[Stream, _State] = {}
        self._new: dict[Stream, None] = {}
        """Those that have never answered, in the order in which they were entered."""
        self._unproven: dict[Stream, None] = {}
        """Those that have, and in which no node has proved itself, in that order."""
        self._proven: dict[Stream, set[int]] = {}
        """The nodes that have proved themselves in a stream. They may have to answer again, under another key."""
        self._proven_in: dict[int, Stream] = {}
        """The stream in which a node did so last, by node id."""
        self._asks: dict[Stream, None] = {}
        """Streams to ask in the next step."""
        self._answers: dict[Stream, int] = {}
        """The nonce to send back to each stream."""
        self._nonces: list[tuple[int, float]] = []
        """Own nonces, with the time when each was drawn; the last one is the newest."""
        self._used = False
        """Whether a stream has gone that has answered the newest nonce, or an earlier one."""
        self.malformed = 0
        """Challenges that do not parse."""
        self.twins: dict[int, float] = {}
        """Other nodes with this node's system and component id, by node id: when the last beacon came, seconds."""
        self._strange = self._again = self._late = self._twin = 0

    def __len__(self) -> int:
        return len(self._table)

    @property
    def own(self) -> Stream:
        """The node's own stream."""
        return self._writer.system_id, self._writer.component_id, self._timestamps.link_id

    @property
    def refused(self) -> Refused:
        """The counts so far."""
        return Refused(self._strange, self._again, self._late, self._twin)

    # -- what comes in -------------------------------------------------------------------------------------------------

    def admit(self, stream: Stream, timestamp: int, payload: bytes, now: float) -> bool:
        """Whether the node may look at a frame.

        :param stream: of a frame whose signature is good.
        :param timestamp: 48 bits.
        :param payload: of its TUNNEL, if it is of the swarm's type; otherwise empty.
        """
        state = self._table.get(stream)
        if state is None:
            state = self._enter(stream, now)
            if state is None:
                self._strange += 1
                return False
        if state.known and now - state.heard > SILENT_S:
            state.known = False
        if not state.known:
            self._hear_stranger(stream, state, timestamp, payload, now)
            return False
        new = state.take(timestamp)
        if new:
            state.heard = now
        else:
            if new is None:
                self._late += 1
                # Perhaps its disk was set back. The challenge tells it where to continue.
                self._ask(stream, state, now)
            else:
                self._again += 1
            return False
        if is_challenge(payload):
            challenge = self._opened(payload)
            if challenge is not None:
                self._answer(stream, state, timestamp, challenge)
            return False
        if stream[0] == self._writer.system_id and stream[1] == self._writer.component_id:
            return self._hear_twin(payload, now)
        return True

    def _enter(self, stream: Stream, now: float) -> _State | None:
        """A stream is heard for the first time. None: there is no place for it now."""
        if stream not in self._proven:
            if len(self._new) >= MAX_STRANGE:
                oldest = next(iter(self._new))
                if now - self._table[oldest].since < STAY_STEPS * self._step_s:
                    return None
                self._drop(oldest)
            self._new[stream] = None
        state = self._table[stream] = _State(now)
        return state

    def _drop(self, stream: Stream) -> None:
        state = self._table.pop(stream, None)
        # It may be heard again, with an old answer.
        self._used = self._used or (state is not None and stream not in self._new)
        for places in (self._new, self._unproven, self._asks, self._answers):
            places.pop(stream, None)

    def bringer(self, stream: Stream) -> Stream:
        """Who has brought what came in a stream: a node that has proved itself in this one, and in no other one since;
        or `UNPROVEN`, which stands for all others together."""
        return stream if stream in self._proven else UNPROVEN

    def prove(self, node_id: int, stream: Stream) -> None:
        """A node has proved itself to this one, in a frame of a known stream (`agent.acquaintances`)."""
        before = self._proven_in.pop(node_id, None)
        self._proven_in[node_id] = stream
        if before == stream:
            return
        if before is not None:
            self._unprove(node_id, before)
        self._proven.setdefault(stream, set()).add(node_id)
        self._unproven.pop(stream, None)
        if len(self._proven) > MAX_PROVEN:
            silent = min(self._proven, key=lambda one: self._table[one].heard if one in self._table else -math.inf)
            for other in list(self._proven[silent]):
                del self._proven_in[other]
                self._unprove(other, silent)

    def _unprove(self, node_id: int, stream: Stream) -> None:
        nodes = self._proven[stream]
        nodes.discard(node_id)
        if not nodes:
            del self._proven[stream]
            if stream in self._table:
                self._place_unproven(stream)

    def _place_unproven(self, stream: Stream) -> None:
        self._unproven[stream] = None
        if len(self._unproven) > MAX_UNPROVEN:
            self._drop(next(iter(self._unproven)))

    def _hear_stranger(self, stream: Stream, state: _State, timestamp: int, payload: bytes, now: float) -> None:
        self._strange += 1
        state.heard = now
        state.highest = max(state.highest, timestamp)
        challenge = self._opened(payload) if is_challenge(payload) else None
        if challenge is not None:
            self._answer(stream, state, timestamp, challenge)
            if state.nonce in challenge.answered and now - state.asked_at <= 2 * NONCE_S:
                state.known = True
                # What it has sent before the answer may be a repetition.
                state.bits = _ALL
                state.ask_at = state.wait_s = 0.0
                state.nonce = None
                self._asks.pop(stream, None)
                if stream in self._new:
                    del self._new[stream]
                    self._place_unproven(stream)
                return
        self._ask(stream, state, now)

    def _opened(self, payload: bytes) -> Challenge | None:
        try:
            return decode_challenge(payload)
        except MalformedError:
            self.malformed += 1
            return None

    def _answer(self, stream: Stream, state: _State, timestamp: int, challenge: Challenge) -> None:
        """If a challenge names this node, answer it in the next step."""
        own = self.own
        named = [asked.highest for asked in challenge.asked if asked.stream == own]
        # A recorded challenge must not take the place of a later one. Our own may come back.
        if not named or timestamp <= state.challenged or any(challenge.nonce == nonce for nonce, _ in self._nonces):
            return
        state.challenged = timestamp
        self._timestamps.skip_to(max(named) + 1)
        self._answers[stream] = challenge.nonce

    def _ask(self, stream: Stream, state: _State, now: float) -> None:
        if now >= state.ask_at:
            self._asks[stream] = None

    def _hear_twin(self, payload: bytes, now: float) -> bool:
        self._twin += 1
        node_id = beacon_sender(payload)
        if node_id is not None:
            self.twins.pop(node_id, None)
            self.twins[node_id] = now
            if len(self.twins) > MAX_TWINS:
                del self.twins[next(iter(self.twins))]
        # A beacon of its own node id changes nothing but what the node knows of copies of its store.
        return node_id == self._node_id

    def forget(self) -> None:
        """The link key has changed: whatever was heard under the old one, others who have it may have forged."""
        # Which stream is whose was proved with other keys.
        for forgotten in (self._table, self._new, self._unproven, self._asks, self._answers):
            forgotten.clear()
        self._nonces.clear()

    # -- what goes out -------------------------------------------------------------------------------------------------

    def due(self, now: float) -> list[bytes]:
        """The challenges and answers of this step, as TUNNEL payloads for everybody."""
        payloads: list[bytes] = []
        while (self._asks or self._answers) and len(payloads) < MAX_CHALLENGES:
            streams = list(self._asks)[:MAX_ASKED]
            nonce, drawn = self._nonce(now) if streams else (0, 0.0)
            asked = tuple(self._asked(stream, nonce, drawn, now) for stream in streams)
            answered = tuple(self._answers.pop(stream) for stream in list(self._answers)[:MAX_ANSWERED])
            payloads.append(encode_challenge(Challenge(asked, nonce, answered)))
        return payloads

    def _asked(self, stream: Stream, nonce: int, drawn: float, now: float) -> Asked:
        del self._asks[stream]
        state = self._table[stream]
        state.wait_s = min(2 * state.wait_s, MOST_ASK_S) or ASK_STEPS * self._step_s
        state.ask_at = now + state.wait_s
        state.nonce, state.asked_at = nonce, drawn
        return Asked(stream, state.highest)

    def _nonce(self, now: float) -> tuple[int, float]:
        nonces = self._nonces
        if not nonces or self._used or now - nonces[-1][1] > NONCE_S:
            self._used = False
            nonces.append((self._rng.getrandbits(64), now))
            del nonces[:-MAX_NONCES]
        return nonces[-1]

    def report(self, now: float) -> dict[str, Any]:
        """For `status`."""
        known = sum(state.known for state in self._table.values())
        return {
            "known": known,
            "proven": len(self._proven),
            "strange": len(self._table) - known,
            "refused": self.refused._asdict(),
            "twins": [{"node_id": node_id, "age_s": round(now - at, 3)} for node_id, at in sorted(self.twins.items())],
        }

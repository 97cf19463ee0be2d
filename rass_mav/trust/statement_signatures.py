"""Which statements of bases the ground has vouched for, and how statement signatures spread.

docs/reference/protocol-keys.md ("Statement signatures") has the rules. A statement for which no statement
signature is known waits here, and core does not hear of it unless one comes. Statement signatures are items of gossip
(`rass_mav.core.gossip`).
"""

from __future__ import annotations

import random
import struct
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from hashlib import blake2b
from typing import TYPE_CHECKING, NamedTuple, TypeVar

from rass_mav.core.gossip import ENOUGH, Gossip
from rass_mav.core.messages import Message, stated
from rass_mav.core.shares import greediest
from rass_mav.mavlink.frames import Frame, Stream
from rass_mav.trust.sessions import UNPROVEN
from rass_mav.wire import encode
from rass_mav.wire.attestation import (
    HASH_BYTES,
    MAX_STATEMENTS_ASKED,
    MAX_VOUCHED,
    Signed,
    StatementSignature,
    body_of,
)

if TYPE_CHECKING:
    from rass_mav.trust.keys.attestation import Attestation

#: Bound: Statements that are known to be true. When there are more, those that core has forgotten go, but the latest
#: stay.
MAX_KNOWN, LATEST = 6144, 1024
#: Statements that wait for a statement signature, in all and under one identity.
MAX_HELD, MAX_ALIKE = 512, 4
# Tuned: python -m tools.sensitivity trust.statement_signatures
#: A base signs as soon as so many statements wait, or one has waited for so many turns.
SHARED, SIGN_TURNS = 2, 6
#: Turns until a statement signature is asked for, and how often. The next wait is twice as long each time.
ASK_TURNS, MAX_ASKS = SIGN_TURNS + 1, 4

T = TypeVar("T")

_PERSON = b"rass statement"
_SALT = struct.Struct("<I")

#: Base, base life and serial of a statement.
Statement = tuple[int, int, int]


def hash_of(payload: bytes, salt: int) -> bytes:
    """What a statement signature with this salt has of a statement, 8 bytes. `payload`: the statement as it travels."""
    return blake2b(payload, digest_size=HASH_BYTES, salt=_SALT.pack(salt), person=_PERSON).digest()


class _Signature(NamedTuple):
    salt: int
    hash: bytes
    key: Statement
    """The first statement that it is for."""
    payload: bytes


class Held:
    """A statement without a statement signature."""

    __slots__ = ("frame", "message", "payload", "senders", "statement")

    def __init__(
        self, statement: Statement, message: Message, payload: bytes, stream: Stream, frame: Frame | None
    ) -> None:
        self.statement = statement
        self.message = message
        self.payload = payload
        """As its base sent it."""
        self.senders: tuple[Stream, ...] = (stream,)
        """Its senders so far, the first one brought it: what neighbours have sent already is relayed less."""
        self.frame = frame
        """In which it came first; None: it is no longer needed."""


class _Wait:
    """What waits under one identity."""

    __slots__ = ("ask_at", "asks", "held")

    def __init__(self, turn: int) -> None:
        self.held: list[Held] = []
        self.ask_at = turn + ASK_TURNS
        self.asks = 0


class StatementSignatures:
    """What one node knows of statement signatures."""

    __slots__ = (
        "_attestation",
        "_brought",
        "_rng",
        "_source",
        "_turns",
        "_unsigned",
        "forged",
        "gossip",
        "held",
        "signatures",
        "waiting",
    )  # fmt: skip

    def __init__(self, source: tuple[int, int], attestation: Attestation, rng: random.Random) -> None:
        """`source`: the node's id and life, in whose name it speaks if it is a base."""
        self._source = source
        self._attestation = attestation
        self._rng = rng
        self._turns = 0
        self.signatures: dict[Statement, _Signature] = {}
        """True statements, the one learned last is the last."""
        self.waiting: dict[Statement, _Wait] = {}
        self.held = 0
        """How many statements wait for a statement signature."""
        self._brought: dict[Stream, dict[Held, None]] = {}
        """What waits, by who has brought it, the oldest first."""
        self.gossip: Gossip[Statement, bytes] = Gossip(rng)
        """The statement signatures to send, by the first statement that each is for."""
        self._unsigned: list[tuple[int, bytes, int]] = []
        """At a base: serial and payload of what it has stated and not signed yet, and the turn."""
        self.forged = 0
        """Statements that are not the ones that the ground has vouched for."""

    def disagreement(self) -> str:
        """What is inconsistent in its own tables, for tests; empty: nothing."""
        waiting = {id(held) for wait in self.waiting.values() for held in wait.held}
        if waiting != {id(held) for some in self._brought.values() for held in some} or self.held != len(waiting):
            return "what waits is not what was brought"
        return "too much is remembered" if self.held > MAX_HELD else ""

    # -- what comes in -------------------------------------------------------------------------------------------------

    def admits(
        self, statement: Statement, message: Message, payload: bytes, stream: Stream, frame: Frame | None
    ) -> bool:
        """Whether core may hear a statement. While that is unknown, it waits."""
        signature = self.signatures.get(statement)
        if signature is not None:
            if hash_of(payload, signature.salt) == signature.hash:
                return True
            self.forged += 1
            return False
        wait = self.waiting.get(statement)
        for held in () if wait is None else wait.held:
            if held.payload == payload:
                if stream not in held.senders and len(held.senders) <= ENOUGH:
                    held.senders += (stream,)
                return False
        if wait is not None and (len(wait.held) >= MAX_ALIKE or any(held.senders[0] == stream for held in wait.held)):
            return False
        if self.held >= MAX_HELD:
            most = greediest({stream: len(held) for stream, held in self._brought.items()})
            self._drop(next(iter(self._brought[most])))
        held = Held(statement, message, payload, stream, frame)
        self.waiting.setdefault(statement, _Wait(self._turns)).held.append(held)
        self._brought.setdefault(stream, {})[held] = None
        self.held += 1
        return False

    def _drop(self, held: Held) -> None:
        wait = self.waiting[held.statement]
        wait.held.remove(held)
        if not wait.held:
            del self.waiting[held.statement]
        self._let_go(held)

    def _let_go(self, held: Held) -> None:
        """It waits no more."""
        self.held -= 1
        brought = self._brought[held.senders[0]]
        del brought[held]
        if not brought:
            del self._brought[held.senders[0]]

    def is_news(self, signed: Signed, stream: Stream) -> bool:
        """Whether it is worth to verify a statement signature that a quota holder brings."""
        statement_signature = signed.content
        assert isinstance(statement_signature, StatementSignature)
        signature = self.signatures.get(statement_signature[:3])
        if signature is None or signature.payload != signed.payload:
            # Nothing that is known about all of them is better known by another statement signature.
            return any(statement not in self.signatures for statement in _statements(statement_signature))
        if stream != UNPROVEN:
            self.gossip.hear(signature.key, stream)
        return False

    def learn(self, signed: Signed, stream: Stream, statements: Callable[[], Collection[Statement]]) -> list[Held]:
        """A statement signature whose signature is good, and which is news. Returns the statements that core may hear
        now. `statements`: returns those that core knows."""
        out: list[Held] = []
        statement_signature = signed.content
        assert isinstance(statement_signature, StatementSignature)
        key = statement_signature[:3]
        self.gossip.add(key, signed.payload, stream, self._turns)
        for statement, hash in zip(_statements(statement_signature), statement_signature.hashes, strict=True):
            if statement in self.signatures:
                continue
            self.signatures[statement] = _Signature(statement_signature.salt, hash, key, signed.payload)
            wait = self.waiting.pop(statement, None)
            for held in () if wait is None else wait.held:
                self._let_go(held)
                if hash_of(held.payload, statement_signature.salt) == hash:
                    out.append(held)
                else:
                    self.forged += 1
        if len(self.signatures) > MAX_KNOWN:
            self._forget(statements())
        return out

    def _forget(self, statements: Collection[Statement]) -> None:
        old = list(self.signatures)[:-LATEST]
        for statement in old:
            if statement not in statements:
                del self.signatures[statement]
        for statement in list(self.signatures)[: max(0, len(self.signatures) - MAX_KNOWN)]:
            del self.signatures[statement]

    def asked(self, statement: Statement, stream: Stream) -> None:
        """A neighbour lacks a statement signature."""
        signature = self.signatures.get(statement)
        if signature is not None:
            self.gossip.add(signature.key, signature.payload, stream, self._turns)

    # -- what goes out -------------------------------------------------------------------------------------------------

    def turn(self, messages: Iterable[Message]) -> tuple[list[bytes], tuple[Statement, ...]]:
        """Once a turn. Returns the statement signatures to send, as TUNNEL payloads, and the statements whose statement
        signatures to ask for.

        `messages`: what this node sends in this turn.
        """
        self._turns += 1
        for message in messages:
            self._notice(message)
        unsigned = self._unsigned
        out = []
        if len(unsigned) >= SHARED or (unsigned and self._turns - unsigned[0][2] >= SIGN_TURNS):
            out += self._sign()
        left = self.gossip.leave(self._turns)
        return out if left is None else [*out, left[1]], self._lacking()

    def _notice(self, message: Message) -> None:
        """A message leaves. A base signs its own statements."""
        statement = stated(message)
        if (
            statement is not None
            and self._attestation.speaks
            and statement[:2] == self._source
            and statement not in self.signatures
        ):
            self._unsigned.append((statement[2], encode(message, 0.0)[0], self._turns))

    def _sign(self) -> list[bytes]:
        out = []
        while self._unsigned:
            first = self._unsigned[0][0]
            run = [self._unsigned.pop(0)]
            while self._unsigned and len(run) < MAX_VOUCHED and self._unsigned[0][0] == first + len(run):
                run.append(self._unsigned.pop(0))
            salt = self._rng.getrandbits(32)
            body = body_of(
                StatementSignature(*self._source, first, salt, tuple(hash_of(payload, salt) for _, payload, _ in run))
            )
            signed = body + self._attestation.vouch(body)
            key = (*self._source, first)
            for serial, payload, _ in run:
                statement = (*self._source, serial)
                self.signatures[statement] = _Signature(salt, hash_of(payload, salt), key, signed)
            self.gossip.spend(self._turns)
            out.append(signed)
        return out

    def _lacking(self) -> tuple[Statement, ...]:
        """The statements whose statement signatures to ask for in this turn. Those that no signature ever came for are
        dropped."""
        turn = self._turns
        ready: dict[Stream, list[Statement]] = {}
        for statement, wait in list(self.waiting.items()):
            if wait.ask_at > turn:
                continue
            if wait.asks == MAX_ASKS:
                for held in list(wait.held):
                    self._drop(held)
            else:
                ready.setdefault(wait.held[0].senders[0], []).append(statement)
        asked = tuple(in_turn(ready, MAX_STATEMENTS_ASKED, self._rng))
        for statement in asked:
            wait = self.waiting[statement]
            wait.asks += 1
            wait.ask_at = turn + (ASK_TURNS << wait.asks)
        return asked


def in_turn(waiting: Mapping[Stream, Sequence[T]], most: int, rng: random.Random) -> list[T]:
    """Some of what several have brought: the same number of each, as far as possible."""
    left = [rng.sample(some, len(some)) for some in rng.sample(list(waiting.values()), len(waiting))]
    chosen: list[T] = []
    while left and len(chosen) < most:
        chosen += [some.pop() for some in left]
        left = [some for some in left if some]
    return chosen[:most]


def _statements(statement_signature: StatementSignature) -> list[Statement]:
    base, life, first, _, hashes = statement_signature
    return [(base, life, first + i) for i in range(len(hashes))]

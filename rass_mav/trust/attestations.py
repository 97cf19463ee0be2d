"""What a node with keys knows to be signed by the ground. It believes nothing else about a base."""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from rass_mav.core.messages import Beacon, Message, sent_by, stated
from rass_mav.core.participant import Participant
from rass_mav.core.store import Store
from rass_mav.mavlink.frames import Frame, Stream
from rass_mav.trust.route_proofs import RouteProofs
from rass_mav.trust.statement_signatures import Held, StatementSignatures
from rass_mav.wire.attestation import (
    STATEMENT_SIGNATURE,
    Ask,
    Signed,
    decode_attestation,
    encode_ask,
)

if TYPE_CHECKING:
    from rass_mav.trust.keys.attestation import Attestation

#: Signatures verified in one step, at most.
MAX_VERIFIED = 4
#: Signatures of one stream that wait to be verified, and streams that have some.
MAX_OF_STREAM, MAX_STREAMS = 8, 64


class Attestations:
    """What one node knows to be signed by the ground."""

    __slots__ = ("bad", "keys", "node", "queue", "routes", "statement_signatures", "verified")

    def __init__(self, node_id: int, keys: Attestation, store: Store, rng: random.Random) -> None:
        """`keys`: those of the ground, as far as the node has them. `store`: of the node."""
        self.node: Participant | None = None
        """The participant that hears all this; None: there is none."""
        self.keys = keys
        """Those of the ground."""
        self.statement_signatures = StatementSignatures((node_id, store.life), keys, rng)
        self.routes = RouteProofs(node_id, keys, store, rng)
        self.queue: dict[Stream, deque[Signed]] = {}
        """What waits to be verified. Streams come in turn."""
        self.verified = 0
        """Signatures verified."""
        self.bad = 0
        """Signatures of others than the ground."""

    def serve(self, node: Participant) -> None:
        """From now on all is for this participant. Statement signatures leave as often as statements."""
        self.node = node
        self.statement_signatures.gossip.period = node.settings.custody.receipt_steps

    # -- what comes in -------------------------------------------------------------------------------------------------

    def hear(self, payload: bytes, stream: Stream) -> None:
        """A TUNNEL payload for which `is_attestation`. `stream`: its quota holder (`Sessions.quota_holder`). Raises
        `MalformedError`."""
        attestation = decode_attestation(payload)
        if isinstance(attestation, Ask):
            for base in attestation.bases:
                self.routes.asked(base, stream)
            for statement in attestation.statements:
                self.statement_signatures.asked(statement, stream)
        elif self._is_news(attestation, stream):
            queue = self.queue.get(stream)
            if queue is None:
                if len(self.queue) >= MAX_STREAMS:
                    return
                queue = self.queue[stream] = deque(maxlen=MAX_OF_STREAM)
            queue.append(attestation)

    def _is_news(self, signed: Signed, stream: Stream) -> bool:
        return (self.statement_signatures if signed.kind == STATEMENT_SIGNATURE else self.routes).is_news(
            signed, stream
        )

    def admit(self, message: Message, payload: bytes, stream: Stream, frame: Frame | None) -> Message | None:
        """A message as core should hear it; None: not now.

        :param payload: the TUNNEL payload from which it was decoded.
        :param stream: its quota holder (`Sessions.quota_holder`).
        :param frame: in which it came, if that is needed later.
        """
        if type(message) is Beacon:
            return self.routes.heard(message, stream, self.node)
        statement = stated(message)
        if statement is None or self.statement_signatures.admits(statement, message, payload, stream, frame):
            return sent_by(message, (stream,))
        return None

    def released(self) -> list[tuple[Message, Frame | None]]:
        """Once a step: verify what waits. Returns the statements that core may hear now, and in which frames they
        came."""
        out: list[Held] = []
        left = MAX_VERIFIED
        while left and self.queue:
            stream = next(iter(self.queue))
            queue = self.queue.pop(stream)
            signed = queue.popleft()
            if queue:
                self.queue[stream] = queue
            if not self._is_news(signed, stream):
                continue
            left -= 1
            self.verified += 1
            of_statements = signed.kind == STATEMENT_SIGNATURE
            if not (self.keys.vouches if of_statements else self.keys.anchors)(signed.body, signed.signature):
                self.bad += 1
            elif of_statements:
                out += self.statement_signatures.learn(
                    signed, stream, set if self.node is None else self.node.receipts.identities
                )
            else:
                self.routes.learn(signed, stream, self.node)
        return [(sent_by(held.message, held.senders), held.frame) for held in out]

    # -- what goes out -------------------------------------------------------------------------------------------------

    def turn(self, messages: Sequence[Message]) -> tuple[list[bytes], list[Message]]:
        """Once a turn: TUNNEL payloads to send, and the messages of this turn as they should leave."""
        statement_signatures, statements = self.statement_signatures.turn(messages)
        shown = [self.routes.shown(message) if type(message) is Beacon else message for message in messages]
        anchors, bases = self.routes.turn()
        asks = [encode_ask(Ask(bases, statements))] if bases or statements else []
        return [*anchors, *statement_signatures, *asks], shown

    def report(self) -> dict[str, Any]:
        """For `status`."""
        return {
            "verified": self.verified,
            "bad": self.bad,
            "waiting": self.statement_signatures.held,
            "forged": self.statement_signatures.forged,
            "routes_refused": self.routes.refused,
        }

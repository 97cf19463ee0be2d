"""A change of the link key in flight: the ground's key updates, which nodes bring each other
(docs/reference/protocol-keys.md).

A node opens the key update to itself, from any sender: it costs no more than to check a frame, and only the ground
can have written it. It takes key updates about others only from nodes that have its own link key, and verifies the
ground's signature. All that a stranger can do is to bring a true key update, or to ask for one.

Key updates are items of gossip (`rass_mav.core.gossip`) of two kinds. Those that nodes with the same link key lack are
offered to them: beacons show who lacks some. Those that nodes with another one ask for are new.
"""

from __future__ import annotations

import logging
import random
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from math import inf
from typing import Any

from rass_mav.core.gossip import Gossip
from rass_mav.core.routes.neighbours import Neighbour
from rass_mav.errors import ForgedError, KeysError, MalformedError
from rass_mav.mavlink.frames import Stream
from rass_mav.mavlink.messages import WARNING
from rass_mav.mavlink.signing import SigningKey
from rass_mav.trust.key_update_table import MAX_KEY_UPDATES, KeyUpdateTable
from rass_mav.trust.keys.certificate import BASE_SERIAL
from rass_mav.trust.keys.identity import LinkKey
from rass_mav.trust.keys.key_updates import KeyUpdate, KeyUpdateOpener, write_key_update
from rass_mav.trust.keys.keyring import Keyring
from rass_mav.trust.sessions import UNPROVEN
from rass_mav.wire.key_updates import (
    KeyRequest,
    decode_key_request,
    enclose,
    enclosed,
    encode_key_request,
    is_about_keys,
    is_key_update,
)

log = logging.getLogger(__name__)

#: Key updates that nodes with the same link key lack leave in one turn: at most.
MAX_SENT = 4
# Tuned: python -m tools.sensitivity trust.key_updates
#: Turns from one key update that a node without the link key has asked for to the next, at least: the period of their
#: gossip. And how many of those that the node has not got yet leave when they come.
ASKED_PERIOD, MAX_AWAITED = 1, 32
#: Signatures of the ground that are verified in one step, and key updates that wait for it: of all streams, and of one.
MAX_VERIFIED, MAX_STREAMS, MAX_OF_ONE = 8, 64, MAX_SENT
#: Key updates from senders without the link key that are verified in one step.
MAX_FOREIGN = 4
#: Turns from one key request of a node that hears another key to the next, at least; and if that is said to be later.
REQUEST_TURNS = 8
AHEAD_TURNS = REQUEST_TURNS // 2
#: Turns after which a neighbour that still lacks key updates counts as another one: what it lacks is offered again.
LACKING_TURNS = 64


class _Inbox:
    """What has come in since the last step."""

    __slots__ = ("ahead", "base", "candidates", "other_key", "unproven")

    def __init__(self) -> None:
        self.other_key = False
        """Frames with another link key were heard."""
        self.ahead = False
        """One of them claims that it is a later one."""
        self.base = False
        """A base claims to have an earlier one."""
        self.unproven: deque[KeyUpdate] = deque(maxlen=MAX_FOREIGN)
        """Key updates from senders without the link key."""
        self.candidates: dict[Stream, list[KeyUpdate]] = {}
        """Key updates from nodes with the link key."""

    def add(self, stream: Stream, key_update: KeyUpdate) -> None:
        """A key update from a node with the link key."""
        waiting = self.candidates.get(stream, [])
        if len(waiting) < MAX_OF_ONE and (waiting or len(self.candidates) < MAX_STREAMS):
            self.candidates[stream] = [*waiting, key_update]

    def key_updates(self) -> list[KeyUpdate]:
        """The key updates to verify: of each stream in turn, so that none takes the turns of others."""
        chosen, waiting = list(self.unproven), list(self.candidates.values())
        while waiting:
            chosen += (key_updates.pop(0) for key_updates in waiting)
            waiting = [key_updates for key_updates in waiting if key_updates]
        return chosen[:MAX_VERIFIED]


class KeyUpdates:
    """The link key of a node, and the key updates about it that the node keeps. They outlive the node's lives."""

    __slots__ = (
        "_adopt",
        "_asked",
        "_awaited",
        "_inbox",
        "_items",
        "_missing",
        "_next",
        "_opener",
        "_requested_at",
        "_rng",
        "_table",
        "_tell",
        "_turns",
        "changed_at",
        "forged",
        "keyring",
        "link",
        "malformed",
        "revoked",
    )  # fmt: skip

    def __init__(self, keyring: Keyring, rng: random.Random, stored: Iterable[bytes] = ()) -> None:
        """:param keyring: from the node's file.
        :param rng: chooses among key updates.
        :param stored: what `packed` returned in an earlier life. It is not verified again.
        """
        self.keyring = keyring
        self._opener = KeyUpdateOpener(keyring.own)
        self.link: LinkKey = keyring.own.link
        """The link key that the node signs with."""
        self.changed_at: float | None = None
        """When it changed last in this life, seconds; None: not yet."""
        self.revoked = False
        """Whether the ground has revoked this node."""
        self.forged = 0
        """Key updates that the ground has not written."""
        self.malformed = 0
        """Key updates and key requests that do not parse."""
        self._table = KeyUpdateTable(keyring.own.certificate.node_id, self.link.number)
        self._rng = rng
        self._items = 1
        """Data that the links can carry in a turn."""
        self._forget()
        self._inbox = _Inbox()
        self._next: LinkKey | None = None
        """In use from the next step on."""
        self._adopt: Callable[[SigningKey], None] = _nobody
        self._tell: Callable[[int, str], None] = _nobody
        for packed in stored:
            self._table.keep(KeyUpdate.unpack(packed), own=True)
        self._resume()
        self._table.use(self.link.number)
        self._write()

    # -- what the node has ---------------------------------------------------------------------------------------------

    @property
    def signing(self) -> SigningKey:
        """The link key, as links use it."""
        return SigningKey(self.link.key.reveal())

    @property
    def news(self) -> int:
        """Rises whenever `packed` returns something else."""
        return self._table.news

    def begin(self, adopt: Callable[[SigningKey], None], tell: Callable[[int, str], None]) -> None:
        """A life of the node begins. `adopt`: called with a new link key, in `due`. `tell`: informs the operator;
        severity as MAV_SEVERITY."""
        self._adopt, self._tell = adopt, tell
        # Its timeline may be another one.
        self._forget()
        self._inbox = _Inbox()
        self.changed_at = None

    def _forget(self) -> None:
        """Nothing is to leave."""
        self._turns = 0
        self._requested_at: float = -inf
        """The turn of the last key request."""
        self._asked: Gossip[int, None] = Gossip(self._rng, period=ASKED_PERIOD, most=MAX_KEY_UPDATES)
        """Key updates that those without the link key have asked for, by node id."""
        self._awaited: dict[int, None] = {}
        """What they have asked for and the node has not got yet."""
        self._missing: Gossip[int, None] = Gossip(self._rng)
        """Key updates that nodes with the link key may not have, by node id."""

    def is_revoked(self, node_id: int, serial: int) -> bool:
        """Whether a certificate is refused: the ground has revoked the drone, or given its place to another one."""
        key_update = self._table.get(node_id)
        return key_update is not None and serial <= key_update.last_revoked

    @property
    def revoked_elsewhere(self) -> list[int]:
        """At a base that writes key updates: the drones that another copy of `ground.keys` has revoked or replaced
        under the same number of the link key, and this copy has not. Node ids."""
        ground = self.keyring.ground
        if ground is None or ground.number < self.link.number:
            return []
        in_file = {id: serial - (id not in ground.revoked) for id, serial in ground.serials.items()}
        return [id for id, serial in self._table.out().items() if serial > in_file.get(id, 0)]

    def serials(self) -> Mapping[int, int]:
        """By node id, the last serial of a drone that the node's file has; at a drone none."""
        return {} if self.keyring.ground is None else self.keyring.ground.serials

    def packed(self) -> list[bytes]:
        """All key updates, to be kept over restarts."""
        return self._table.packed()

    def renew(self, keyring: Keyring) -> None:
        """The node's file has changed. The change takes effect in the next step.

        :raises KeysError: it holds another node's keys, or an older link key.
        """
        before, own = self.keyring.own, keyring.own
        if (own.certificate, own.ground) != (before.certificate, before.ground):
            raise KeysError("the file now holds other keys", "restart the node to use them")
        if own.link.number < self.link.number:
            raise KeysError(
                f"the file now holds link key {own.link.number}, and this node has {self.link.number} already",
                "copy the newest file",
            )
        self.keyring = keyring
        if own.link.number > (self._next or self.link).number:
            self._next = own.link
        self._write()

    def report(self, now: float) -> dict[str, Any]:
        """For `status`."""
        return {
            "number": self.link.number,
            "age_s": None if self.changed_at is None else round(now - self.changed_at, 3),
            "drones": len(self._table),
            "forged": self.forged,
            "revoked": self.revoked,
            "others_revoked": [{"node_id": node_id, "serial": serial} for node_id, serial in self._table.out().items()],
            "revoked_elsewhere": self.revoked_elsewhere,
        }

    def _resume(self) -> None:
        """After a start: key updates that were kept may have a later key than the file."""
        ground, own = self.keyring.ground, self.keyring.own
        if ground is not None:
            if self._table.last() > self.link.number:
                self.link = ground.link_key(self._table.last())
            return
        key_update = self._table.get(own.certificate.node_id)
        if key_update is None or key_update.number < self.link.number:
            return
        if key_update.last_revoked >= own.certificate.serial:
            self.revoked = True
        elif key_update.number > self.link.number and self._opener.is_for_this(key_update):
            try:
                self.link = self._opener.open(key_update)
            except ForgedError:
                log.warning("a stored key update cannot be opened; the node will receive it again")

    def _write(self) -> None:
        """At a base: write the key updates about the link key in its file, if it was ever changed."""
        ground = self.keyring.ground
        if ground is None or ground.number == 1 or ground.number < self.link.number:
            # This file does not know who was revoked since: key updates written from it could let that drone in.
            return
        for node_id in ground.serials:
            self._table.keep(write_key_update(ground, node_id), own=True)

    # -- what comes in -------------------------------------------------------------------------------------------------

    def hear(self, stream: Stream, payload: bytes) -> None:
        """What is about keys from a node with the same link key, in a frame that is new. `stream`: its quota
        holder (`Sessions.quota_holder`)."""
        key_update = self._key_update_in(payload) if is_key_update(payload) else None
        if key_update is None or self._opens(key_update) or key_update.number != self.link.number:
            return
        held = self._table.get(key_update.node_id)
        if held == key_update:
            # Another node was faster.
            self._missing.hear(key_update.node_id)
            if stream != UNPROVEN:
                self._asked.hear(key_update.node_id, stream)
        elif held is None or key_update.rank > held.rank:
            self._inbox.add(stream, key_update)

    def hear_other_key(self, payload: bytes) -> None:
        """Any payload in a frame that is signed with another key: by one who has missed a change, or is ahead, or by a
        stranger. It may have been sent long ago."""
        inbox = self._inbox
        inbox.other_key = True
        if is_key_update(payload):
            key_update = self._key_update_in(payload)
            if key_update is not None and not self._opens(key_update) and self._concerns(key_update):
                inbox.unproven.append(key_update)
        elif is_about_keys(payload) and (request := self._key_request_in(payload)) is not None:
            if request.number > self.link.number:
                inbox.ahead = True
            elif request.number < self.link.number:
                inbox.base |= request.serial == BASE_SERIAL
                key_update = self._table.get(request.node_id)
                self._ask(request.node_id, key_update is not None and key_update.number == self.link.number)

    def _ask(self, node_id: int, there: bool) -> None:
        """A node without the link key has asked for the key update about this drone. `there`: this node has it."""
        if there:
            self._asked.add(node_id, None, None, self._turns)
        else:
            self._awaited[node_id] = None
            if len(self._awaited) > MAX_AWAITED:
                # No asker can take all places for long by asking for the others.
                del self._awaited[self._rng.choice(list(self._awaited))]

    def _key_update_in(self, payload: bytes) -> KeyUpdate | None:
        try:
            return KeyUpdate.unpack(enclosed(payload))
        except MalformedError:
            self.malformed += 1
            return None

    def _key_request_in(self, payload: bytes) -> KeyRequest | None:
        try:
            return decode_key_request(payload)
        except MalformedError:
            self.malformed += 1
            return None

    def _opens(self, key_update: KeyUpdate) -> bool:
        """Whether a key update claims to have a later link key for this node. If it has, the node uses it from the next
        step on."""
        if self.keyring.ground is not None or not key_update.sealed or not self._opener.is_for_this(key_update):
            return False
        if key_update.number <= (self._next or self.link).number:
            return False
        try:
            self._next = self._opener.open(key_update)
            # Once for each link key: true keys under false signatures cannot make a node work.
            key_update.verify(self.keyring.own.ground)
        except ForgedError:
            self.forged += 1
        else:
            self._table.keep(key_update, own=True)
        return True

    def _concerns(self, key_update: KeyUpdate) -> bool:
        """Whether a key update from one without the link key is worth a verification: it would tell a base that the key
        has changed, or a drone that it is revoked."""
        if self.keyring.ground is not None:
            return key_update.number > self.link.number
        own = self.keyring.own.certificate
        return not self.revoked and key_update.node_id == own.node_id and key_update.last_revoked >= own.serial

    # -- what goes out -------------------------------------------------------------------------------------------------

    def due(self, now: float, items: int) -> list[bytes]:
        """Do what is due in a step. Returns key requests, as TUNNEL payloads for everybody. `items`: data that the
        links can carry in a turn."""
        self._items = items
        inbox = self._inbox
        if inbox.other_key or inbox.candidates:
            self._inbox = _Inbox()
            self._verify(inbox.key_updates())
        if self._next is not None:
            self._change(self._next, now)
        elif inbox.other_key:
            return self._answer(inbox)
        return []

    @property
    def summary(self) -> int:
        """For the beacon: of two nodes with the same link key, the one with the higher number has key updates that the
        other one lacks, and equal numbers mean the same key updates. 0: no node lacks any."""
        return self._table.summary()

    def turn(self, neighbours: Iterable[Neighbour]) -> list[bytes]:
        """Once a turn: key updates, as TUNNEL payloads for everybody. `neighbours`: with the same link key."""
        self._turns += 1
        own, time = self.summary, self._turns // LACKING_TURNS
        behind = [((n.id, n.beacon.life, time), n.beacon.updates) for n in neighbours if n.beacon.updates < own]
        if self._missing.differs(MAX_SENT * self._turns, own, behind):
            # All neighbours of one that lacks some send them: each another one, as far as possible.
            current = [(node_id, None) for node_id in self._table.current()]
            self._rng.shuffle(current)
            self._missing.offer(current)
        left = [self._asked.leave(self._turns)]
        for part in range(max(1, min(MAX_SENT, self._items)) - (left[0] is not None)):
            left.append(self._missing.leave(MAX_SENT * self._turns + part))
        key_updates = (self._table.get(one[0]) for one in left if one is not None)
        return [enclose(key_update.pack()) for key_update in key_updates if key_update is not None]

    def _verify(self, key_updates: Iterable[KeyUpdate]) -> None:
        for key_update in key_updates:
            try:
                key_update.verify(self.keyring.own.ground)
            except ForgedError:
                self.forged += 1
                continue
            if self._table.keep(key_update):
                if key_update.node_id in self._awaited:
                    del self._awaited[key_update.node_id]
                    self._ask(key_update.node_id, True)
                self._apply(key_update)

    def _apply(self, key_update: KeyUpdate) -> None:
        """What a key update that the ground has written means for this node."""
        own, ground = self.keyring.own.certificate, self.keyring.ground
        if ground is not None:
            if key_update.number > (self._next or self.link).number:
                # All link keys are derived from the ground's secret.
                self._next = ground.link_key(key_update.number)
                self._tell(WARNING, "RASS: the link key was changed elsewhere, copy ground.keys from there")
            elif (id := key_update.node_id) in self.revoked_elsewhere:
                text = f"RASS: another copy of ground.keys has revoked or replaced drone {id}, see how-to/keys"
                self._tell(WARNING, text)
        elif key_update.node_id == own.node_id and key_update.last_revoked >= own.serial and not self.revoked:
            self.revoked = True
            self._tell(WARNING, "RASS: the keys of this drone are revoked")

    def _change(self, link: LinkKey, now: float) -> None:
        self._next = None
        self.link = link
        self.changed_at = now
        self._table.use(link.number)
        self._forget()
        self._adopt(self.signing)
        log.info("link key %d is now in use", link.number)

    def _answer(self, inbox: _Inbox) -> list[bytes]:
        """Frames with another link key were heard. Returns the key request that leaves now."""
        if inbox.base and (current := self._table.current()):
            # Any key update tells a base the number, and so the key.
            self._ask(next(iter(current)), True)
        if self.revoked or self._turns - self._requested_at < (AHEAD_TURNS if inbox.ahead else REQUEST_TURNS):
            return []
        self._requested_at, own = self._turns, self.keyring.own.certificate
        return [encode_key_request(KeyRequest(own.node_id, own.serial, self.link.number))]


def _nobody(*_: object) -> None:
    """Until a life begins."""

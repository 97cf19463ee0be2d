"""A change of the link key in flight: the ground's letters, which nodes bring each other (docs/protocol.md).

A node opens the letter to itself, whoever brings it: it costs no more than to check a frame, and only the ground can
have written it. It takes letters about others only from nodes that have its own link key, and verifies the ground's
signature. So what somebody without the key can do is to bring a true letter, or to ask for one.
"""

from __future__ import annotations

import logging
import random
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache
from math import inf
from typing import Any

from rass_mav.errors import ForgedError, KeysError, MalformedError
from rass_mav.mavlink.frames import Stream
from rass_mav.mavlink.signing import SigningKey
from rass_mav.trust.keys.certificate import BASE_SERIAL
from rass_mav.trust.keys.identity import LinkKey
from rass_mav.trust.keys.keyring import Keyring
from rass_mav.trust.keys.letters import Letter, LetterOpener, write_letter
from rass_mav.trust.lettertable import MAX_SENT, LetterQueue, LetterTable
from rass_mav.wire.letters import (
    LAST_NODE,
    MAX_NAMED,
    Roll,
    decode_roll,
    enclose,
    enclosed,
    encode_roll,
    is_about_keys,
    is_letter,
)

log = logging.getLogger(__name__)

#: Signatures of the ground that are verified in one step, and letters that wait for it: of all streams, and of one.
MAX_VERIFIED, MAX_STREAMS, MAX_OF_ONE = 8, 64, MAX_SENT
#: Letters from senders without the link key that are verified in one step.
MAX_FOREIGN = 4
#: Turns between two rolls at first, and the longest such time, seconds: to nodes with the same key, and with another.
ROLL_TURNS, MOST_ROLL_S, MOST_ASK_S = 2, 64.0, 16.0
#: Turns after a roll that differed from its own before a node takes notice of another one.
NOTICE_TURNS = 32
#: A node that hears of a later key asks for it within this time, seconds.
ASK_S = 8.0
#: When no frame with another key was heard for this long, seconds, the next one counts as the first.
QUIET_S = 120.0
_WARNING = 4
# In a mock swarm all nodes have the same one, and open a frame together.
_signing_key = lru_cache(maxsize=8)(SigningKey)


class _Repeated:
    """When something is said next: soon, and then more and more rarely."""

    __slots__ = ("_most_s", "_wait_s", "at", "first_s")

    def __init__(self, first_s: float, most_s: float) -> None:
        self.first_s = first_s
        """Between the first two times, seconds."""
        self._most_s = most_s
        self._wait_s = first_s
        self.at = inf
        """Seconds; infinite: not at all."""

    def begin(self, now: float) -> None:
        """From now on, unless it has begun."""
        if self.at == inf:
            self._wait_s, self.at = self.first_s, now

    def begin_again(self, now: float) -> None:
        """There is news."""
        self._wait_s = self.first_s
        self.within(now, self.first_s)

    def within(self, now: float, seconds: float) -> None:
        """Not later than in so many seconds."""
        self.at = min(self.at, now + seconds)

    def rest(self) -> None:
        """From now on it is not said."""
        self.at = inf

    def due(self, now: float) -> bool:
        """Whether it is said now."""
        if now < self.at:
            return False
        self.at = now + self._wait_s
        self._wait_s = max(self.first_s, min(2 * self._wait_s, self._most_s))
        return True


class _Rolls:
    """When the node sends rolls, and what they name."""

    __slots__ = ("_cursor", "_differs", "_heard_other_at", "_noticed_at", "_to_others", "_to_own")

    def __init__(self, step_s: float) -> None:
        self._to_own = _Repeated(ROLL_TURNS * step_s, MOST_ROLL_S)
        """To nodes with the same link key."""
        self._to_others = _Repeated(ROLL_TURNS * step_s, MOST_ASK_S)
        """To nodes with another one."""
        self.begin()

    def begin(self) -> None:
        """Time begins."""
        self._to_own.rest()
        self._to_others.rest()
        self._heard_other_at = self._noticed_at = -inf
        self._differs = True
        self._cursor = 0

    def change(self, now: float) -> None:
        """The node has another link key."""
        self._to_others.rest()
        self._noticed_at = -inf
        self._differs = True
        self._cursor = 0
        self._to_own.begin_again(now)

    def learn(self, now: float) -> None:
        """The node has letters that it had not."""
        self._to_own.begin_again(now)

    def hear_difference(self, now: float) -> None:
        """A node with the same link key has other letters. Nobody can cause more than a few rolls by that."""
        self._differs = True
        self._to_own.within(now, MOST_ASK_S)
        if now - self._noticed_at > NOTICE_TURNS / ROLL_TURNS * self._to_own.first_s:
            self._noticed_at = now
            self._to_own.begin_again(now)

    def hear_same(self) -> None:
        """A node with the same link key has the same letters."""
        self._differs = False

    def hear_other_key(self, now: float, *, ahead: bool) -> None:
        """`ahead`: somebody claims to have a later link key."""
        if now - self._heard_other_at > QUIET_S:
            self._to_others.rest()
        self._heard_other_at = now
        self._to_others.begin(now)
        if ahead:
            self._to_others.within(now, ASK_S)

    def due(self, now: float, turn_s: float, *, has_letters: bool) -> bool:
        """Whether a roll leaves now."""
        self._to_own.first_s = self._to_others.first_s = ROLL_TURNS * turn_s
        if has_letters:
            self._to_own.begin(now)
        return self._to_own.due(now) | self._to_others.due(now)

    def filled_in(self, bare: Roll, marks: dict[int, int]) -> Roll:
        """The roll that leaves: it names letters from a difference on until somebody has the same."""
        if not self._differs:
            return bare
        first = self._cursor
        ids = [id for id in marks if id >= first]
        named = ids[:MAX_NAMED]
        last = LAST_NODE if named == ids else named[-1]
        self._cursor = 0 if last == LAST_NODE else last + 1
        return bare._replace(first=first, last=last, named={id: marks[id] for id in named})


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
        self.unproven: deque[Letter] = deque(maxlen=MAX_FOREIGN)
        """Letters from senders without the link key."""
        self.candidates: dict[Stream, list[Letter]] = {}
        """Letters from nodes with the link key."""

    def add(self, stream: Stream, letter: Letter) -> None:
        """A letter from a node with the link key."""
        waiting = self.candidates.get(stream, [])
        if len(waiting) < MAX_OF_ONE and (waiting or len(self.candidates) < MAX_STREAMS):
            self.candidates[stream] = [*waiting, letter]

    def letters(self) -> list[Letter]:
        """The letters to verify: of each stream in turn, so that nobody takes the turns of others."""
        chosen, waiting = list(self.unproven), list(self.candidates.values())
        while waiting:
            chosen += (letters.pop(0) for letters in waiting)
            waiting = [letters for letters in waiting if letters]
        return chosen[:MAX_VERIFIED]


class Letters:
    """The link key of a node, and the letters about it that the node keeps. They outlive the node's lives."""

    __slots__ = (
        "_adopt", "_inbox", "_keyring", "_next", "_opener", "_queue", "_rolls", "_table", "_tell", "changed_at",
        "forged", "link", "malformed", "revoked",
    )  # fmt: skip

    def __init__(self, keyring: Keyring, rng: random.Random, step_s: float, kept: Iterable[bytes] = ()) -> None:
        """:param keyring: from the node's file.
        :param rng: chooses among letters.
        :param step_s: seconds between two calls of `due`.
        :param kept: what `packed` returned in an earlier life. It is not verified again.
        """
        self._keyring = keyring
        self._opener = LetterOpener(keyring.own)
        self.link: LinkKey = keyring.own.link
        """The link key that the node signs with."""
        self.changed_at: float | None = None
        """When it changed last in this life, seconds; None: not yet."""
        self.revoked = False
        """Whether the ground has revoked this node."""
        self.forged = 0
        """Letters that the ground has not written."""
        self.malformed = 0
        """Letters and rolls that do not parse."""
        self._table = LetterTable(self.link.number)
        self._queue = LetterQueue(rng)
        self._rolls = _Rolls(step_s)
        self._inbox = _Inbox()
        self._next: LinkKey | None = None
        """In use from the next step on."""
        self._adopt: Callable[[SigningKey], None] = _nobody
        self._tell: Callable[[int, str], None] = _nobody
        for packed in kept:
            self._table.keep(Letter.unpack(packed), own=True)
        self._resume()
        self._table.use(self.link.number)
        self._write()

    # -- what the node has ---------------------------------------------------------------------------------------------

    @property
    def signing(self) -> SigningKey:
        """The link key, as links use it."""
        return _signing_key(self.link.key.reveal())

    @property
    def news(self) -> int:
        """Rises whenever `packed` returns something else."""
        return self._table.news

    def begin(self, adopt: Callable[[SigningKey], None], tell: Callable[[int, str], None]) -> None:
        """A life of the node begins. `adopt`: called with a new link key, in `due`. `tell`: informs the crew; severity
        as MAV_SEVERITY."""
        self._adopt, self._tell = adopt, tell
        # Its timeline may be another one.
        self._queue.begin()
        self._rolls.begin()
        self._inbox = _Inbox()
        self.changed_at = None

    def is_revoked(self, node_id: int, serial: int) -> bool:
        """Whether a certificate is refused: the ground has revoked the drone, or given its place to another one."""
        letter = self._table.get(node_id)
        return letter is not None and serial <= letter.last_revoked

    @property
    def revoked_elsewhere(self) -> list[int]:
        """At a base that writes letters: the drones that another copy of `ground.keys` has revoked or replaced under
        the same number of the link key, and this copy has not. Node ids."""
        ground = self._keyring.ground
        if ground is None or ground.number < self.link.number:
            return []
        in_file = {id: serial - (id not in ground.revoked) for id, serial in ground.serials.items()}
        return [id for id, serial in self._table.out().items() if serial > in_file.get(id, 0)]

    def serials(self) -> Mapping[int, int]:
        """By node id, the last serial of a drone that the node's file has; at a drone none."""
        return {} if self._keyring.ground is None else self._keyring.ground.serials

    def packed(self) -> list[bytes]:
        """All letters, to be kept over restarts."""
        return self._table.packed()

    def renew(self, keyring: Keyring) -> None:
        """The node's file has changed. The change takes effect in the next step.

        :raises KeysError: it holds another node's keys, or an older link key.
        """
        before, own = self._keyring.own, keyring.own
        if (own.certificate, own.ground) != (before.certificate, before.ground):
            raise KeysError("the file now holds other keys", "restart the node to use them")
        if own.link.number < self.link.number:
            raise KeysError(
                f"the file now holds link key {own.link.number}, and this node has {self.link.number} already",
                "copy the newest file",
            )
        self._keyring = keyring
        if own.link.number > (self._next or self.link).number:
            self._next = own.link
        self._write()

    def report(self, now: float) -> dict[str, Any]:
        """For `status`."""
        return {
            "number": self.link.number,
            "age_s": None if self.changed_at is None else round(now - self.changed_at, 3),
            "kept": len(self._table),
            "forged": self.forged,
            "revoked": self.revoked,
            "out": [{"node_id": node_id, "serial": serial} for node_id, serial in self._table.out().items()],
            "out_elsewhere": self.revoked_elsewhere,
        }

    def _resume(self) -> None:
        """After a start: letters that were kept may have a later key than the file."""
        ground, own = self._keyring.ground, self._keyring.own
        if ground is not None:
            if self._table.last() > self.link.number:
                self.link = ground.link_key(self._table.last())
            return
        letter = self._table.get(own.certificate.node_id)
        if letter is None or letter.number < self.link.number:
            return
        if letter.last_revoked >= own.certificate.serial:
            self.revoked = True
        elif letter.number > self.link.number and self._opener.is_for_this(letter):
            try:
                self.link = self._opener.open(letter)
            except ForgedError:
                log.warning("a letter that was kept does not open; the node gets it again")

    def _write(self) -> None:
        """At a base: write the letters about the link key in its file, if it was ever changed."""
        ground = self._keyring.ground
        if ground is None or ground.number == 1 or ground.number < self.link.number:
            # Who is out since then is not in this file: letters written from it could let him in.
            return
        for node_id in ground.serials:
            self._table.keep(write_letter(ground, node_id), own=True)

    # -- what comes in -------------------------------------------------------------------------------------------------

    def hear(self, stream: Stream, payload: bytes, now: float) -> None:
        """A letter or a roll from a node with the same link key, in a frame that is new. `stream`: who brings it
        (`Streams.quota_holder`)."""
        if is_letter(payload):
            letter = self._letter_in(payload)
            if letter is None or self._opens(letter) or letter.number != self.link.number:
                return
            held = self._table.get(letter.node_id)
            if held == letter:
                # Somebody else was faster.
                self._queue.sent(letter.node_id)
            elif held is None or letter.rank > held.rank:
                self._inbox.add(stream, letter)
            return
        roll = self._roll_in(payload)
        if roll is None or roll.number != self.link.number:
            return
        if roll.digest == self._table.digest():
            self._rolls.hear_same()
            return
        self._rolls.hear_difference(now)
        for node_id, mark in self._table.marks().items():
            if roll.first <= node_id <= roll.last and roll.named.get(node_id) != mark:
                self._queue.miss(node_id)

    def hear_other_key(self, payload: bytes) -> None:
        """Any payload in a frame that is signed with another key: by one who has missed a change, or is ahead, or by a
        stranger. It may have been sent long ago."""
        inbox = self._inbox
        inbox.other_key = True
        if is_letter(payload):
            letter = self._letter_in(payload)
            if letter is not None and not self._opens(letter) and self._concerns(letter):
                inbox.unproven.append(letter)
        elif is_about_keys(payload) and (roll := self._roll_in(payload)) is not None:
            if roll.number > self.link.number:
                inbox.ahead = True
            elif roll.number < self.link.number:
                inbox.base |= roll.serial == BASE_SERIAL
                letter = self._table.get(roll.node_id)
                self._queue.ask(roll.node_id, letter is not None and letter.number == self.link.number)

    def _letter_in(self, payload: bytes) -> Letter | None:
        try:
            return Letter.unpack(enclosed(payload))
        except MalformedError:
            self.malformed += 1
            return None

    def _roll_in(self, payload: bytes) -> Roll | None:
        try:
            return decode_roll(payload)
        except MalformedError:
            self.malformed += 1
            return None

    def _opens(self, letter: Letter) -> bool:
        """Whether a letter claims to have a later link key for this node. If it has, the node uses it from the next
        step on."""
        if self._keyring.ground is not None or not letter.sealed or not self._opener.is_for_this(letter):
            return False
        if letter.number <= (self._next or self.link).number:
            return False
        try:
            self._next = self._opener.open(letter)
            # Once for each link key: nobody can make a node work with true keys under false signatures.
            letter.verify(self._keyring.own.ground)
        except ForgedError:
            self.forged += 1
        else:
            self._table.keep(letter, own=True)
        return True

    def _concerns(self, letter: Letter) -> bool:
        """Whether a letter from one without the link key is worth a verification: it would tell a base that the key has
        changed, or a drone that it is revoked."""
        if self._keyring.ground is not None:
            return letter.number > self.link.number
        own = self._keyring.own.certificate
        return not self.revoked and letter.node_id == own.node_id and letter.last_revoked >= own.serial

    # -- what goes out -------------------------------------------------------------------------------------------------

    def due(self, now: float, turn_s: float, items: int) -> tuple[list[bytes], list[bytes]]:
        """Do what is due in a step. Returns rolls and letters, as TUNNEL payloads for everybody.

        :param turn_s: seconds between two beacons. :param items: data that the links can carry in that time.
        """
        inbox = self._inbox
        if inbox.other_key or inbox.candidates:
            self._inbox = _Inbox()
            self._verify(inbox.letters(), now)
        if self._next is not None:
            self._change(self._next, now)
        elif inbox.other_key:
            self._answer(inbox, now)
        rolls = []
        if self._rolls.due(now, turn_s, has_letters=len(self._table) > 0):
            own, table = self._keyring.own.certificate, self._table
            bare = Roll(own.node_id, own.serial, self.link.number, table.digest())
            rolls.append(encode_roll(self._rolls.filled_in(bare, table.marks())))
        letters = (self._table.get(node_id) for node_id in self._queue.due(now, turn_s, items))
        return rolls, [enclose(letter.pack()) for letter in letters if letter is not None]

    def _verify(self, letters: Iterable[Letter], now: float) -> None:
        gained = False
        for letter in letters:
            try:
                letter.verify(self._keyring.own.ground)
            except ForgedError:
                self.forged += 1
                continue
            if self._table.keep(letter):
                gained = True
                self._queue.gain(letter.node_id)
                self._heed(letter)
        if gained:
            self._rolls.learn(now)

    def _heed(self, letter: Letter) -> None:
        """What a letter that the ground has written means for this node."""
        own, ground = self._keyring.own.certificate, self._keyring.ground
        if ground is not None:
            if letter.number > (self._next or self.link).number:
                # All link keys are derived from the ground's secret.
                self._next = ground.link_key(letter.number)
                self._tell(_WARNING, "RASS: the link key was changed elsewhere, copy ground.keys from there")
            elif (id := letter.node_id) in self.revoked_elsewhere:
                said = f"RASS: another copy of ground.keys has revoked or replaced drone {id}, see docs/keys.md"
                self._tell(_WARNING, said)
        elif letter.node_id == own.node_id and letter.last_revoked >= own.serial and not self.revoked:
            self.revoked = True
            self._tell(_WARNING, "RASS: the ground has revoked the keys of this drone")

    def _change(self, link: LinkKey, now: float) -> None:
        self._next = None
        self.link = link
        self.changed_at = now
        self._table.use(link.number)
        self._queue.clear()
        self._rolls.change(now)
        self._adopt(self.signing)
        log.info("link key %d from now on", link.number)

    def _answer(self, inbox: _Inbox, now: float) -> None:
        """Frames with another link key were heard."""
        if inbox.base and (current := self._table.current()):
            # Any letter tells a base the number, and so the key.
            self._queue.ask(next(iter(current)), True)
        if not self.revoked:
            self._rolls.hear_other_key(now, ahead=inbox.ahead)


def _nobody(*_: object) -> None:
    """Until a life begins."""

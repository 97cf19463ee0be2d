"""One frame is one frame: a frame that hits a fault is dropped with its effects, and the node continues.

A bug in this program fails loudly, with one exception: no incoming frame may end the node, whether it comes from a
neighbour, the autopilot or the ground. Its sender could send it again after each restart. See
docs/contribute/architecture.md.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable
from traceback import walk_tb
from typing import Any, NamedTuple, Protocol, TypeVar

from rass_mav.agent.settings import AgentSettings
from rass_mav.core.messages import Message, is_vital, sender_of
from rass_mav.core.participant import Participant
from rass_mav.core.store import Store
from rass_mav.errors import StoreDamagedError, StoreError
from rass_mav.mavlink.frames import Frame

log = logging.getLogger(__name__)

# Tuned: python -m tools.sensitivity agent.guard
#: How long a kind of message, or a sender, is muted after its first fault, seconds.
FIRST_MUTE_S = 2.0
#: Bound: The same after many faults, at most.
MOST_MUTE_S = 30.0
#: Bound: If neighbours and routes stay, kinds without which nothing arrives are muted only as long as it takes to limit
#: what the faults cost, seconds: that, and for each datum that a new node has to read.
VITAL_MUTE_S, VITAL_MUTE_PER_DATUM_S = 0.1, 0.001
#: After so long without a fault what is muted is forgotten, and each fault is logged in full again, seconds.
SUSPECT_S = 2.0 * MOST_MUTE_S
#: Kinds and senders remembered. When there are more, the one that is heard again first is forgotten.
MAX_SENDERS = 64
#: Frames that hit a fault, by digest. When there are more, the oldest is forgotten.
MAX_DIGESTS = 256
#: Where neighbours and routes are changed.
_ROUTES = "rass_mav.core.routes."

T = TypeVar("T")
RollBack = Callable[[StoreError], None]


class Host(Protocol):
    """The agent, which receives the frames."""

    settings: AgentSettings
    store: Store

    node: Participant

    def begin_again(self, settings: AgentSettings, now: float, *, keep_routes: bool) -> None:
        """Continue with a new node, after a frame hit a fault and the store rolled back its uncommitted changes."""


class Fault(NamedTuple):
    """A frame whose handling raised."""

    at: float
    """Seconds on the node's timeline."""
    digest: str
    """Of its message id and payload, 16 hexadecimal digits."""
    sender: str
    """What was muted for it, in words."""


class Unguarded:
    """Lets every fault raise: for the mock swarm and the tests, whose purpose is to find faults."""

    __slots__ = ()
    forgiving = False
    """Whether a frame whose handling raises is dropped."""
    faults = 0
    """Frames that hit a fault and were dropped."""
    last: Fault | None = None
    """The last of them."""

    def take(
        self, frame: Frame, now: float, handle: Callable[[Frame, float], T], kind: Callable[[Frame], str]
    ) -> T | None:
        """Handle a frame. Returns the result of `handle`; None: the frame was dropped.

        If `faults` has risen afterwards, drop answers to other frames that have not gone to the gate yet.

        :param kind: says the kind of a frame, and where it came from, in words. One who can send such a frame can send
            it in any name, so that is what is muted.
        """
        return handle(frame, now)

    def shuts_out(self, message: Message, link: str, now: float, *, proven: bool) -> bool:
        """Whether a message is muted. Call it before the node gets the message.

        :param link: from which it came, in words. :param proven: nobody but its sender can have said it.
        """
        return False

    def use(self, roll_back: RollBack) -> None:
        """Set the function that drops uncommitted changes and the frames that depend on them: a commit gate's."""

    def report(self, now: float) -> dict[str, Any] | None:
        """For `status`; None: faults raise here."""
        return None


class Guard(Unguarded):
    """Handles frames for an agent, and lets none of them end it."""

    forgiving = True

    def __init__(self, host: Host) -> None:
        self._host = host
        self._roll_back: RollBack = lambda error: host.store.roll_back()
        self._mutes = Mutes()
        self.digests: dict[str, None] = {}
        self._sender = ""
        """What is blamed for a fault of the current frame."""
        self._vital = False
        """Whether that is a kind of which others' messages are needed."""
        self.faults = 0
        self.dropped = 0
        """Frames dropped without handling: they were muted, came before the changes since the last fault were on disk,
        or the same bytes had raised before."""

    def use(self, roll_back: RollBack) -> None:
        """From now on `roll_back` drops uncommitted changes and the frames that depend on them."""
        self._roll_back = roll_back

    def take(
        self, frame: Frame, now: float, handle: Callable[[Frame, float], T], kind: Callable[[Frame], str]
    ) -> T | None:
        """Handle a frame. Returns the result of `handle`; None: the frame was dropped unhandled, or hit a fault.

        After a fault all changes that were not being written are dropped, and a new node takes over. Errors in this
        recovery are raised. So is `StoreDamagedError`, which the driver handles.
        """
        if self._is_shut_out(kind(frame), now) or (self.digests and _digest(frame) in self.digests):
            self.dropped += 1
            return None
        self._vital = False
        settings = self._host.settings
        try:
            return handle(frame, now)
        except StoreDamagedError:
            raise
        except Exception as error:
            # The only place that catches everything: no frame may end the node, whatever it breaks.
            keep_routes = not _struck(error, _ROUTES)
            if self._mutes.is_news(self._sender, now):
                log.exception(
                    "a frame triggered a fault in this program and was dropped; %s is muted; please report: message %d "
                    "of %d/%d, sequence %d, digest %s, payload %s",
                    self._sender, frame.message_id, frame.system_id, frame.component_id, frame.sequence,
                    _digest(frame), frame.payload.hex(),
                )  # fmt: skip
        self._recover(frame, settings, now, keep_routes=keep_routes)
        return None

    def shuts_out(self, message: Message, link: str, now: float, *, proven: bool) -> bool:
        """Whether a message is muted. If not, a fault is blamed on its sender if that is proven, and otherwise on this
        kind of message from this link."""
        self._vital = not proven and is_vital(message)
        sender = sender_of(message) if proven else None
        if self._is_shut_out(f"{type(message).__name__} from {link}" if sender is None else f"node {sender}", now):
            self.dropped += 1
            return True
        return False

    def _is_shut_out(self, sender: str, now: float) -> bool:
        """Whether this is muted, or could cost others' changes. If not, it is blamed for a fault from now on."""
        self._sender = sender
        if not self._mutes:
            return False
        store = self._host.store
        # What is suspect may drop nothing but its own changes.
        return self._mutes.muted(sender, now) or (sender in self._mutes and store.unwritten and store.accepting)

    def _recover(self, frame: Frame, settings: AgentSettings, now: float, *, keep_routes: bool) -> None:
        sender = self._sender
        self.faults += 1
        self.last = Fault(now, _digest(frame), sender)
        self.digests[self.last.digest] = None
        if len(self.digests) > MAX_DIGESTS:
            del self.digests[next(iter(self.digests))]
        if self._vital and keep_routes:
            cost_s = VITAL_MUTE_S + VITAL_MUTE_PER_DATUM_S * len(self._host.node.holdings)
            self._mutes.raised(sender, now, cost_s, cost_s)
        else:
            self._mutes.raised(sender, now, FIRST_MUTE_S, MOST_MUTE_S)
        self._roll_back(StoreError("not stored: a frame received at the same time triggered a fault; try again"))
        self._host.begin_again(settings, now, keep_routes=keep_routes)
        self._host.store.count("faults")

    def report(self, now: float) -> dict[str, Any]:
        """For `status`: how many frames hit a fault, the last one, and what is muted for how much longer."""
        last = self.last
        return {
            "count": self.faults,
            "last": None
            if last is None
            else {"digest": last.digest, "sender": last.sender, "age_s": round(now - last.at, 3)},
            "muted": {sender: round(left, 3) for sender, left in self._mutes.left(now).items()},
            "frames_dropped": self.dropped,
        }


class _Mute(NamedTuple):
    until: float
    length: float
    """Seconds."""
    forgotten: float
    """When it is forgotten, unless there is another fault."""
    logged: float


class Mutes:
    """What is muted: kinds of messages from a link, and senders that are proven."""

    __slots__ = ("_senders",)

    def __init__(self) -> None:
        self._senders: dict[str, _Mute] = {}

    def __contains__(self, sender: str) -> bool:
        """Whether it has had a fault lately."""
        return sender in self._senders

    def __len__(self) -> int:
        return len(self._senders)

    def muted(self, sender: str, now: float) -> bool:
        """Whether such frames must be dropped."""
        mute = self._senders.get(sender)
        if mute is None:
            return False
        if now >= mute.forgotten:
            del self._senders[sender]
        return now < mute.until

    def is_news(self, sender: str, now: float) -> bool:
        """Whether a fault should be logged in full: once in `SUSPECT_S` is enough."""
        mute = self._senders.get(sender)
        return mute is None or now >= mute.logged + SUSPECT_S

    def raised(self, sender: str, now: float, first_s: float, most_s: float) -> None:
        """Mute it after a fault: for `first_s`, and for twice as long as last time, up to `most_s`, seconds."""
        senders = self._senders
        logged = now if self.is_news(sender, now) else senders[sender].logged
        for other in [other for other, mute in senders.items() if now >= mute.forgotten]:
            del senders[other]
        last = senders.pop(sender, None)
        length = first_s if last is None else min(2.0 * last.length, most_s)
        if len(senders) >= MAX_SENDERS:
            del senders[min(senders, key=lambda other: senders[other].until)]
        senders[sender] = _Mute(now + length, length, now + SUSPECT_S, logged)

    def left(self, now: float) -> dict[str, float]:
        """What is muted, each with the seconds that remain."""
        return {sender: mute.until - now for sender, mute in self._senders.items() if now < mute.until}


def _struck(error: Exception, package: str) -> bool:
    """Whether a function of a package was at work when an error was raised: what it changes may be half done."""
    return any(frame.f_globals.get("__name__", "").startswith(package) for frame, _ in walk_tb(error.__traceback__))


def _digest(frame: Frame) -> str:
    """Equal for frames with the same contents, whatever their sequence number and signature."""
    content = frame.message_id.to_bytes(3, "little") + frame.payload.rstrip(b"\0")
    return hashlib.blake2b(content, digest_size=8).hexdigest()

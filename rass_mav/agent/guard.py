"""One frame is one frame: a frame that hits a fault is dropped with its effects, and the node continues.

A bug in this program fails loudly, with one exception: no incoming frame may end the node, whether it comes from a
neighbour, the autopilot or the ground. Its sender could send it again after each restart. See docs/architecture.md.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, TypeVar

from rass_mav.agent.settings import AgentSettings
from rass_mav.core.store import Store
from rass_mav.errors import StoreDamagedError, StoreError
from rass_mav.mavlink.frames import Frame

log = logging.getLogger(__name__)

#: How long a sender is muted after its first fault, and at most after many, seconds.
FIRST_MUTE_S, MOST_MUTE_S = 2.0, 600.0
#: Senders remembered. When there are more, the one that would be forgotten next is forgotten.
MAX_SENDERS = 64
#: Frames that hit a fault, by digest. When there are more, the oldest is forgotten.
MAX_DIGESTS = 256

T = TypeVar("T")
RollBack = Callable[[StoreError], None]


class Host(Protocol):
    """The agent, which receives the frames."""

    settings: AgentSettings
    store: Store

    def begin_again(self, settings: AgentSettings, sender: str, now: float) -> None:
        """Continue with a new node, after a frame hit a fault and the store rolled back its uncommitted changes."""


class Fault(NamedTuple):
    """A frame whose handling raised."""

    at: float
    """Seconds on the node's timeline."""
    digest: str
    """Of its message id and payload, 16 hexadecimal digits."""
    sender: str
    """In words."""


class Unguarded:
    """Lets every fault raise: for the mock swarm and the tests, whose purpose is to find faults."""

    __slots__ = ()
    forgiving = False
    """Whether a frame whose handling raises is dropped."""
    faults = 0
    """Frames that hit a fault and were dropped."""

    def take(self, frame: Frame, now: float, handle: Callable[[Frame, float], T]) -> T | None:
        """Handle a frame. Returns the result of `handle`; None: the frame was dropped.

        If `faults` has risen afterwards, drop answers to other frames that have not gone to the gate yet.
        """
        return handle(frame, now)

    def shuts_out(self, message: Any, now: float) -> bool:
        """Whether the node that a message names as its sender is muted. Call it before the node gets the message."""
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
        self._digests: dict[str, None] = {}
        self._sender = ""
        """The sender of the current frame."""
        self.faults = 0
        self.dropped = 0
        """Frames dropped without handling: their sender was muted, or the same bytes had raised before."""
        self.last: Fault | None = None

    def use(self, roll_back: RollBack) -> None:
        """From now on `roll_back` drops uncommitted changes and the frames that depend on them."""
        self._roll_back = roll_back

    def take(self, frame: Frame, now: float, handle: Callable[[Frame, float], T]) -> T | None:
        """Handle a frame. Returns the result of `handle`; None: the frame was dropped unhandled, or hit a fault.

        After a fault all changes that were not being written are dropped, and a new node takes over. Errors in this
        recovery are raised. So is `StoreDamagedError`, which the driver handles.
        """
        # One kind of message must not mute the whole autopilot, so the kind is part of the sender's name.
        self._sender = f"component {frame.system_id}/{frame.component_id} (message {frame.message_id})"
        if self._mutes.muted(self._sender, now) or (self._digests and _digest(frame) in self._digests):
            self.dropped += 1
            return None
        settings = self._host.settings
        try:
            return handle(frame, now)
        except StoreDamagedError:
            raise
        except Exception:
            # The only place that catches everything: no frame may end the node, whatever it breaks.
            log.exception(
                "a frame from %s hit a fault in this program and was dropped; please report: message %d of %d/%d, "
                "sequence %d, digest %s, payload %s",
                self._sender, frame.message_id, frame.system_id, frame.component_id, frame.sequence,
                _digest(frame), frame.payload.hex(),
            )  # fmt: skip
        self._recover(frame, settings, now)
        return None

    def shuts_out(self, message: Any, now: float) -> bool:
        """Whether the node that a message names as its sender is muted. If not, that node is blamed for a fault."""
        node_id = getattr(message, "sender", None)
        if node_id is not None:
            self._sender = f"node {node_id}"
            if self._mutes.muted(self._sender, now):
                self.dropped += 1
                return True
        return False

    def _recover(self, frame: Frame, settings: AgentSettings, now: float) -> None:
        sender = self._sender
        self.faults += 1
        self.last = Fault(now, _digest(frame), sender)
        self._digests[self.last.digest] = None
        if len(self._digests) > MAX_DIGESTS:
            del self._digests[next(iter(self._digests))]
        self._mutes.raised(sender, now)
        self._roll_back(StoreError("not stored: a frame received at the same time hit a fault; try again"))
        self._host.begin_again(settings, sender, now)
        self._host.store.count("faults")

    def report(self, now: float) -> dict[str, Any]:
        """For `status`: how many frames hit a fault, the last one, and which senders are muted for how much longer."""
        last = self.last
        return {
            "count": self.faults,
            "last": None
            if last is None
            else {"digest": last.digest, "sender": last.sender, "age_s": round(now - last.at, 3)},
            "muted": {sender: round(left, 3) for sender, left in self._mutes.left(now).items()},
            "frames_dropped": self.dropped,
        }


class Mutes:
    """The muted senders. A sender is forgotten after as long without a fault as it was muted."""

    __slots__ = ("_senders",)

    def __init__(self) -> None:
        # By sender: until when it is muted, and for how long, seconds.
        self._senders: dict[str, tuple[float, float]] = {}

    def muted(self, sender: str, now: float) -> bool:
        """Whether the sender's frames must be dropped."""
        return bool(self._senders) and now < self._senders.get(sender, (now, 0.0))[0]

    def raised(self, sender: str, now: float) -> None:
        """Mute a sender whose frame has hit a fault, for twice as long as last time."""
        senders = self._senders
        for other in [other for other, (until, length) in senders.items() if now >= until + length]:
            del senders[other]
        if sender in senders:
            length = min(2 * senders.pop(sender)[1], MOST_MUTE_S)
        else:
            length = FIRST_MUTE_S
        if len(senders) >= MAX_SENDERS:
            del senders[min(senders, key=lambda other: sum(senders[other]))]
        senders[sender] = (now + length, length)

    def left(self, now: float) -> dict[str, float]:
        """The muted senders, each with the seconds that remain."""
        return {sender: until - now for sender, (until, _) in self._senders.items() if now < until}


def _digest(frame: Frame) -> str:
    """Equal for frames with the same contents, whatever their sequence number and signature."""
    said = frame.message_id.to_bytes(3, "little") + frame.payload.rstrip(b"\0")
    return hashlib.blake2b(said, digest_size=8).hexdigest()

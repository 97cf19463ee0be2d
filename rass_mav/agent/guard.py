"""One frame is one frame: what it breaks is dropped with it, and the node goes on (docs/architecture.md).

A fault of this program fails loudly, with this one exception: frames that come in, from neighbours, the autopilot or
the ground, must not end the node, whatever they are. For who has said a frame can say it again after each restart.
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

#: A sender is muted for so long after its first fault, and at most so long after many, seconds.
FIRST_MUTE_S, MOST_MUTE_S = 2.0, 600.0
#: Senders remembered; beyond it the one that would be forgotten first is.
MAX_SENDERS = 64
#: Frames that hit a fault, by digest; beyond it the oldest is forgotten.
MAX_DIGESTS = 256

T = TypeVar("T")
RollBack = Callable[[StoreError], None]


class Host(Protocol):
    """Whose frames these are: the agent."""

    settings: AgentSettings
    store: Store

    def begin_again(self, settings: AgentSettings, sender: str, now: float) -> None:
        """A frame has hit a fault, and the store forgot what had not been committed: go on with a new node."""


class Fault(NamedTuple):
    """A frame that raised."""

    at: float
    """Seconds on the node's timeline."""
    digest: str
    """Of its message id and payload, 16 hexadecimal digits."""
    sender: str
    """In words."""


class Unguarded:
    """Lets everything raise: for the mock swarm and the tests, which are there to find faults."""

    __slots__ = ()
    forgiving = False
    """Whether a frame that raises is dropped."""
    faults = 0
    """Frames that raised, and were dropped."""

    def take(self, frame: Frame, now: float, handle: Callable[[Frame, float], T]) -> T | None:
        """Have a frame handled. Returns what `handle` does; None: the frame was dropped.

        If `faults` has risen then, what was answered to other frames and has not gone to the gate must not be said.
        """
        return handle(frame, now)

    def shuts_out(self, message: Any, now: float) -> bool:
        """Whether the node that a message names as its sender is muted. To be asked before the node hears it."""
        return False

    def use(self, roll_back: RollBack) -> None:
        """Let `roll_back` drop what has not been committed, and what waits for it: a commit gate's."""

    def report(self, now: float) -> dict[str, Any] | None:
        """For `status`; None: nothing is forgiven here."""
        return None


class Guard(Unguarded):
    """Takes frames for an agent, and lets none of them end it."""

    forgiving = True

    def __init__(self, host: Host) -> None:
        self._host = host
        self._roll_back: RollBack = lambda error: host.store.roll_back()
        self._mutes = Mutes()
        self._digests: dict[str, None] = {}
        self._sender = ""
        """Whom the frame at hand is from."""
        self.faults = 0
        self.dropped = 0
        """Frames that were not taken: their sender was muted, or their bytes had raised before."""
        self.last: Fault | None = None

    def use(self, roll_back: RollBack) -> None:
        """From now on `roll_back` drops what has not been committed, and what waits for it."""
        self._roll_back = roll_back

    def take(self, frame: Frame, now: float, handle: Callable[[Frame, float], T]) -> T | None:
        """Have a frame handled. Returns what `handle` does; None: the frame was not taken, or it raised.

        Then all that was not on its way to the disk is dropped, and a new node has taken over. What goes wrong in that
        is raised, and so is `StoreDamagedError`: the driver knows what to do about it.
        """
        # The autopilot must not fall silent as a whole for one kind of message, so the kind is a part of the name.
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
            # The one place where that is right: whatever a frame breaks, it must not end the node.
            log.exception(
                "a frame from %s hit a fault in this program and was dropped; please report: message %d of %d/%d, "
                "sequence %d, digest %s, payload %s",
                self._sender, frame.message_id, frame.system_id, frame.component_id, frame.sequence,
                _digest(frame), frame.payload.hex(),
            )  # fmt: skip
        self._recover(frame, settings, now)
        return None

    def shuts_out(self, message: Any, now: float) -> bool:
        """Whether the node that a message names as its sender is muted; else that node answers for the frame."""
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
        self._roll_back(StoreError("not stored: a frame that came in at that moment hit a fault; try again"))
        self._host.begin_again(settings, sender, now)
        self._host.store.count("faults")

    def report(self, now: float) -> dict[str, Any]:
        """For `status`: how many frames raised, what the last one was, who is muted and for how much longer."""
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
    """Who is not listened to, and until when. A sender that raises nothing for as long as it was muted is forgotten."""

    __slots__ = ("_senders",)

    def __init__(self) -> None:
        # By sender: until when it is muted, and for how long that is, seconds.
        self._senders: dict[str, tuple[float, float]] = {}

    def muted(self, sender: str, now: float) -> bool:
        """Whether its frames are not to be taken."""
        return bool(self._senders) and now < self._senders.get(sender, (now, 0.0))[0]

    def raised(self, sender: str, now: float) -> None:
        """A frame of it has hit a fault: it is muted, for twice as long as last time."""
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
        """Who is muted, and for how many seconds more."""
        return {sender: until - now for sender, (until, _) in self._senders.items() if now < until}


def _digest(frame: Frame) -> str:
    """The same for frames that say the same thing, whatever their sequence number and signature."""
    said = frame.message_id.to_bytes(3, "little") + frame.payload.rstrip(b"\0")
    return hashlib.blake2b(said, digest_size=8).hexdigest()

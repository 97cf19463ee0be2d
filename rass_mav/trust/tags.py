"""What a node does to prove its words to other nodes, and to doubt theirs: without keys, nothing."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

from rass_mav.core.fingerprints import Fingerprints
from rass_mav.core.messages import Beacon, Message
from rass_mav.core.store import Store
from rass_mav.mavlink.frames import Stream
from rass_mav.wire import encode

if TYPE_CHECKING:
    from rass_mav.trust.acquaintances import Links


class NoTags:
    """For a node without keys. `trust.pairs` has the other one."""

    __slots__ = ()

    prints: ClassVar[Fingerprints] = Fingerprints()
    """What answers to hand-overs confirm."""

    def use(self, links: Links) -> None:
        """Set the streams of the links whose frames are signed."""

    def encoded(self, message: Message, store: Store, now: float) -> list[bytes]:
        """The TUNNEL payloads of a message of this node."""
        return encode(message, now)

    def believed(self, message: Message, payload: bytes, now: float, stream: Stream) -> Message | None:
        """A message that was heard, without what its sender has not said; None: nothing is left of it. `payload`: of
        its TUNNEL. `stream`: in which it came, if it is signed."""
        return message

    def proves(self, message: Message) -> bool:
        """Whether nobody but its sender can have said a message that is `believed`."""
        return False

    def meet(self, node_id: int, now: float, stream: Stream) -> None:
        """A beacon in the name of a node was heard in a stream in which it has not proved itself, or not lately."""

    def shown(self, beacon: Beacon) -> Beacon:
        """This node's own beacon as it leaves."""
        return beacon

    def introduced(self, payload: bytes, now: float, stream: Stream) -> bool:
        """Take a TUNNEL payload that only introduces another node. False: it is something else."""
        return False

    def introductions(self, now: float) -> list[bytes]:
        """What this node has to say of itself now, as TUNNEL payloads for everybody."""
        return []

    def report(self) -> dict[str, Any] | None:
        """For `status`; None: there are no keys."""
        return None


#: It has no state.
OPEN = NoTags()

"""The air between the nodes, as a swarm in virtual time uses it, and what all kinds of it count."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence

from rass_mav.agent.agent import Agent
from rass_mav.agent.outgoing import Outgoing
from rass_mav.agent.peers import Opened
from rass_mav.errors import MalformedError
from rass_mav.mavlink.tunnel import tunnel_from_datagram
from rass_mav.wire import decode, target_of

#: Called with each frame put on the air, and its step.
Record = Callable[[bytes, int], None]
# Bytes of frames that are hashed together: one call for each frame would cost more than its bytes.
_HASH_BYTES = 1 << 14


class Tally:
    """The base class of every air."""

    def __init__(self, record: Record | None) -> None:
        """`record` is called with each frame put on the air and its step, in order."""
        self._record = record
        self._hash = hashlib.sha256()
        self._unhashed = bytearray()
        self.sent = 0
        """Frames put on the air."""
        self.dropped = 0
        """Frames lost, one for each hearer that lost it."""
        self.bytes_sent = 0

    def count(self, frame: bytes, step: int) -> None:
        """A frame is put on the air at `step`."""
        self.sent += 1
        self.bytes_sent += len(frame)
        unhashed = self._unhashed
        unhashed += frame
        if len(unhashed) >= _HASH_BYTES:
            self._take_in()
        if self._record is not None:
            self._record(frame, step)

    @property
    def sha256(self) -> str:
        """SHA-256 over all frames put on the air, in order, in hexadecimal."""
        self._take_in()
        return self._hash.hexdigest()

    def _take_in(self) -> None:
        self._hash.update(self._unhashed)
        self._unhashed.clear()


#: Called with the nodes that have heard a frame, the frame, and the time in seconds.
Heard = Callable[[Sequence[int], bytes, float], None]


class Air(ABC):
    """Takes frames, and determines which nodes hear them, and when."""

    tally: Tally
    """What has been put on the air."""
    at_once = False
    """Whether frames arrive before the next step, except those that others overtake."""

    @abstractmethod
    def arrive(self, t: int, now: float) -> None:
        """Step `t` begins. Frames that were due by now arrive, at the nodes that were in range before it."""

    @abstractmethod
    def rearrange(self) -> None:
        """Nodes have moved."""

    @abstractmethod
    def send(self, node: int, outgoing: Outgoing, now: float) -> None:
        """A node sends a frame to its neighbours."""

    @abstractmethod
    def broadcast(self, sender: int, frame: bytes, now: float) -> None:
        """Put a frame on the air, past the driver of any node."""

    @abstractmethod
    def start(self, node: int, agent: Agent, now: float) -> None:
        """A node is switched on."""

    @abstractmethod
    def stop(self, node: int) -> None:
        """A node goes off: what waits to be sent is gone."""

    @abstractmethod
    def begin_turn(self, node: int, agent: Agent, now: float) -> None:
        """Tell a node, before its turn, what its link can carry."""

    @abstractmethod
    def strike(self, probabilities: Mapping[int, float], now: float) -> None:
        """Radiation strikes at some nodes, each item with this probability, 0..1."""

    @abstractmethod
    def figures(self, seconds: float) -> dict[str, float]:
        """For the summary, after so many seconds; empty: nothing to say."""


def open_datagram(data: bytes, now: float) -> Opened | None:
    """Open a datagram that is exactly one frame with a TUNNEL message, whoever signed it, and decode the message, once
    for all nodes that hear it: each would find the same in it. None: it is anything else."""
    fields = tunnel_from_datagram(data)
    if fields is None:
        return None
    _, _, system, component, payload_type, payload = fields
    try:
        message = decode(payload, now)
    except MalformedError:
        # Each that hears it will count it.
        message = None
    return system, component, payload_type, payload, target_of(payload), message

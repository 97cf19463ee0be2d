"""Which signed frames are new: the streams in which other nodes have proved themselves.

docs/protocol.md ("Signed links") has the rules. All nodes have the link key, a captured drone too, so a signature alone
moves nothing here. Where a stream is, its node shows by proofs (`trust.peers`) and beacon keys
(`trust.beaconkeys`).
"""

from __future__ import annotations

from enum import Enum, auto
from typing import Any, NamedTuple

from rass_mav.mavlink.frames import FrameWriter, Stream
from rass_mav.trust.beaconkeys import MOST_AHEAD
from rass_mav.trust.timestamps import COUNT_BITS, Timestamps
from rass_mav.wire import beacon_sender

#: A frame may have been overtaken by so many beacons of its sender.
LATE = 1
#: Frames of one stream between two beacons that are remembered, to know them again.
MAX_REMEMBERED = 1024
#: Other nodes with this node's system and component id that are remembered.
MAX_TWINS = 16

#: Stands for all streams in which no node has proved itself: nobody has a greater share with many of them.
UNPROVEN: Stream = (0, 0, 0)


class Verdict(Enum):
    """What is known of a frame with a good signature."""

    NEW = auto()
    AGAIN = auto()
    """It was heard before."""
    LATE = auto()
    """It was overtaken by too many beacons, or its sender's disk was set back."""
    UNVERIFIED = auto()
    """Nobody has proved himself in this stream, or it was heard last too long ago."""
    TWIN = auto()
    """It comes from another node with this node's system and component id, or is this node's own."""


class Refused(NamedTuple):
    """How many rightly signed frames changed nothing but this table, by verdict."""

    strange: int
    again: int
    late: int
    twin: int


class _Proven:
    """A stream in which at least one node has proved itself."""

    __slots__ = ("before", "nodes", "recent")

    def __init__(self) -> None:
        self.nodes: dict[int, int] = {}
        """The index of the last beacon of each of these nodes."""
        self.recent: set[int] = set()
        """What was heard since the last beacon, and before that."""
        self.before: set[int] = set()

    def move(self, node_id: int, index: int) -> None:
        self.nodes[node_id] = index
        self.before, self.recent = self.recent, set()


class Streams:
    """The streams that one node hears, and its own. Time is an argument."""

    __slots__ = ("_node_id", "_of", "_refused", "_timestamps", "_writer", "proven", "twins")

    def __init__(self, node_id: int, writer: FrameWriter, timestamps: Timestamps) -> None:
        """`writer`: of the node's own stream, which `timestamps` signs."""
        self._node_id = node_id
        self._writer = writer
        self._timestamps = timestamps
        self.proven: dict[Stream, _Proven] = {}
        self._of: dict[int, Stream] = {}
        """The stream in which a node has proved itself last, by node id."""
        self.twins: dict[int, float] = {}
        """Other nodes with this node's system and component id, by node id: when the last beacon came, seconds."""
        self._refused = dict.fromkeys(Verdict, 0)

    def __len__(self) -> int:
        return len(self.proven)

    @property
    def own(self) -> Stream:
        """The node's own stream."""
        return self._writer.system_id, self._writer.component_id, self._timestamps.link_id

    @property
    def index(self) -> int:
        """Of the node's own last beacon."""
        return self._timestamps.index

    def begin_turn(self, number: int) -> int:
        """As `Timestamps.begin_turn`."""
        return self._timestamps.begin_turn(number)

    @property
    def refused(self) -> Refused:
        """The counts so far."""
        counts = self._refused
        return Refused(counts[Verdict.UNVERIFIED], counts[Verdict.AGAIN], counts[Verdict.LATE], counts[Verdict.TWIN])

    # -- what comes in -------------------------------------------------------------------------------------------------

    def admit(self, stream: Stream, timestamp: int, payload: bytes, now: float) -> Verdict:
        """What is known of a frame.

        :param stream: of a frame whose signature is good.
        :param timestamp: 48 bits.
        :param payload: of its TUNNEL, if it is of the swarm's type; otherwise empty.
        """
        verdict = self._judge(stream, timestamp, payload, now)
        if verdict is not Verdict.NEW:
            self._refused[verdict] += 1
        return verdict

    def _judge(self, stream: Stream, timestamp: int, payload: bytes, now: float) -> Verdict:
        if stream[0] == self._writer.system_id and stream[1] == self._writer.component_id:
            return self._hear_twin(stream, timestamp, payload, now)
        proven = self.proven.get(stream)
        if proven is None:
            return Verdict.UNVERIFIED
        index = timestamp >> COUNT_BITS
        for last in proven.nodes.values():
            if -LATE <= index - last <= MOST_AHEAD:
                break
        else:
            return Verdict.LATE if index < max(proven.nodes.values()) else Verdict.UNVERIFIED
        # By its contents: two frames with one timestamp are two frames.
        mark = hash((timestamp, payload))
        if mark in proven.recent or mark in proven.before:
            return Verdict.AGAIN
        proven.recent.add(mark)
        if len(proven.recent) >= MAX_REMEMBERED:
            proven.before, proven.recent = proven.recent, set()
        return Verdict.NEW

    def _hear_twin(self, stream: Stream, timestamp: int, payload: bytes, now: float) -> Verdict:
        if stream == self.own and timestamp >> COUNT_BITS < self._timestamps.start:
            # A recording of an earlier life.
            return Verdict.LATE
        node_id = beacon_sender(payload)
        if node_id is not None and node_id != self._node_id:
            self.twins.pop(node_id, None)
            self.twins[node_id] = now
            if len(self.twins) > MAX_TWINS:
                del self.twins[next(iter(self.twins))]
        if node_id != self._node_id:
            return Verdict.TWIN
        # It changes nothing but what the node knows of copies of its store.
        self._refused[Verdict.TWIN] += 1
        return Verdict.NEW

    def quota_holder(self, stream: Stream) -> Stream:
        """Who has brought what came in a stream: a node that has proved itself in this one, and in no other one since;
        or `UNPROVEN`, which stands for all others together."""
        return stream if stream in self.proven else UNPROVEN

    def prove(self, node_id: int, stream: Stream, index: int) -> None:
        """A node has just proved itself to this one, in a frame of a stream, and the index of its last beacon. That may
        be lower than before: its disk was set back."""
        if self._of.get(node_id, stream) != stream:
            self.forget(node_id)
        self._of[node_id] = stream
        self.proven.setdefault(stream, _Proven()).move(node_id, index)

    def advance(self, node_id: int, index: int) -> None:
        """A beacon of a node was verified."""
        self.proven[self._of[node_id]].move(node_id, index)

    def forget(self, node_id: int) -> None:
        """What a node has proved counts no more."""
        stream = self._of.pop(node_id, None)
        if stream is not None:
            nodes = self.proven[stream].nodes
            del nodes[node_id]
            if not nodes:
                del self.proven[stream]

    def report(self, now: float) -> dict[str, Any]:
        """For `status`."""
        return {
            "known": len(self.proven),
            "refused": self.refused._asdict(),
            "twins": [{"node_id": node_id, "age_s": round(now - at, 3)} for node_id, at in sorted(self.twins.items())],
        }

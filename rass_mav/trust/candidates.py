"""The names that streams of frames have brought, of nodes that have not proved themselves, and their certificates.

Whoever has the link key can invent names and streams. So each stream may bring one name, and what is verified in a step
is chosen by chance when it is too much.
"""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Iterator

from rass_mav.mavlink.frames import Stream

#: Streams that may each have brought a name: twice as many as there are known streams without a proof (`streams`).
MAX_NAMES = 128
#: Certificates that are verified in a step, and of one node id and one stream. Each takes 0.1 ms here, 3 ms on a Pi
#: Zero.
MAX_VERIFIED, MAX_OF_ONE = 8, 2
#: When more come, one of each of so many streams waits for the next step. Then so many of these are verified as well.
MAX_LATE, LATE_VERIFIED = 64, 4


class Candidates:
    """Node ids by the streams that have brought them. A name is forgotten when no stream holds it any more."""

    __slots__ = ("_by_stream", "_streams")

    def __init__(self) -> None:
        self._by_stream: dict[Stream, int] = {}
        """The longest silent first."""
        self._streams: dict[int, set[Stream]] = {}

    def __contains__(self, node_id: int) -> bool:
        return node_id in self._streams

    def __iter__(self) -> Iterator[int]:
        return iter(self._streams)

    def __len__(self) -> int:
        return len(self._streams)

    def bring(self, node_id: int, stream: Stream) -> int | None:
        """A stream brings a name. Returns the one that is forgotten for it; None: none is."""
        held = self._by_stream
        gone, of = held.pop(stream, None), stream
        if gone is None and len(held) >= MAX_NAMES:
            of = next(iter(held))
            gone = held.pop(of)
        held[stream] = node_id
        self._streams.setdefault(node_id, set()).add(stream)
        if gone is None or (gone, of) == (node_id, stream):
            return None
        streams = self._streams[gone]
        streams.discard(of)
        if streams:
            return None
        del self._streams[gone]
        return gone

    def release(self, node_id: int) -> None:
        """A node has proved itself, or is forgotten."""
        for stream in self._streams.pop(node_id, ()):
            del self._by_stream[stream]

    def disagreement(self) -> str:
        """What is inconsistent, for tests; empty: nothing."""
        pairs = {(stream, node_id) for node_id, streams in self._streams.items() for stream in streams}
        if pairs != set(self._by_stream.items()) or not all(self._streams.values()):
            return "the streams are not those of the names"
        return "too many" if len(self._by_stream) > MAX_NAMES else ""


class Intake:
    """Which certificates are verified in a step."""

    __slots__ = ("_late", "_rng", "_verified")

    def __init__(self, rng: random.Random) -> None:
        self._rng = rng
        self._verified: tuple[Counter[int], Counter[Stream]] = Counter(), Counter()
        """In this step, by the node id in them, and by stream."""
        self._late: dict[Stream, bytes] = {}

    def __len__(self) -> int:
        return len(self._late)

    def takes(self, node_id: int, stream: Stream, packed: bytes) -> bool:
        """Whether a certificate is verified now. If not, it may wait."""
        by_node, by_stream = self._verified
        if by_node.total() < MAX_VERIFIED and max(by_node[node_id], by_stream[stream]) < MAX_OF_ONE:
            by_node[node_id] += 1
            by_stream[stream] += 1
            return True
        if stream not in self._late and len(self._late) >= MAX_LATE:
            del self._late[self._rng.choice(list(self._late))]
        self._late[stream] = packed
        return False

    def begin_step(self) -> list[tuple[Stream, bytes]]:
        """Returns the certificates that have waited and are verified now. The others are dropped."""
        for counts in self._verified:
            counts.clear()
        late, self._late = self._late, {}
        return self._rng.sample(list(late.items()), min(len(late), LATE_VERIFIED))

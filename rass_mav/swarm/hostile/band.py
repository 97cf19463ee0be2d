"""The attackers of one mock swarm: what they overhear, when they are present, and what they put on the air."""

from __future__ import annotations

import random
from collections.abc import Iterable, Iterator, Sequence

from rass_mav.agent.peers import open_datagram
from rass_mav.errors import MalformedError
from rass_mav.mavlink.frames import FrameWriter
from rass_mav.swarm.scenario import HostileSection
from rass_mav.wire import decode, encode

from .attacker import Attacker, Said
from .kinds import KINDS

#: The most frames that an attacker sends in a step: the air has no limit, but a run has an end.
MOST_FRAMES = 300


class _Member:
    def __init__(self, section: HostileSection, attacker: Attacker, payload_type: int) -> None:
        self.section = section
        self.attacker = attacker
        self.left = 0
        self._payload_type = payload_type
        self._writer = FrameWriter(attacker.id % 255 + 1, 191)

    def is_there(self, t: int) -> bool:
        section = self.section
        return section.begin <= t and (section.end is None or t < section.end)

    def frames(self, said: Iterable[Said], now: float) -> Iterator[bytes]:
        for message in said:
            for payload in [message] if isinstance(message, bytes) else encode(message, now):
                if self.left <= 0:
                    return
                self.left -= 1
                yield self._writer.tunnel(payload, payload_type=self._payload_type)


class Band:
    """All attackers. On the air, and in their own frames, they have the ids after those of the nodes."""

    def __init__(
        self, sections: Sequence[HostileSection], *, nodes: int, seed: int, payload_type: int, costs: bool
    ) -> None:
        """`costs`: see `Attacker`."""
        self._members = {
            nodes + index: _Member(
                section,
                KINDS[section.kind](nodes + index, random.Random(f"{seed}:hostile:{index}"), costs=costs),
                payload_type,
            )
            for index, section in enumerate(sections)
        }

    def reach(self, neighbours: Sequence[Sequence[int]]) -> list[Sequence[int]]:
        """Which nodes hear each other: for each node, then for each attacker, the nodes in range."""
        beside = [member.section.near for member in self._members.values()]
        return [*neighbours, *([near, *neighbours[near]] for near in beside)]

    def overhear(
        self, sender: int, frame: bytes, neighbours: Sequence[Sequence[int]], t: int, now: float
    ) -> Iterator[tuple[int, bytes]]:
        """A node sends a frame. Yields what attackers send at once, with the attacker."""
        opened = message = None
        for id, member in self._members.items():
            near = member.section.near
            if not member.is_there(t) or (sender != near and sender not in neighbours[near]):
                continue
            if opened is None:
                opened = open_datagram(frame)
                if opened is None:
                    return
                try:
                    message = decode(opened[3], now)
                except MalformedError:
                    return
            assert message is not None
            for said in member.frames(member.attacker.overhear(message, opened[3], now), now):
                yield id, said

    def turn(self, t: int, now: float) -> Iterator[tuple[int, bytes]]:
        """The attackers' turns. Yields what they send, with the attacker."""
        for id, member in self._members.items():
            member.left = MOST_FRAMES
            if member.is_there(t):
                for said in member.frames(member.attacker.turn(now), now):
                    yield id, said

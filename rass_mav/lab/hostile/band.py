"""The attackers of one mock swarm: what they overhear, when they are present, and what they put on the air."""

from __future__ import annotations

import random
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain
from typing import TYPE_CHECKING

from rass_mav.agent.outgoing import frames_about_links
from rass_mav.agent.peers import Opened, Peers
from rass_mav.agent.seam import KEYLESS
from rass_mav.core.messages import NO_ROUTE, Beacon, Message
from rass_mav.core.pace import Pace
from rass_mav.lab.medium.air import open_datagram
from rass_mav.mavlink.frames import FLAG_SIGNED, FrameWriter
from rass_mav.mavlink.signing import SIGNATURE_SIZE, SigningKey
from rass_mav.store.memory import MemoryStore

from .attacker import Attacker, Disguised, Transmission
from .kinds import KINDS, HostileSection

if TYPE_CHECKING:
    from rass_mav.trust.trust import Keyed, Trust

#: The most frames that an attacker sends in a step: the air has no limit, but a run has an end.
MOST_FRAMES = 300


class _Member:
    def __init__(
        self, section: HostileSection, attacker: Attacker, payload_type: int, trust: Trust | None, step_s: float
    ) -> None:
        """`trust`: of a captured drone, which has the link key and keys of its own; None: it has none."""
        self.section = section
        self.attacker = attacker
        self.left = 0
        self._payload_type = payload_type
        self._writer = FrameWriter(attacker.id % 255 + 1, 191)
        self._store = MemoryStore(attacker.id)
        self._keyed: Keyed | None = None
        self._key: SigningKey | None = None
        self._timestamp = 0
        """Of the last frame in other streams than its own."""
        self._has_beaconed = False
        if trust is not None:
            self._key = trust.key_updates.signing
            start = attacker.rng.getrandbits(15)
            self._keyed = trust.life(attacker.id, self._store, attacker.rng, step_s)
            self._keyed.connect(self._writer, payload_type, start)
            attacker.seals = self._keyed.seals(self._store)
        self._trust = self._keyed or KEYLESS
        self._pace = Pace(step_s, 0, keeps=False)
        self._peers = Peers(attacker.id, self._writer, payload_type, self._trust)
        attacker.content_hashes = self._trust.content_hashes

    def is_there(self, t: int) -> bool:
        section = self.section
        return section.begin <= t and (section.end is None or t < section.end)

    def frames(self, said: Iterable[Transmission], now: float) -> Iterator[bytes]:
        for message in said:
            if isinstance(message, Disguised):
                yield from self._disguised(message, now)
                continue
            if isinstance(message, Beacon):
                message = self._shown(message)
            for payload in self._payloads(message, now):
                if self.left <= 0:
                    return
                self.left -= 1
                for outgoing in frames_about_links([payload], self._writer, self._payload_type):
                    yield self._peers.leaving(outgoing).frame

    def _shown(self, beacon: Beacon) -> Beacon:
        """With a better proof than that of the beacon it imitates, if it can, and its own key if it is its own."""
        keyed = self._keyed
        if keyed is None:
            return beacon
        if beacon.sender == self.attacker.id:
            self._has_beaconed = True
            beacon = keyed.sessions.shown(beacon._replace(number=keyed.signed.timestamps.index + 1 & 0xFFFF))
        return keyed.attestations.routes.shown(beacon)

    def _disguised(self, disguised: Disguised, now: float) -> Iterator[bytes]:
        """Without keys streams mean nothing."""
        system_id, component_id, link_id = disguised.stream
        for payload in self._payloads(disguised.said, now):
            if self.left > 0:
                self.left -= 1
                self._timestamp += 1
                timestamp = self._timestamp if disguised.timestamp is None else disguised.timestamp
                signer = None if self._key is None else self._key.signer(link_id, timestamp)
                yield FrameWriter(system_id, component_id, signer).tunnel(payload, payload_type=self._payload_type)

    def _payloads(self, said: Message | bytes, now: float) -> list[bytes]:
        return [said] if isinstance(said, bytes) else self._trust.encoded(said, self._store, now)

    def hear(self, frame: bytes, opened: Opened, now: float) -> None:
        """Note whose frame it is. If captured: note who asks whether this stream of frames, or this node, is there."""
        attacker, signed = self.attacker, frame[2] & FLAG_SIGNED
        attacker.stream = frame[5], frame[6], frame[-SIGNATURE_SIZE] if signed else 0
        attacker.timestamp = int.from_bytes(frame[-12:-6], "little") if signed else 0
        if self.section.captured:
            self._peers.heard(frame, opened, now)

    def answers(self, now: float) -> Iterator[bytes]:
        """If captured: answer them, and send a beacon if none was sent since the last turn: frames of a drone that has
        not introduced itself are not heard."""
        if self.section.captured and not self._has_beaconed:
            own = Beacon(self.attacker.id, self._store.life, 0, 0, 0, 0, 0, NO_ROUTE, 0, 0, 0, 0, 0, 0, 0)
            yield from self.frames([own], now)
        self._has_beaconed = False
        outgoings = self._peers.about_links(now, self._pace)
        self._trust.released()
        outgoings += frames_about_links(self._trust.turn(())[0], self._writer, self._payload_type)
        for outgoing in outgoings:
            yield self._peers.leaving(outgoing).frame


class Band:
    """All attackers. On the air, and in their own frames, they have the ids after those of the nodes."""

    def __init__(
        self, sections: Sequence[HostileSection], *, nodes: int, seed: int, payload_type: int, costs: bool,
        trusts: Mapping[int, Trust], step_s: float,
    ) -> None:  # fmt: skip
        """`costs`: see `Attacker`. `trusts`: by id, of those that are captured; empty: nobody has keys."""
        self._members = {
            nodes + index: _Member(
                section,
                KINDS[section.kind](nodes + index, random.Random(f"{seed}:hostile:{index}"), costs=costs),
                payload_type,
                trusts.get(nodes + index),
                step_s,
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
        opened = None
        for id, member in self._members.items():
            near = member.section.near
            if not member.is_there(t) or (sender != near and sender not in neighbours[near]):
                continue
            if opened is None:
                opened = open_datagram(frame, now)
                if opened is None:
                    return
            member.hear(frame, opened, now)
            _, _, _, payload, _, message = opened
            if message is None:
                continue
            for said in member.frames(member.attacker.overhear(message, payload, now), now):
                yield id, said

    def turn(self, t: int, now: float) -> Iterator[tuple[int, bytes]]:
        """The attackers' turns. Yields what they send, with the attacker."""
        for id, member in self._members.items():
            member.left = MOST_FRAMES
            if member.is_there(t):
                for said in chain(member.answers(now), member.frames(member.attacker.turn(now), now)):
                    yield id, said

"""What all attackers have in common: they overhear a place, know the protocol, and send what they like."""

from __future__ import annotations

import random
from collections.abc import Iterable
from typing import Any, NamedTuple

from rass_mav.core.messages import NO_ROUTE, Beacon, Committed, Data, DeletionReport, Message, Offer
from rass_mav.core.routes.neighbours import is_base
from rass_mav.core.seals import NO_SEALS, ContentHashes
from rass_mav.mavlink.frames import Stream


class Disguised(NamedTuple):
    """What an attacker that has the link key sends in another stream than its own."""

    stream: Stream
    said: Message | bytes
    timestamp: int | None = None
    """Of its signature; None: one more than that of the last such frame."""


#: What an attacker sends: a message, or a payload that is none of ours.
Transmission = Message | bytes | Disguised
#: How many recent senders and data an attacker remembers.
MAX_REMEMBERED = 4096


class Attacker:
    """One attacker. It hears all frames of the nodes around it, whatever their target; it does not hear other
    attackers."""

    def __init__(self, id: int, rng: random.Random, *, costs: bool) -> None:
        """`id`: the node id in its frames. `costs`: whether the swarm's policy has potentials that add up, so that
        lower is better."""
        self.id = id
        self.rng = rng
        self.costs = costs
        self.beacons: dict[int, Beacon] = {}
        """The last beacon of each sender overheard."""
        self.content_hashes = ContentHashes()
        """What its answers confirm."""
        self.seals = NO_SEALS
        """What its own keys do, if it is captured."""
        self.stream: Stream = (0, 0, 0)
        self.timestamp = 0
        """Of the frame that it hears now; 0 if that is not signed."""
        self._number = rng.getrandbits(16)
        self.begin()

    def begin(self) -> None:
        """Set up what else it remembers."""

    def overhear(self, message: Message, payload: bytes, now: float) -> Iterable[Transmission]:
        """A frame of a nearby node. Returns what the attacker sends at once: it is heard before any answer is."""
        if isinstance(message, Beacon) and (message.sender in self.beacons or len(self.beacons) < MAX_REMEMBERED):
            self.beacons[message.sender] = message
        return ()

    def turn(self, now: float) -> Iterable[Transmission]:
        """Once a step, after the turns of the honest nodes. Returns what it sends."""
        return ()

    # -- common actions ------------------------------------------------------------------------------------------------

    def base(self) -> Beacon | None:
        """A base's beacon, or that of a node with a route to one; None: none was overheard."""
        beacons = [b for b in self.beacons.values() if b.hops != NO_ROUTE]
        return min(beacons, key=lambda b: (b.hops, b.sender), default=None)

    def nodes(self) -> list[Beacon]:
        """The drones overheard."""
        return [beacon for beacon in self.beacons.values() if not is_base(beacon)]

    def beacon(self, template: Beacon, **changes: int) -> Beacon:
        """A beacon of its own, like another one except for some fields."""
        self._number = (self._number + 1) & 0xFFFF
        own: dict[str, Any] = {"sender": self.id, "life": self.id, "number": self._number, "flags": 0, "wanted_base": 0}
        return template._replace(answers=(), **{**own, "wanted_number": 0, **changes})

    def take(self, message: Message) -> Iterable[Transmission]:
        """Confirm whatever is handed over to it."""
        taken: tuple[tuple[int, int], ...] = ()
        if isinstance(message, Data) and message.target == self.id:
            content_hashes = self.content_hashes
            taken = tuple(
                (number, content_hashes.of(datum, replica=message.replica))
                for number, datum in message.handovers
                if number
            )
        elif isinstance(message, Offer) and message.target == self.id:
            taken = ((message.number, message.crc),)
        elif isinstance(message, DeletionReport) and message.target == self.id:
            taken = tuple(
                (entry.number, self.content_hashes.of_note(entry.id, entry.reason)) for entry in message.entries
            )
        else:
            return ()
        return (Committed(self.id, message.sender, taken, ()),)

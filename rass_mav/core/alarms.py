"""What people at the ground station should know: the node has heard or found something that honest, sound nodes cannot
cause."""

from __future__ import annotations

import enum

#: How many other nodes under its own id a node remembers.
MAX_RIVALS = 16


class Alarm(enum.Enum):
    """A kind of trouble; its value is the text for the ground station."""

    DENIED = "a base claims data that this node never created"
    """A receipt names numbers that this origin has not assigned."""
    FORGED = "receipts in this base's name for data that it does not have"
    """Another node sends in its name, or its store has lost data."""
    ID_CONFLICT = "another node created data under this node's numbers"
    """Data on offer have numbers of this node that it has not assigned yet."""
    TWO_CONTENTS = "two contents under one datum id, both kept"
    UNCONFIRMED = "data of this node that no base confirms"
    """They were handed over long ago, a base is in reach, and no base states that it has them."""
    UNSEALED = "data without a seal of the drone that they name, kept apart"
    """They came to this base. It keeps some of them apart, and they do not count as arrived."""
    UNKNOWN = "data may have been created that no node knows of"
    """A node that lost count of its numbers reports from which one on."""
    DAMAGED = "the store of a node was damaged"
    """A node reports it, and how many data may be lost."""


class Alarms:
    """How often each kind was raised in this life, and what the last one was about."""

    __slots__ = ("about", "clones", "counts", "echoes", "rivals")

    def __init__(self) -> None:
        self.counts: dict[Alarm, int] = {}
        self.about: dict[Alarm, str] = {}
        """A few words about the last one: an id, a base."""
        self.rivals: dict[int, float] = {}
        """Lives of other nodes heard under this node's id, and when they were last heard, seconds."""
        self.echoes = 0
        """Own beacons that came back."""
        self.clones = 0
        """Beacons of this node's id and life that it has not sent: of a node that runs on a copy of its store, or from
        before its last start."""

    def ring(self, alarm: Alarm, about: str) -> None:
        """It has happened once more."""
        self.counts[alarm] = self.counts.get(alarm, 0) + 1
        self.about[alarm] = about

    def rival(self, life: int, now: float) -> None:
        """A beacon of another node has this node's id."""
        if len(self.rivals) >= MAX_RIVALS and life not in self.rivals:
            self.rivals.clear()
        self.rivals[life] = now

"""What people at the ground should know of: the node has heard or found what cannot be among honest, sound nodes."""

from __future__ import annotations

import enum

#: How many other nodes under its own id a node remembers.
MAX_RIVALS = 16


class Alarm(enum.Enum):
    """A kind of trouble; its value is what the ground is told."""

    DENIED = "a base claims data that this node never made"
    """A receipt names numbers that this origin has not given."""
    SQUATTED = "somebody made data under this node's numbers"
    """Data on offer bear own numbers that have not been given."""
    TWO_CONTENTS = "two contents under one datum id, both kept"
    UNCONFIRMED = "data of this node that no base confirms"
    """They were handed on long ago, a base is in reach, and none says that it has them."""
    UNKNOWN = "data may have been made that nobody knows of"
    """A node that lost count of its numbers says from which one on."""
    DAMAGED = "the store of a node was damaged"
    """A node says so, and how many data may be lost."""


class Alarms:
    """How often each kind was raised in this life, and what the last one was about."""

    __slots__ = ("about", "counts", "echoes", "rivals")

    def __init__(self) -> None:
        self.counts: dict[Alarm, int] = {}
        self.about: dict[Alarm, str] = {}
        """A few words on the last one: an id, a base."""
        self.rivals: dict[int, float] = {}
        """Lives of other nodes heard under this node's id, and when last, seconds."""
        self.echoes = 0
        """Own beacons that came back."""

    def ring(self, alarm: Alarm, about: str) -> None:
        """It has happened once more."""
        self.counts[alarm] = self.counts.get(alarm, 0) + 1
        self.about[alarm] = about

    def rival(self, life: int, now: float) -> None:
        """A beacon of another node bears this node's id."""
        if len(self.rivals) >= MAX_RIVALS and life not in self.rivals:
            self.rivals.clear()
        self.rivals[life] = now

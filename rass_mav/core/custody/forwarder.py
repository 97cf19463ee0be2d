"""What a node remembers of one neighbour that has taken data from it, and what it makes of it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from rass_mav.core.datum import DatumId
from rass_mav.core.messages import NO_ROUTE

#: Each datum that is judged makes those judged before count for this much less.
FADE = 1 / 12
#: The data of one sender count in full from this many on,
MATURE = 4.0
#: and before any is judged it counts for this many senders that all goes well.
PRIOR = 0.25
#: From so many of the node's own data on, older ones counting less, a neighbour delivers at least as large a share as
#: of these,
OWN = 2.0
#: until so many samples, older ones counting less, show that others' data were no junk,
REAL = 1.5
#: and at least so many for each that shows nothing: it may have been junk, or was dropped behind the other neighbour.
REAL_EACH = 0.5
#: A neighbour that delivers less than this share is suspected.
SUSPECTED = 0.5
#: A suspected neighbour that failed again is left alone for as long as it had time, twice as long each time, up to this
#: many times.
MOST_DOUBLINGS = 3
#: A suspected neighbour may have twice as many data with each one that arrives. With this many it is suspected no more.
TRUSTED = 16
#: So many data a neighbour may have that has not delivered any yet, if others like it did not deliver: names are free.
NEW = 1
#: The most senders for each neighbour that a node remembers.
MAX_CUSTODIANS = 8


class HandedOver(NamedTuple):
    """A datum that a neighbour took."""

    to: int
    received_from: int | None
    since: int
    """By the forwarder's clock."""
    turn: int
    """By the node's."""
    before: int | None
    """Who took it before and did not deliver it: its confirmation may be due to that one."""


class Forwarder:
    """One neighbour."""

    __slots__ = (
        "clock",
        "custodians",
        "failed",
        "hops",
        "late",
        "new",
        "open",
        "probe",
        "real",
        "rests_until",
        "suspected",
        "suspected_for_others",
        "suspected_since",
        "unknown",
        "window",
    )  # fmt: skip

    def __init__(self) -> None:
        self.clock = 0
        """Turns in which it could have delivered."""
        self.open: dict[DatumId, HandedOver] = {}
        """What it took and has not been judged, the oldest first."""
        self.late: dict[DatumId, HandedOver] = {}
        """What was overdue and may still arrive, the oldest first."""
        self.custodians: dict[int | None, tuple[float, float]] = {}
        """By the node that the data were from: how many arrived, and how many were overdue; older ones count less."""
        self.probe: DatumId | None = None
        """Which of the overdue data should be handed over to another neighbour."""
        self.real = 0.0
        """Samples that arrived soon by another neighbour,"""
        self.unknown = 0.0
        """and those that did not; older ones count less."""
        self.new = True
        """Whether it has delivered nothing yet."""
        self.hops = NO_ROUTE
        """How far from a base it was when it was last heard."""
        self.suspected = False
        self.suspected_for_others = False
        """While it is suspected: whether it delivered the node's own data."""
        self.suspected_since = 0
        """By its clock."""
        self.window = 1
        """While it is suspected: how many data it may have at a time."""
        self.failed = 0
        """While it is suspected: how often it failed in a row."""
        self.rests_until = 0
        """While it is suspected: when it may have the next one, by the node's turns."""

    # -- what it delivers ----------------------------------------------------------------------------------------------

    def count(self, custodian: int | None, *, good: float = 0.0, bad: float = 0.0) -> None:
        """A datum from a sender is judged, or judged otherwise than before."""
        custodians = self.custodians
        was = custodians.pop(custodian, (0.0, 0.0))
        fade = 1.0 - FADE
        if len(custodians) >= MAX_CUSTODIANS:
            del custodians[min(custodians, key=lambda other: sum(custodians[other]))]
        custodians[custodian] = (fade * was[0] + good, max(0.0, fade * was[1] + bad))

    def probed(self, *, arrived: bool) -> None:
        """A datum that it did not deliver was handed over to another neighbour. `arrived`: soon after that."""
        fade = 1.0 - FADE
        self.real = fade * self.real + arrived
        self.unknown = fade * self.unknown + (not arrived)

    @property
    def delivers(self) -> float:
        """The chance that it delivers what it takes, 0..1."""
        if self.real >= max(REAL, REAL_EACH * self.unknown):
            return self.of_others
        return max(self.of_own, self._mean(self.custodians))

    @property
    def of_others(self) -> float:
        """The share that it delivers of what others gave to the node, 0..1."""
        return self._mean(custodian for custodian in self.custodians if custodian is not None)

    def _mean(self, custodians: Iterable[int | None]) -> float:
        """The share that it delivers of each sender's data, 0..1, the mean."""
        weight = share = PRIOR
        for custodian in custodians:
            good, bad = self.custodians[custodian]
            judged = good + bad
            if judged > 0.0:
                counts = min(1.0, judged / MATURE)
                weight += counts
                share += counts * good / judged
        return share / weight

    @property
    def of_own(self) -> float:
        """The share that it delivers of the node's own data, 0..1; 0: of too few to tell."""
        good, bad = self.custodians.get(None, (0.0, 0.0))
        return good / (good + bad) if good + bad >= OWN else 0.0

    # -- while it is suspected
    # -------------------------------------------------------------------------------------------

    def suspect(self, rests_until: int) -> None:
        """From now on. `rests_until`: when it may have a datum again, by the node's turns."""
        self.suspected = True
        self.suspected_for_others = self.of_own >= SUSPECTED
        self.suspected_since = self.clock
        self.window = 1
        self.failed = 0
        self.rests_until = rests_until

    def delivered(self, given: HandedOver) -> None:
        """It delivered a datum in time."""
        if self.suspected_for_others and given.received_from is None:
            # It has always delivered these.
            return
        self.window *= 2
        self.failed = 0
        self.rests_until = 0
        if self.window >= TRUSTED:
            self.suspected = False
            self.custodians.clear()

    def dropped(self, given: HandedOver, turn: int, longest: int) -> None:
        """A datum is overdue in this turn of the node. `longest`: after that many turns it may have another one."""
        if given.since >= self.suspected_since and turn >= self.rests_until:
            self.rests_until = min(turn + (self.clock - given.since << self.failed), given.turn + longest)
            self.failed = min(self.failed + 1, MOST_DOUBLINGS)
        self.window = 1

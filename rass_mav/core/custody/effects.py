"""Effects: what the parts of a node ask it to do.

Replicas and percolation decide, and yield one of these for each decision. `Node` applies them one by one, in the order
of Alg. 1, so the next decision sees what the one before it has changed. No part that decides takes, drops or retires a
copy itself, or tells a neighbour; the notes on a copy (when to ask, whom it waits for) it keeps itself.
"""

from __future__ import annotations

from typing import NamedTuple

from rass_mav.core.custody.holdings import Holding, Pending, ReplicaOffer
from rass_mav.core.datum import DatumId, Fate
from rass_mav.core.exchange import Question
from rass_mav.core.messages import CopyStatus, Distance


class Search(Question):
    """A datum that this node asks others for: one node, or all while none is known to have a good copy."""

    __slots__ = ("holder", "others", "own")

    def __init__(self, id: DatumId, to: int, due: float, *, own: bool) -> None:
        super().__init__(id, id, to, due)
        self.holder = to
        """The node that should have a replica, until it has said that it has none; BROADCAST: none is known."""
        self.own = own
        """Whether it was in custody here; False: a custodian asked this node for it, and it had no good copy."""
        self.others: set[int] = set()
        """Nodes that asked for it too, and leave it to this one."""


class Hand(NamedTuple):
    """A datum is to be handed over to a neighbour, or a replica of it to be sent."""

    holding: Holding
    to: int
    offer: ReplicaOffer | None = None
    """The replica that is offered; None: custody is handed over."""
    distance: Distance | None = None
    """Of a distant replica."""
    again: Pending | None = None
    """The hand-over that is repeated."""


class Drop(NamedTuple):
    """A copy here is to go."""

    holding: Holding
    fate: Fate


class Take(NamedTuple):
    """Custody of a datum is to be taken (again), if there is a good copy of it here, which may be an overheard one."""

    id: DatumId


class Count(NamedTuple):
    """From now on this node counts on the replica that another node keeps of a copy here."""

    holding: Holding
    on: int


class Retire(NamedTuple):
    """No custodian counts on a replica here any more."""

    holding: Holding


class Lose(NamedTuple):
    """A datum whose copy in custody here was corrupt is not to be had from others either."""

    id: DatumId


class Ask(NamedTuple):
    """A neighbour, or all of them, are to be asked for a good copy of a datum."""

    search: Search


class Tell(NamedTuple):
    """A neighbour is to learn the status of a copy, or is asked for that of its own."""

    to: int
    id: DatumId
    status: CopyStatus


Effect = Hand | Drop | Take | Count | Retire | Lose | Ask | Tell

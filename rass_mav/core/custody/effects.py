"""What the parts of custody ask the node to do: they decide, and `Sender` does it, in the order of Alg. 1."""

from __future__ import annotations

from typing import NamedTuple

from rass_mav.core.custody.holdings import Holding, Pending, ReplicaOffer
from rass_mav.core.messages import Distance


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

"""Virtual stigmergy (Buzz; Pinciroli and Beltrame, 2016): every node keeps every datum it has room for."""

from __future__ import annotations

from itertools import islice

from rass_mav.core.messages import BROADCAST
from rass_mav.core.policy import Transfer, View

from .fitness import policy_tag
from .settings import Kind


class Stigmergy:
    """A shared key-value store without a centre: what is new is broadcast once by whoever learned it.

    Conflicts are resolved by `wins`. There is no base: it is a peer with an ordinary store. Nothing is deleted.
    """

    name = "stigmergy"
    replicates = True
    costs = None
    risk_gain = 1.0
    seq_period = 30
    own_share = 0.0
    tag = policy_tag(name)

    def potential(self, hops: int, risk: float, free: int) -> int:
        """Nobody is fitter than anybody: 1 with room, 0 without."""
        return 1 if free > 0 else 0

    def plan(self, view: View) -> list[Transfer]:
        """Broadcast what is new, first in first out, within the budget."""
        ids = list(islice(view.fresh, view.budget))
        for id in ids:
            del view.fresh[id]
        return [Transfer(id, BROADCAST, False) for id in ids]


# The paper's second benchmark.
POLICIES = (Kind(Stigmergy.name, 3, lambda settings: Stigmergy()),)

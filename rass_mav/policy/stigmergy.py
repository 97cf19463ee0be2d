"""Virtual stigmergy (Buzz; Pinciroli and Beltrame, 2016): every node keeps every datum it has space for."""

from __future__ import annotations

from rass_mav.core.policy import Dispatch, View

from .fitness import policy_tag
from .settings import PolicyKind


class Stigmergy:
    """A shared key-value store without a centre: `rass_mav.core.stigmergy` does the work."""

    name = "stigmergy"
    replicates = True
    costs = None
    risk_gain = 1.0
    seq_period = 30
    own_share = 0.0
    tag = policy_tag(name)

    def potential(self, hops: int, risk: float, free: int) -> int:
        """All nodes are equally fit: 1 with space, 0 without."""
        return 1 if free > 0 else 0

    def plan(self, view: View) -> list[Dispatch]:
        """Nothing is handed over."""
        return []


# The paper's second benchmark.
POLICIES = (PolicyKind(Stigmergy.name, 3, lambda settings: Stigmergy()),)

"""A blast: the drones around the fullest store die at once. It measures what the swarm keeps in one place only."""

from __future__ import annotations

from collections.abc import Sequence

from rass_mav.core.custody.holdings import Holdings
from rass_mav.core.datum import DatumId
from rass_mav.lab.swarm.ledger import Ledger

#: Younger data are left out of the figures: they may still be on the way to their first replica.
OLD_STEPS = 5


class Blast:
    """Where it strikes depends on what the nodes do, unlike other failures: it is aimed at the data."""

    def __init__(self, ledger: Ledger) -> None:
        self._ledger = ledger
        self._drones = 0
        self._old: set[DatumId] = set()
        self._gone: set[DatumId] = set()

    def aim(self, holdings: Sequence[Holdings], neighbours: Sequence[Sequence[int]], bases: int) -> list[int]:
        """The drones within radio range of the one that holds the most data which have not arrived, and that one.

        `holdings`, `neighbours`: by node id; nodes 0 .. bases - 1 are bases, which survive. Replicas count. Among
        equally full drones it is the one with the lowest id.
        """
        arrived = self._ledger.arrived
        drones = range(bases, len(holdings))
        if not drones:
            return []
        centre = max(drones, key=lambda node: (sum(id not in arrived for id in holdings[node]), -node))
        return sorted(node for node in {centre, *neighbours[centre]} if node >= bases)

    def begins(self, drones: int) -> None:
        """So many drones are about to die."""
        ledger = self._ledger
        self._drones = drones
        held = (id for id in ledger.copies if id not in ledger.arrived)
        self._old = {id for id in held if ledger.born[id] <= ledger.step - OLD_STEPS}

    def is_over(self) -> None:
        """They are dead."""
        self._gone = self._old - self._ledger.copies.keys()

    def figures(self) -> dict[str, int]:
        """For the summary: `drones` that it killed; data of at least `OLD_STEPS` steps that were `held` by drones and
        had not arrived; those of them that are `lost` because all copies were on these drones."""
        lost = sum(id in self._ledger.lost for id in self._gone)
        return {"drones": self._drones, "held": len(self._old), "lost": lost}

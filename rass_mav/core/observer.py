"""What a node reports to an observer (the mock swarm's global ledger, a log)."""

from __future__ import annotations

from rass_mav.core.datum import Datum, DatumId, Fate


class Observer:
    """Does nothing; override the methods of interest. They are called while the change is made, before it is
    durable."""

    def created(self, datum: Datum) -> None:
        """A datum was created here."""

    def overflow(self) -> None:
        """A new measurement was refused for lack of space; it never got an id."""

    def gained(self, datum: Datum) -> None:
        """A copy is held here now (its own new datum too)."""

    def dropped(self, id: DatumId, fate: Fate) -> None:
        """A copy is not held here any more."""

    def declined(self, id: DatumId) -> None:
        """A datum sent without custody found no space here."""

    def delivered(self, datum: Datum) -> None:
        """A datum arrived here, at a base, for the first time; or again, after its bytes here had been damaged."""

    def kept_apart(self, datum: Datum) -> None:
        """Another content arrived here, at a base, under the id of a datum that has arrived; both are kept."""

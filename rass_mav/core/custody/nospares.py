"""What custody asks of spare copies, answered for a node that keeps none. `rass_mav.core.spares` answers otherwise."""

from __future__ import annotations

from rass_mav.core.custody.holdings import Holding
from rass_mav.core.datum import Datum, DatumId
from rass_mav.core.messages import Committed, Message, PassedOn, Words


class NoSpares:
    """Nobody keeps spares, here or for this node."""

    __slots__ = ()

    # -- what happens to custody ---------------------------------------------------------------------------------------

    def make_way(self, size: int) -> None:
        """A datum of `size` bytes of payload comes into custody: let go of spares until it fits beside the rest."""

    def took(self, holding: Holding, giver: int | None = None) -> None:
        """A datum is in custody now. `giver`: who handed it over, and keeps its copy as a spare."""

    def take_back(self, holding: Holding) -> None:
        """A spare, if this is one, comes into custody: somebody offers it, or holds it for lost."""

    def rescue(self, holding: Holding) -> None:
        """Bases were told that a datum is lost of which a copy is here."""

    def gave(self, holding: Holding, to: int) -> bool:
        """A neighbour has taken custody. Whether the copy here stays, as its spare."""
        return False

    def not_here(self, id: DatumId, asker: int) -> None:
        """Tell a node that hands over a datum which was taken before that it has been passed on since."""

    def left(self, holding: Holding) -> None:
        """A datum is about to leave custody: its backer is told that it need not be counted on."""

    def repair(self, holding: Holding) -> bool:
        """The copy in custody is corrupt. Whether others are asked for the datum; if not, it is lost here."""
        return False

    def let_go(self, holding: Holding, *, missing: bool) -> None:
        """A spare is about to go. `missing`: who counts on it is told."""

    # -- what is said --------------------------------------------------------------------------------------------------

    def keep(self, giver: int, datum: Datum) -> bool:
        """A custodian sends a spare copy. Whether it can rely on this node."""
        return False

    def answered(self, message: Committed, now: float, out: list[Message]) -> None:
        """A neighbour took spares, or refused them. Numbers that are not of offers are ignored."""

    def on_passed_on(self, message: PassedOn) -> None:
        """A custodian has passed data on."""

    def on_words(self, message: Words, now: float, out: list[Message]) -> None:
        """A custodian or a backer says something about data."""

    def step(self, now: float) -> None:
        """Once a step."""

    def detours(self) -> list[tuple[Holding, int]]:
        """What has come back into custody for want of a receipt since the last time, and to whom it goes now."""
        return []

    def figures(self) -> dict[str, int]:
        """What was counted in this life, by name, for `status`."""
        return {}

    def spread(self, now: float, out: list[Message]) -> None:
        """Send spares of what rests without a backer, within the bandwidth."""

    def flush(self, out: list[Message]) -> None:
        """What is to be said since the last time."""

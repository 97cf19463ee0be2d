"""The interface of replicas as custody uses it, for a node that keeps none. `rass_mav.core.replicas` has the
other."""

from __future__ import annotations

from collections.abc import Iterable

from rass_mav.core.custody.holdings import Holding
from rass_mav.core.datum import Datum, DatumId
from rass_mav.core.messages import Committed, CopyStatuses, Distance, Handover, Message, PassedOn, Summary
from rass_mav.core.news.table import Pair


class NoReplicaMessages:
    """There is nothing to say about replicas."""

    __slots__ = ()

    def flush(self, out: list[Message]) -> None:
        """Append the messages collected since the last call."""


class NoReplicas:
    """No replicas are kept, here or for this node."""

    __slots__ = ("messages", "overheard")

    def __init__(self) -> None:
        self.messages = NoReplicaMessages()
        """Those about replicas that wait to be sent."""
        self.overheard: dict[DatumId, Datum] = {}
        """Data that others handed over to each other, and that are kept here in memory; the oldest first."""

    # -- changes of custody --------------------------------------------------------------------------------------------

    def make_way(self, size: int) -> None:
        """A datum of `size` bytes of payload comes into custody: drop replicas until it fits beside the rest."""

    def took(self, holding: Holding, custodian: int | None = None) -> None:
        """A datum is now in custody. `custodian`: the node that handed it over, and keeps its copy as a replica."""

    def take_back(self, holding: Holding) -> None:
        """If this is a replica, take custody of it: a node offers it, or believes that it is lost."""

    def rescue(self, holding: Holding) -> None:
        """A datum was reported lost to a base, but a copy is here."""

    def gave(self, holding: Holding, to: int) -> bool:
        """A neighbour has taken custody. Returns whether the copy here stays, as its replica."""
        return False

    def not_here(self, id: DatumId, asker: int) -> None:
        """Tell a node that hands over a datum which was accepted before that the datum has been passed on since."""

    def left(self, holding: Holding) -> None:
        """A datum is about to leave custody: its holder is told that nobody counts on its replica any more."""

    def repair(self, holding: Holding) -> bool:
        """The copy in custody is corrupt. Returns whether others are asked for the datum; if not, it is lost here."""
        return False

    def let_go(self, holding: Holding, *, missing: bool, confirmed: bool) -> None:
        """A replica is about to go. `missing`: tell the custodian that counts on it. `confirmed`: because its datum has
        arrived, by what bases report."""

    # -- overheard data ------------------------------------------------------------------------------------------------

    def overhear(self, sender: int, handovers: Iterable[Handover], now: float) -> None:
        """A neighbour sends data to another node."""

    def recover(self, id: DatumId) -> Holding | None:
        """A datum was reported lost that is not held here: take custody of it, if it was overheard."""
        return None

    def apply(self, changed: set[Pair]) -> None:
        """Receipts brought news about these (origin, epoch) pairs."""

    def apply_summary(self, summary: Summary) -> None:
        """A base reports what has arrived lately."""

    # -- messages ------------------------------------------------------------------------------------------------------

    def keep(self, custodian: int, datum: Datum, distance: Distance | None) -> bool:
        """A custodian sends a replica, or another node a distant one. Returns whether it can rely on this node."""
        return False

    def answered(self, message: Committed, now: float, out: list[Message]) -> None:
        """A neighbour took replicas, or refused them. Other numbers are ignored."""

    def on_passed_on(self, message: PassedOn) -> None:
        """A custodian has passed data on."""

    def on_copy_statuses(self, message: CopyStatuses, now: float, out: list[Message]) -> None:
        """A custodian or a holder reports something about data."""

    def step(self, now: float) -> None:
        """Once a step."""

    def detours(self) -> list[tuple[Holding, int]]:
        """Data that came back into custody for lack of a receipt since the last call, and the neighbours they go to
        now."""
        return []

    def figures(self) -> dict[str, int]:
        """Counters of this life, by name, for `status`."""
        return {}

    def spread(self, now: float, out: list[Message]) -> None:
        """Send replicas of data that rest without a holder, within the bandwidth."""

    def spread_far(self, now: float, out: list[Message]) -> None:
        """Once a turn: send distant replicas, within the bandwidth that is left."""

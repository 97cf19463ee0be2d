"""Repairs: a copy in custody was found corrupt, and the node looks for a good one.

It asks the holder first. If there is none, or the holder has no good copy either, it asks all neighbours: data leave
replicas behind on their route, and a node that has one takes the datum back. A holder without a
good copy asks its own neighbours too, because nodes that had it earlier may be out of the custodian's range. After
`MAX_TRIES` a node gives the datum up.

No other node relies on a search. Finding a replica once too often creates one copy too many.
"""

from __future__ import annotations

from itertools import islice
from typing import NamedTuple

from rass_mav.core.custody.custody_store import CustodyStore
from rass_mav.core.custody.holdings import State
from rass_mav.core.datum import DatumId, Fate
from rass_mav.core.messages import BROADCAST, CopyStatus
from rass_mav.core.replicas.replica_messages import ReplicaMessages

#: How many data a node looks for at a time.
MAX_SEARCHES = 1024
#: How many others may leave the search for a datum to this node.
MAX_OTHERS = 8
#: Unanswered requests after which a datum is given up.
MAX_TRIES = 8


class Search(NamedTuple):
    """A datum that this node asks others for."""

    whom: int
    """The node that is asked to take it back, or BROADCAST while no node is known to have a good copy."""
    tries: int
    """How often the node has asked."""
    own: bool
    """Whether it was in custody here; False: a custodian asked this node for it, and it had no good copy."""
    others: frozenset[int] = frozenset()
    """Nodes that asked for it too, and leave it to this one."""


class Repairs:
    """The searches of one node."""

    __slots__ = ("_custody_store", "_new", "_replica_messages", "searches")

    def __init__(self, custody_store: CustodyStore, replica_messages: ReplicaMessages) -> None:
        self._custody_store = custody_store
        self._replica_messages = replica_messages
        self.searches: dict[DatumId, Search] = {}
        self._new: set[DatumId] = set()
        """Searches begun since the last step."""

    def begin(self, id: DatumId, holder: int | None) -> None:
        """A copy in custody is corrupt: ask its holder for the datum or, if there is none, all neighbours."""
        if len(self.searches) >= MAX_SEARCHES:
            # Nobody can end this node's own searches by asking it for other data.
            others = (other for other, search in self.searches.items() if not search.own)
            self._give_up(next(others, next(iter(self.searches))))
        self._begin(id, BROADCAST if holder is None else holder, own=True)

    def help(self, id: DatumId) -> None:
        """A custodian asked this node for a datum, and there is no good copy here."""
        if id not in self.searches and len(self.searches) < MAX_SEARCHES:
            self._begin(id, BROADCAST, own=False)

    def _begin(self, id: DatumId, whom: int, *, own: bool) -> None:
        self._new.add(id)
        self._ask(id, Search(whom, 1, own))

    def end(self, id: DatumId) -> bool:
        """The datum is here, or in custody elsewhere. Returns whether this node was looking for it."""
        return self.searches.pop(id, None) is not None

    def found(self, id: DatumId, by: int) -> bool:
        """A node says that it has custody. Returns whether this node was looking for the datum, and need not any more.

        If that node has asked for it itself, what it says now may be older.
        """
        search = self.searches.get(id)
        return search is not None and by not in search.others and self.end(id)

    def take_over(self, id: DatumId, asker: int) -> bool:
        """Another node has lost the datum too. Returns whether it may leave the search to this one."""
        search = self.searches.get(id)
        if (
            search is None
            or not search.own
            or asker > self._custody_store.settings.node_id
            or len(search.others) >= MAX_OTHERS
        ):
            return False
        self.searches[id] = search._replace(others=search.others | {asker})
        return True

    def is_under_way(self, id: DatumId) -> bool:
        """Whether this node looks for a datum that was in its custody."""
        search = self.searches.get(id)
        return search is not None and search.own

    def step(self, count: int) -> None:
        """Once a step: ask again for `count` data."""
        searches = self.searches
        new, self._new = self._new, set()
        for id, search in list(islice(searches.items(), count)):
            if id in new:
                continue
            if search.tries >= MAX_TRIES:
                self._give_up(id)
            else:
                # Move it to the end, so that the others have their turn. The node that was asked is silent: any replica
                # will do.
                del searches[id]
                self._ask(id, search._replace(whom=BROADCAST, tries=search.tries + 1))

    def on_none(self, id: DatumId, sender: int) -> None:
        """A neighbour has no good copy. If it was the one asked, ask all neighbours now."""
        search = self.searches.get(id)
        if search is not None and search.whom == sender:
            self._ask(id, search._replace(whom=BROADCAST))

    def on_here(self, id: DatumId, sender: int) -> None:
        """A neighbour has a replica. The first such neighbour is asked to take the datum back."""
        search = self.searches.get(id)
        if search is not None and search.whom == BROADCAST:
            self._ask(id, search._replace(whom=sender))

    def on_wanted(self, id: DatumId, asker: int) -> None:
        """A neighbour looks for a datum."""
        custody_store = self._custody_store
        holding = custody_store.holdings.get(id)
        if holding is not None and custody_store.load(holding) is not None:
            if holding.state is State.CUSTODY:
                custody_store.holdings.vouch(holding, asker)
            self._replica_messages.say(
                asker, id, CopyStatus.TAKEN if holding.state is State.CUSTODY else CopyStatus.HERE
            )

    def _ask(self, id: DatumId, search: Search) -> None:
        self.searches[id] = search
        self._replica_messages.say(search.whom, id, CopyStatus.WANTED if search.whom == BROADCAST else CopyStatus.AGAIN)

    def _give_up(self, id: DatumId) -> None:
        """No node around has a good copy. A node that has one after all asks for itself, or takes custody when it hears
        that the datum was reported lost."""
        if self.searches.pop(id).own:
            self._custody_store.beyond_repair(id, Fate.CORRUPTED)

"""Repairs: a copy in custody was found corrupt, and the node looks for a good one.

It asks the holder first. If there is none, or the holder has no good copy either, it asks all neighbours: data leave
replicas behind on their route, and a node that has one takes the datum back. A holder without a good copy asks its own
neighbours too, because nodes that had it earlier may be out of the custodian's range. A holder that is silent is asked
in turns with all neighbours. After `MAX_TRIES` a node gives the datum up.

No other node relies on a search. Finding a replica once too often creates one copy too many.
"""

from __future__ import annotations

from collections.abc import Iterator

from rass_mav.core.custody.effects import Ask, Lose, Search
from rass_mav.core.datum import DatumId
from rass_mav.core.exchange import MAX_TRIES, Exchange
from rass_mav.core.messages import BROADCAST

#: How many data a node looks for at a time.
MAX_SEARCHES = 1024
#: How many others may leave the search for a datum to this node.
MAX_OTHERS = 8


class Repairs:
    """The searches of one node."""

    __slots__ = ("_due", "_exchange", "_id")

    def __init__(self, node_id: int, exchange: Exchange, due: float) -> None:
        """`due`: when what is asked before the first step is asked again, seconds."""
        self._id = node_id
        self._exchange = exchange
        self._due = due
        """When what is asked before the next step is asked again, seconds."""

    def _search(self, id: DatumId) -> Search | None:
        search = self._exchange.open.get(id)
        return search if isinstance(search, Search) else None

    def begin(self, id: DatumId, holder: int | None, wait_s: float = 0.0) -> tuple[Search, DatumId | None]:
        """A copy in custody is corrupt: its holder is to be asked for the datum or, if there is none, all neighbours.
        Returns the search, and the datum that is given up for it, if it was in custody here. `wait_s`: nothing is asked
        before."""
        searches = self._exchange.of(Search)
        given_up = None
        if len(searches) >= MAX_SEARCHES:
            # Requests for other data cannot end this node's own searches.
            given_up = next((search for search in searches if not search.own), searches[0])
            self._exchange.close(given_up)
        search = self._exchange.ask(Search(id, BROADCAST if holder is None else holder, self._due + wait_s, own=True))
        return search, given_up.id if given_up is not None and given_up.own else None

    def help(self, id: DatumId) -> Iterator[Ask]:
        """A custodian asked this node for a datum, and there is no good copy here."""
        if id not in self._exchange.open and len(self._exchange.of(Search)) < MAX_SEARCHES:
            yield Ask(Search(id, BROADCAST, self._due, own=False))

    def end(self, id: DatumId) -> bool:
        """The datum is here, or in custody elsewhere. Returns whether this node was looking for it."""
        return self._exchange.open.pop(id, None) is not None

    def found(self, id: DatumId, by: int) -> bool:
        """A node says that it has custody. Returns whether this node was looking for the datum, and need not any more.

        If that node has asked for it itself, what it says now may be older.
        """
        search = self._search(id)
        return search is not None and by not in search.others and self.end(id)

    def take_over(self, id: DatumId, asker: int) -> bool:
        """Another node has lost the datum too. Returns whether it may leave the search to this one."""
        search = self._search(id)
        if search is None or not search.own or asker > self._id or len(search.others) >= MAX_OTHERS:
            return False
        search.others.add(asker)
        return True

    def is_under_way(self, id: DatumId) -> bool:
        """Whether this node looks for a datum that was in its custody."""
        search = self._search(id)
        return search is not None and search.own

    def step(self, now: float, turn_s: float, count: int) -> Iterator[Ask | Lose]:
        """Once a step: ask again for what is due, at most for `count` data, and give up what was asked for often
        enough: no node around has a good copy. A node that has one after all asks for itself, or takes custody when it
        hears that the datum was reported lost. A turn takes `turn_s` seconds."""
        self._due = now + 1.5 * turn_s
        for search in [search for search in self._exchange.of(Search) if search.due <= now][:count]:
            if search.tries < MAX_TRIES:
                # The node that was asked is silent: any replica will do. But only a holder asks its own neighbours.
                search.to = BROADCAST if search.tries % 2 else search.holder
                search.due, search.tries = now + 0.5 * turn_s, search.tries + 1
                yield Ask(search)
            else:
                self._exchange.close(search)
                if search.own:
                    yield Lose(search.id)

    def on_none(self, id: DatumId, sender: int) -> Iterator[Ask]:
        """A neighbour has no good copy. If it was the one asked, ask all neighbours now."""
        search = self._search(id)
        if search is not None and search.holder == sender:
            search.holder = BROADCAST
        return self._ask_instead(id, sender, BROADCAST)

    def on_here(self, id: DatumId, sender: int) -> Iterator[Ask]:
        """A neighbour has a replica. The first such neighbour is asked to take the datum back."""
        return self._ask_instead(id, BROADCAST, sender)

    def _ask_instead(self, id: DatumId, asked: int, to: int) -> Iterator[Ask]:
        search = self._search(id)
        if search is not None and search.to == asked:
            search.to = to
            yield Ask(search)

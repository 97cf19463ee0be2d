"""Repairs: a copy in custody was found corrupt; who has a good one?

The backer is asked first. If there is none, or it has no good copy either, all neighbours are: data leave spares
behind them on their way (`mirror_until: receipt`), and whoever has one takes the datum back. A backer asked in vain
asks its own neighbours too, for those who had the datum before it may be out of the custodian's range. Who has asked
`max_tries` times gives the datum up.

A search is nothing that anybody relies on. A spare found too often makes a copy too many.
"""

from __future__ import annotations

from itertools import islice
from typing import NamedTuple

from rass_mav.core.custody.holdings import State
from rass_mav.core.custody.keeper import Keeper
from rass_mav.core.datum import DatumId, Fate
from rass_mav.core.messages import BROADCAST, Word
from rass_mav.core.spares.speech import Speech

#: How many data a node looks for at a time.
MAX_SEARCHES = 1024


class Search(NamedTuple):
    """A datum that others are asked for."""

    whom: int
    """Who is asked to take it back, or BROADCAST while nobody is known to have a good copy."""
    tries: int
    """How often was asked."""
    own: bool
    """Whether it was in custody here; False: a custodian asked this node for it in vain."""


class Repairs:
    """What one node looks for."""

    __slots__ = ("_keeper", "_new", "_speech", "searches")

    def __init__(self, keeper: Keeper, speech: Speech) -> None:
        self._keeper = keeper
        self._speech = speech
        self.searches: dict[DatumId, Search] = {}
        self._new: set[DatumId] = set()
        """Those begun since the last step."""

    def begin(self, id: DatumId, backer: int | None) -> None:
        """A copy in custody is corrupt: its backer is asked for the datum, or, if there is none, all neighbours."""
        if len(self.searches) >= MAX_SEARCHES:
            self._give_up(next(iter(self.searches)))
        self._begin(id, BROADCAST if backer is None else backer, own=True)

    def help(self, id: DatumId) -> None:
        """A custodian asked this node for a datum in vain."""
        if id not in self.searches and len(self.searches) < MAX_SEARCHES:
            self._begin(id, BROADCAST, own=False)

    def _begin(self, id: DatumId, whom: int, *, own: bool) -> None:
        self._new.add(id)
        self._ask(id, Search(whom, 1, own))

    def end(self, id: DatumId) -> bool:
        """The datum is here, or in custody elsewhere. Whether this node was looking for it."""
        return self.searches.pop(id, None) is not None

    def is_under_way(self, id: DatumId) -> bool:
        """Whether a datum is looked for that was in custody here."""
        search = self.searches.get(id)
        return search is not None and search.own

    def step(self, count: int) -> None:
        """Once a step: ask once more for `count` data."""
        searches = self.searches
        max_tries = self._keeper.settings.max_tries
        new, self._new = self._new, set()
        for id, search in list(islice(searches.items(), count)):
            if id in new:
                continue
            if search.tries >= max_tries:
                self._give_up(id)
            else:
                # To the end, so that the others have their turn. Who was asked is silent: any spare will do.
                del searches[id]
                self._ask(id, Search(BROADCAST, search.tries + 1, search.own))

    def on_none(self, id: DatumId, sender: int) -> None:
        """A neighbour has no good copy. If it was asked for it, all are asked now."""
        search = self.searches.get(id)
        if search is not None and search.whom == sender:
            self._ask(id, search._replace(whom=BROADCAST))

    def on_here(self, id: DatumId, sender: int) -> None:
        """A neighbour has a spare. The first one is asked to take the datum back."""
        search = self.searches.get(id)
        if search is not None and search.whom == BROADCAST:
            self._ask(id, search._replace(whom=sender))

    def on_wanted(self, id: DatumId, asker: int) -> None:
        """A neighbour looks for a datum."""
        keeper = self._keeper
        holding = keeper.holdings.get(id)
        if holding is not None and keeper.load(holding) is not None:
            self._speech.say(asker, id, Word.TAKEN if holding.state is State.CUSTODY else Word.HERE)

    def _ask(self, id: DatumId, search: Search) -> None:
        self.searches[id] = search
        self._speech.say(search.whom, id, Word.WANTED if search.whom == BROADCAST else Word.AGAIN)

    def _give_up(self, id: DatumId) -> None:
        """Nobody around has a good copy. If somebody has one after all, it asks for itself, or takes the datum into
        custody when it hears that it was told lost."""
        if self.searches.pop(id).own:
            self._keeper.beyond_repair(id, Fate.CORRUPTED)

"""Follows a store while data arrive, and the node that writes it."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

from rass_mav.app.client import ControlClient
from rass_mav.errors import ControlError, StoreError
from rass_mav.ground.entry import Data, Entry

from .model import Mission

#: Data that are read in one look, so that questions between two looks do not wait long.
MOST_IN_A_LOOK = 5000
#: How long a node may take to answer, seconds.
ANSWER_S = 2.0
#: Neighbours of the node that are shown.
_MOST_NEIGHBOURS = 50


class Follower:
    """Reads a store into a mission. One thread at a time uses it."""

    def __init__(self, open: Callable[[], Data]) -> None:
        """`open`: opens the store or the database, now and after each trouble. Raises what that raises now."""
        self.mission = Mission()
        self.trouble = ""
        """Why the store cannot be read now; empty: it can."""
        self._open = open
        self._data: Data | None = open()
        self.name = self._data.path.name
        self.behind = True
        """Whether there may be more to read at once."""
        self._seen = self._seen_apart = 0
        """The latest `Entry.arrival` that was read, of data and of second contents."""
        self._entries = self._new(self._data)

    def look(self) -> bool:
        """Read what has arrived. Returns whether anything that the page shows has changed."""
        before = self._shown
        try:
            lost = self._read()
            self.trouble = ""
        except StoreError as error:
            lost = False
            self.trouble = " ".join(error.lines())
            self.behind = False
            self.close()
        return lost or before != self._shown

    @property
    def _shown(self) -> tuple[int, str, list[str], bool]:
        # That all is read may show only in a look that finds nothing more.
        return self.mission.taken, self.trouble, self.remarks, self.behind

    def _read(self) -> bool:
        if self._data is None:
            self._data = self._open()
            self._entries = self._new(self._data)
        elif not self.behind:
            self._data.renew()
            self._entries = self._new(self._data)
        self.behind = self.mission.take(islice(self._entries, MOST_IN_A_LOOK)) == MOST_IN_A_LOOK
        new = self.mission.hear(self._data.losses())
        if not self.behind:
            self._data.rest()
        return new

    def _new(self, data: Data) -> Iterator[Entry]:
        for entry in data.entries(after=self._seen):
            self._seen = entry.arrival
            yield entry
        for entry in data.second_contents(self._seen_apart):
            self._seen_apart = entry.arrival
            yield entry

    @property
    def remarks(self) -> list[str]:
        """What is wrong with the store, for people."""
        return [] if self._data is None else list(self._data.remarks)

    def close(self) -> None:
        """Release the files."""
        if self._data is not None:
            self._data.close()
            self._data = None


def ask_node(socket: str | os.PathLike[str]) -> dict[str, Any] | None:
    """What the running node says; None: it does not run."""
    try:
        with ControlClient(Path(socket), timeout_s=ANSWER_S) as client:
            said = client.ask("status")["status"]
    except ControlError:
        return None
    neighbours = said.get("neighbours") or []
    return {
        **{name: said.get(name) for name in ("node_id", "role", "version", "uptime_s", "next_hop", "hop_count")},
        "faults": (said.get("faults") or {}).get("count"),
        "neighbours": [
            {name: neighbour.get(name) for name in ("node_id", "age_s", "hops")}
            for neighbour in neighbours[:_MOST_NEIGHBOURS]
        ],
    }

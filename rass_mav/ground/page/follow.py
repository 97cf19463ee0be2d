"""Follows a store while data arrive, and the node that writes it."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

from rass_mav.app.client import ControlClient
from rass_mav.errors import ControlError, RassError
from rass_mav.ground.entry import Data, Entry
from rass_mav.ground.feed import Cursor, Feed, Look

from .model import Mission

#: Data that are read in one look, so that questions between two looks do not wait long.
MOST_IN_A_LOOK = 5000
#: How long a node may take to answer, seconds.
ANSWER_S = 2.0
#: Neighbours of the node that are shown.
_MOST_NEIGHBOURS = 50


class Follower:
    """Reads a store into a mission. One thread at a time uses it."""

    def __init__(self, open: Callable[[], Data], *, keep: bool = False) -> None:
        """`open` and `keep`: as of a `Feed`. Raises what `open` raises now."""
        self.mission = Mission()
        self.begins = False
        """Whether the mission begins anew with the last look, because the store has."""
        self.trouble = ""
        """Why the store cannot be read now; empty: it can."""
        self.remarks: list[str] = []
        """What is wrong with the store, for people."""
        self.behind = True
        """Whether there may be more to read at once."""
        self._feed = Feed(open, keep=keep)
        self._cursor: Cursor | None = None
        with self._feed.look(None) as look:
            self.name = look.data.path.name
            self.remarks = list(look.data.remarks)

    def look(self) -> bool:
        """Read what has arrived. Returns whether anything that the page shows has changed."""
        before = self._shown
        lost = self.begins = False
        try:
            with self._feed.look(self._cursor) as look:
                lost = self._read(look)
            self.trouble = ""
        except RassError as error:
            self.trouble = " ".join(error.lines())
            self.behind = False
        return lost or self.begins or before != self._shown

    @property
    def _shown(self) -> tuple[int, str, list[str], bool]:
        # That all is read may show only in a look that finds nothing more.
        return self.mission.taken, self.trouble, self.remarks, self.behind

    def _read(self, look: Look) -> bool:
        if look.restarted:
            self.mission, self.begins = Mission(), True
        self._cursor = look.start
        self.behind = self.mission.take(islice(self._new(look), MOST_IN_A_LOOK)) == MOST_IN_A_LOOK
        new = self.mission.hear(look.data.losses())
        self.remarks = list(look.data.remarks)
        return new

    def _new(self, look: Look) -> Iterator[Entry]:
        for entry, cursor in look.arrivals():
            self._cursor = cursor
            yield entry

    def close(self) -> None:
        """Release the files."""
        self._feed.close()


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

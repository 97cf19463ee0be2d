"""Follows a store while data arrive, and the node that writes it."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from rass_mav.app.client import ControlClient
from rass_mav.errors import ControlError, RassError
from rass_mav.ground import follow
from rass_mav.ground.attention.conditions import Condition
from rass_mav.ground.attention.node import of_node
from rass_mav.ground.attention.rules import RuleBook
from rass_mav.ground.entry import Data
from rass_mav.ground.pictures import kind_of

from .model import Mission

#: How long a node may take to answer, seconds.
ANSWER_S = 2.0
#: Neighbours of the node that are shown.
_MOST_NEIGHBOURS = 50


class Follower(follow.Follower[Mission]):
    """Reads a store into a mission. One thread at a time uses it."""

    def __init__(self, open: Callable[[], Data], rules: RuleBook | None = None, *, keep: bool = False) -> None:
        """`open` and `keep`: as of a `Feed`. Raises what `open` raises now."""
        super().__init__(open, Mission, rules, keep=keep)

    def picture(self, name: str) -> tuple[bytes, str] | None:
        """A photograph by the name of its datum, and its type; None: there is none that browsers get."""
        album = self.mission.album
        entry = album.find(name)
        if entry is None:
            return None
        try:
            with self._feed.look(self._cursor) as look:
                image = album.read(entry, look.data)
        except RassError:
            return None
        kind = kind_of(image)
        return None if kind is None else (image, kind)


class Answer(NamedTuple):
    """What a running node says."""

    about: dict[str, Any]
    """For the page."""
    attention: list[Condition]


def ask_node(socket: str | os.PathLike[str]) -> Answer | None:
    """What the running node says; None: it does not run."""
    try:
        with ControlClient(Path(socket), timeout_s=ANSWER_S) as client:
            said = client.ask("status")["status"]
    except ControlError:
        return None
    neighbours = said.get("neighbours") or []
    about = {
        **{name: said.get(name) for name in ("node_id", "role", "version", "uptime_s", "next_hop", "hop_count")},
        "faults": (said.get("faults") or {}).get("count"),
        "neighbours": [
            {name: neighbour.get(name) for name in ("node_id", "age_s", "hops")}
            for neighbour in neighbours[:_MOST_NEIGHBOURS]
        ],
    }
    return Answer(about, of_node(said))

"""A base's answers about spare copies: it keeps none, because its data have arrived."""

from __future__ import annotations

from rass_mav.core.custody.keeper import Sink
from rass_mav.core.custody.nospares import NoSpares
from rass_mav.core.messages import Message, PassedOn, Word, Words


class AtBase(NoSpares):
    """A base's share of mirrored custody."""

    __slots__ = ("_keeper",)

    def __init__(self, keeper: Sink) -> None:
        self._keeper = keeper

    def on_words(self, message: Words, now: float, out: list[Message]) -> None:
        """Some node did not know that it handed over to a base, and asks about its spares."""
        arrived = tuple(id for id, word in message.entries if word == Word.STILL and self._keeper.has(id))
        if arrived:
            out.append(PassedOn(self._keeper.settings.node_id, message.sender, arrived))

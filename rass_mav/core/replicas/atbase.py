"""A base's answers about replicas: it keeps none, because its data have arrived."""

from __future__ import annotations

from rass_mav.core.custody.custody_store import BaseStore
from rass_mav.core.custody.noreplicas import NoReplicas
from rass_mav.core.messages import CopyStatus, CopyStatuses, Message, PassedOn


class AtBase(NoReplicas):
    """A base's share of custody with replicas."""

    __slots__ = ("_custody_store",)

    def __init__(self, custody_store: BaseStore) -> None:
        self._custody_store = custody_store

    def on_copy_statuses(self, message: CopyStatuses, now: float, out: list[Message]) -> None:
        """Some node did not know that it handed over to a base, and asks about its replicas."""
        arrived = tuple(id for id, word in message.entries if word == CopyStatus.STILL and self._custody_store.has(id))
        if arrived:
            out.append(PassedOn(self._custody_store.settings.node_id, message.sender, arrived))

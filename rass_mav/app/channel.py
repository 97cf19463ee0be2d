"""A link and the node's side of it: frames leave as soon as the link can carry them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from rass_mav.agent.outgoing import Outgoing
from rass_mav.app.linkqueue import LinkQueue
from rass_mav.link.base import Link


class Channel:
    """One connection to the neighbours, on the event loop."""

    def __init__(self, link: Link, link_queue: LinkQueue, now: Callable[[], float], closed: Callable[[], bool]) -> None:
        """`now`: the agent's timeline. `closed`: returns whether nothing may leave yet; then the caller tries again."""
        self.link = link
        self.link_queue = link_queue
        self._now = now
        self._closed = closed
        self._alarm: asyncio.TimerHandle | None = None

    def send(self, outgoing: Outgoing, *, first: bool = False) -> None:
        """Send a frame as soon as the link can carry it; `first`: before all others of the same urgency."""
        self.link_queue.push(outgoing, self._now(), first=first)
        self._pump()

    def _pump(self) -> None:
        """Send what may leave now, and schedule the next call."""
        if self._closed():
            return
        now = self._now()
        while (queued := self.link_queue.pop(now)) is not None:
            self.link.send(queued.frame, queued.target)
        self.stop()
        due = self.link_queue.next_at(now)
        if due is not None:
            self._alarm = asyncio.get_running_loop().call_later(due - now, self._pump)

    def stop(self) -> None:
        """Cancel the next call."""
        if self._alarm is not None:
            self._alarm.cancel()
            self._alarm = None

"""Links within one process, for the driver. No delay, no order lost, no bytes changed;
what it does lose is what finds the hearer's inbox full, and that is counted there."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from rass_mav.link.base import MAX_INBOX, Address, Datagram, Inbox, Link, LinkCounters


class LoopbackHub:
    """Who hears whom."""

    def __init__(self) -> None:
        self._hearers: dict[str, dict[str, LoopbackLink]] = {}
        self._links: dict[str, LoopbackLink] = {}

    def endpoint(self, name: str, *, capacity: int = MAX_INBOX) -> LoopbackLink:
        """A new endpoint that nobody hears yet. `capacity`: datagrams that its inbox holds."""
        if name in self._links:
            raise ValueError(f"there is an endpoint {name!r} already")
        link = LoopbackLink(self, name, capacity)
        self._links[name] = link
        self._hearers[name] = {}
        return link

    def connect(self, a: LoopbackLink, b: LoopbackLink) -> None:
        """From now on these two hear each other."""
        self._hearers[a.name][b.name] = b
        self._hearers[b.name][a.name] = a

    def disconnect(self, a: LoopbackLink, b: LoopbackLink) -> None:
        """They hear each other no more. What has arrived stays."""
        self._hearers[a.name].pop(b.name, None)
        self._hearers[b.name].pop(a.name, None)

    def hearers(self, name: str) -> dict[str, LoopbackLink]:
        """The endpoints that hear this one, by name."""
        return self._hearers[name]

    def remove(self, name: str) -> None:
        """An endpoint is closed."""
        self._links.pop(name, None)
        for other in self._hearers.pop(name, {}):
            self._hearers[other].pop(name, None)


class LoopbackLink(Link):
    """One endpoint of a `LoopbackHub`; made by `LoopbackHub.endpoint`."""

    def __init__(self, hub: LoopbackHub, name: str, capacity: int) -> None:
        super().__init__(name)
        self._hub = hub
        self._capacity = capacity
        self._inbox = Inbox()
        self._names: dict[int, str] = {}
        self._sent = 0
        self._dropped_in = 0
        self._loop: asyncio.AbstractEventLoop | None = None

    def start(self, wake: Callable[[], None]) -> None:
        """Begin to wake the driver."""
        self._loop = asyncio.get_running_loop()
        self._inbox.wake = wake
        if self._inbox:
            self._loop.call_soon(wake)

    def receive(self) -> list[Datagram]:
        """What has arrived."""
        return self._inbox.take()

    def send(self, frame: bytes, target: int) -> None:
        """To the endpoint where the target was heard, or to all that hear this one."""
        hearers = self._hub.hearers(self.name)
        known = hearers.get(self._names.get(target, ""))
        for hearer in (known,) if known is not None else tuple(hearers.values()):
            self._sent += 1
            hearer.deliver(Datagram(frame, (self.name, 0)))

    def deliver(self, datagram: Datagram) -> None:
        """Something arrives; it is lost if the inbox is full."""
        if len(self._inbox) >= self._capacity:
            self._dropped_in += 1
            return
        self._inbox.put(datagram)
        if len(self._inbox) == 1 and self._loop is not None:
            self._loop.call_soon(self._inbox.wake)

    def reaches(self, target: int) -> bool:
        """Whether the node was heard here, and the endpoint is still connected."""
        return self._names.get(target) in self._hub.hearers(self.name)

    def learn(self, node_id: int, source: Address) -> None:
        """The node lives at this endpoint."""
        if source[0] in self._hub.hearers(self.name):
            self._names[node_id] = source[0]

    def counters(self) -> LinkCounters:
        """What has been done so far; dropped in is what found the inbox full."""
        return LinkCounters(self._sent, self._inbox.taken, self._dropped_in, 0, 0)

    def close(self) -> None:
        """Leave the hub."""
        self._hub.remove(self.name)
        self._loop = None

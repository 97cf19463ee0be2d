"""What the tests of the links share."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from rass_mav.link.base import Datagram, Link
from rass_mav.link.vehicle_udp import VehicleLink
from tests.patience import PATIENCE_S


class Ear:
    """Listens to a link and lets a test wait for what arrives."""

    def __init__(self, link: Link) -> None:
        self.link = link
        self.heard: list[Datagram] = []
        self._wake = asyncio.Event()
        link.start(self._wake.set)

    async def until(self, done: Callable[[list[Datagram]], bool]) -> list[Datagram]:
        async def wait() -> None:
            while not done(self.heard):
                await self._wake.wait()
                self._wake.clear()
                self.heard += self.link.receive()

        await asyncio.wait_for(wait(), PATIENCE_S)
        return self.heard

    async def frames(self, count: int) -> list[bytes]:
        return [datagram.data for datagram in await self.until(lambda heard: len(heard) >= count)]


async def vehicle_bytes(link: VehicleLink, wake: asyncio.Event, count: int) -> list[bytes]:
    """Wait for so many datagrams from the autopilot's side."""
    heard: list[bytes] = []

    async def wait() -> None:
        while len(heard) < count:
            await wake.wait()
            wake.clear()
            heard.extend(link.receive())

    await asyncio.wait_for(wait(), PATIENCE_S)
    return heard

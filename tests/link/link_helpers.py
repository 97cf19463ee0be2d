"""What the tests of the links share."""

from __future__ import annotations

from collections.abc import Callable

from rass_mav.link.base import Datagram, Link
from tests.waking import Waking


class Ear:
    """Listens to a link and lets a test wait for what arrives."""

    def __init__(self, link: Link) -> None:
        self.link = link
        self.heard: list[Datagram] = []
        self.waking = Waking(link.start)

    async def until(self, done: Callable[[list[Datagram]], bool]) -> list[Datagram]:
        def looked() -> bool:
            self.heard += self.link.receive()
            return done(self.heard)

        await self.waking.until(looked)
        return self.heard

    async def frames(self, count: int) -> list[bytes]:
        return [datagram.data for datagram in await self.until(lambda heard: len(heard) >= count)]

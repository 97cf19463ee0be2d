"""Waiting for what wakes its driver when something has come."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import TypeVar

from tests.patience import PATIENCE_S

T = TypeVar("T")


class Waking:
    """Lets a test wait until something is so, and looks again whenever it is woken."""

    def __init__(self, start: Callable[[Callable[[], None]], None]) -> None:
        """`start` is given what wakes."""
        self._wake = asyncio.Event()
        start(self._wake.set)

    async def until(self, so: Callable[[], bool]) -> None:
        async def wait() -> None:
            while not so():
                await self._wake.wait()
                self._wake.clear()

        await asyncio.wait_for(wait(), PATIENCE_S)

    async def next(self, receive: Callable[[], list[T]]) -> list[T]:
        """What is received next."""
        found: list[T] = []

        def received() -> bool:
            found.extend(receive())
            return bool(found)

        await self.until(received)
        return found

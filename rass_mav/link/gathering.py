"""Frames that are sent at once to the same address share a datagram."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

A = TypeVar("A", bound=Hashable)


class Gathering(Generic[A]):
    """The datagrams of this turn of the event loop, which others may still join."""

    def __init__(self, most_bytes: int, send: Callable[[bytes, A], None]) -> None:
        """`most_bytes`: in a datagram; a longer frame goes alone. `send`: gets each datagram, and its address."""
        self._most_bytes = most_bytes
        self._send = send
        self._open: dict[A, bytes] = {}

    def __len__(self) -> int:
        return len(self._open)

    def add(self, frame: bytes, address: A) -> None:
        """Send a frame at the end of this turn."""
        if not self._open:
            asyncio.get_running_loop().call_soon(self.leave)
        others = self._open.get(address, b"")
        if others and len(others) + len(frame) > self._most_bytes:
            self._send(others, address)
            others = b""
        self._open[address] = others + frame

    def leave(self) -> None:
        """Send all now."""
        gathered, self._open = self._open, {}
        for address, frames in gathered.items():
            self._send(frames, address)

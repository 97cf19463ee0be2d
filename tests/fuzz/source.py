"""The fuzzer's bytes, read one after the other."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

_T = TypeVar("_T")


class Source:
    """Bytes, one after the other; zeros when they are used up."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    def __bool__(self) -> bool:
        return self._at < len(self._data)

    def byte(self) -> int:
        """0..255."""
        return (self.some(1) or b"\0")[0]

    def some(self, count: int) -> bytes:
        """So many bytes, fewer at the end."""
        taken = self._data[self._at : self._at + count]
        self._at += count
        return taken

    def pick(self, things: Sequence[_T]) -> _T:
        """One of some things; there must be one."""
        return things[self.byte() % len(things)]

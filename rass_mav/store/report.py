"""What opening a store found, and the texts that report it to people."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple


class OpenReport(NamedTuple):
    """What opening a store found."""

    created: bool = False
    """A new store was created, with a new life and a new epoch."""
    set_aside: Path | None = None
    """Where the damaged file is that was found in its place."""
    reason: str = ""
    """What was wrong with it, or why the epoch is new; empty if nothing was wrong."""
    closed: tuple[tuple[int, int], ...] = ()
    """Epochs that ended, each with how many of its numbers are known to be assigned; more may have been."""
    salvaged: int = 0
    """Data that were found in the damaged file, and are in the store now."""
    lost: int = 0
    """The most data that may be lost."""
    dropped: tuple[str, ...] = ()
    """Single rows that were damaged and are left out."""
    payloads: str = ""
    """What was wrong with the file of large payloads: data in it are left out. Empty: nothing."""
    unwritable: str = ""
    """Why nothing can be written here: the store is only read. Empty: it can be written."""

    @property
    def remarks(self) -> list[str]:
        """What people should know, one short line each."""
        said = []
        if self.unwritable:
            said.append(f"store cannot be written ({self.unwritable}): relaying only, no data are taken")
        if self.set_aside is not None:
            said.append(
                f"damaged store set aside ({self.set_aside.name}), {self.salvaged} data salvaged, new store made"
            )
        elif self.salvaged:
            said.append(f"{self.salvaged} data salvaged from a damaged log")
        if self.lost:
            said.append(f"up to {self.lost} data may be lost with a damaged store")
        if self.payloads:
            said.append(self.payloads)
        if self.dropped:
            said.append(f"{len(self.dropped)} damaged rows left out, {self.dropped[0]}")
        if self.closed and not self.created:
            said.append("numbers may have been lost: a new epoch of data begins")
        return said

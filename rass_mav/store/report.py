"""What opening a store found, and how it is said to people."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple


class OpenReport(NamedTuple):
    """What opening a store found."""

    created: bool = False
    """A new store was made, with a new life and a new epoch."""
    set_aside: Path | None = None
    """Where the damaged file lies that was found in its place."""
    reason: str = ""
    """What was wrong with it, or why the epoch is new; empty if nothing was."""
    converted: Path | None = None
    """Where the store of the last version lies that this one was made of."""
    closed: tuple[tuple[int, int], ...] = ()
    """Epochs that ended, each with how many of its numbers are known to be given; more may have been."""
    salvaged: int = 0
    """Data that were found in what is damaged, and are in the store."""
    lost: int = 0
    """Data that are not there any more, at most."""
    dropped: tuple[str, ...] = ()
    """Single rows that were damaged and are left out."""
    unwritable: str = ""
    """Why nothing can be written here: the store only tells what it holds. Empty: it can."""

    @property
    def remarks(self) -> list[str]:
        """What people should know, a short line each."""
        said = []
        if self.unwritable:
            said.append(f"store cannot be written ({self.unwritable}): relaying only, no data are taken")
        if self.converted is not None:
            said.append(f"store of the last version converted, the old one is {self.converted.name}")
        if self.set_aside is not None:
            said.append(f"damaged store set aside ({self.set_aside.name}), {self.salvaged} data salvaged, began anew")
        elif self.salvaged:
            said.append(f"{self.salvaged} data salvaged from a damaged log")
        if self.lost:
            said.append(f"up to {self.lost} data may be lost with a damaged store")
        if self.dropped:
            said.append(f"{len(self.dropped)} damaged rows left out, {self.dropped[0]}")
        if self.closed and not self.created:
            said.append("numbers may have been lost: a new epoch of data begins")
        return said

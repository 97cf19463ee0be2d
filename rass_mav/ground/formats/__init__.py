"""What data can be exported to (docs/how-to/data.md). Each module has one `Format`, and is loaded only if it is
used."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from pkgutil import iter_modules, resolve_name
from typing import NamedTuple

from rass_mav.ground.entry import Data, Entry


class Exported(NamedTuple):
    """The result of an export."""

    data: int
    """How many data were written."""
    left_out: Counter[str]
    """How many the format cannot hold, by reason, for example `no position`."""
    files: list[Path]


class Format(NamedTuple):
    """A format."""

    ending: str
    """Usual ending of a file, with the dot; empty: it writes several files into a folder."""
    holds: str
    """What it can hold, for people."""
    write: Callable[[Iterable[Entry], Path, Data], Exported]
    """Write the data to a file, or into a folder, that does not exist yet. In memory that does not grow with the number
    of data. `OSError`, `RassError`."""


def names() -> list[str]:
    """What `--format` takes: the names of the modules here."""
    return sorted(module.name for module in iter_modules(__path__))


def format_of(name: str) -> Format:
    """The format with one of these `names`."""
    found = resolve_name(f"{__name__}.{name}:FORMAT")
    assert isinstance(found, Format)
    return found

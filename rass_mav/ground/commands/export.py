"""`export`: the data of a store for spreadsheets, maps and Safecast."""

from __future__ import annotations

import argparse
import os
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from rass_mav.commands.common import Subparsers, add_command, answer, clean, lists, progress, start_logging
from rass_mav.errors import ConfigError, RassError, os_errors_as

from .data import add_store, read_archive
from .filters import add_filters, wanted

if TYPE_CHECKING:
    from rass_mav.ground.entry import Data, Entry
    from rass_mav.ground.formats import Exported, Format


def register(subparsers: Subparsers) -> None:
    """Add the command."""
    parser = add_command(
        subparsers, "export", _export, help="export the data of a store to a file for other programs",
        example="rass-mav export base.yaml -o mission.gpkg --since 2h",
    )  # fmt: skip
    add_store(parser)
    parser.add_argument(
        "-o", "--output", type=Path, metavar="OUT",
        help="the file to create, or the folder for several files (default: named after the store)",
    )  # fmt: skip
    format = parser.add_argument("--format", metavar="NAME", help="the format (default: by the extension of OUT)")
    lists(format, _names)
    add_filters(parser)


def _names() -> list[str]:
    from rass_mav.ground.formats import names

    return names()


def _export(options: argparse.Namespace) -> int:
    from rass_mav.ground.formats import format_of
    from rass_mav.ground.selection import Selection

    start_logging(options.verbose)
    name = options.format or _by_ending(options.output)
    if name not in _names():
        raise ConfigError(f"--format: expected one of {', '.join(_names())}, got {name!r}")
    format, selection = format_of(name), Selection(wanted(options))
    with read_archive(options) as archive:
        out = options.output or Path(archive.path.stem + (format.ending or f"-{name}"))
        refuse_existing(out)
        with progress(archive.count(), "data", quiet=options.json) as advance:

            def entries() -> Iterator[Entry]:
                for entry in archive.entries():
                    advance(1)
                    yield entry

            def nothing(why: Counter[str]) -> str:
                return selection.nothing(why, name, format, archive)

            done, files = _write(selection.of(entries()), out, format, archive, nothing)
    count = done.left_out.total()
    all_left_out = count + selection.sealed
    left_out = f"; {all_left_out} left out: {selection.reasons(done.left_out, name, format)}" if all_left_out else ""
    plain = {
        "out": str(out), "format": name, "data": done.data, "left_out": count, "left_out_why": dict(done.left_out),
        "sealed": selection.sealed, "files": files,
    }  # fmt: skip
    answer(options, plain, [clean(f"{out}: {done.data} data{left_out}")])
    return 0


def _by_ending(out: Path | None) -> str:
    """The format that the ending of a file means."""
    from rass_mav.ground.formats import format_of

    endings = {format_of(name).ending: name for name in _names()}
    expected = f"expected --format, one of {', '.join(_names())}"
    if out is None:
        raise ConfigError(f"{expected}, or -o with an extension that implies it")
    if out.suffix not in endings or not out.suffix:
        raise ConfigError(f"{out}: {expected}, or one of the extensions {', '.join(filter(None, endings))}")
    return endings[out.suffix]


def _write(
    entries: Iterator[Entry], out: Path, format: Format, archive: Data, nothing: Callable[[Counter[str]], str]
) -> tuple[Exported, int]:
    """Create `out`, completely or not at all; returns what was done, and how many files there are. `nothing`: says why
    no data were written, from the reasons. Raises `RassError` then."""
    # In a folder of its own beside it, so that what is half done goes away with it.
    with (
        os_errors_as(RassError, out),
        TemporaryDirectory(dir=out.absolute().parent, prefix=".rass-mav-") as folder,
    ):
        draft = Path(folder) / out.name
        done = format.write(entries, draft, archive)
        if not done.data:
            raise RassError(clean(f"{out}: nothing to export, so it was not created: {nothing(done.left_out)}"))
        files = len(os.listdir(draft)) if draft.is_dir() else 1
        refuse_existing(out)
        os.replace(draft, out)
    return done, files


def refuse_existing(out: Path) -> None:
    """Raises `ConfigError` if there is something already."""
    if os.path.lexists(out):
        raise ConfigError(f"{out}: already exists; choose another name or delete it")

"""`try`: a base and some drones with mock vehicles on this machine, to see data arrive."""

from __future__ import annotations

import argparse
import contextlib
import math
import shlex
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rass_mav.commands.common import Subparsers, add_command, answer, clean, say, start_logging
from rass_mav.errors import ConfigError
from rass_mav.ground.commands.data import content
from rass_mav.ground.commands.page import LISTEN

if TYPE_CHECKING:
    from rass_mav.ground.assembly import Group, Groups
    from rass_mav.ground.entry import Entry
    from rass_mav.lab.fleet.demo import Demo
    from rass_mav.wire.file import Cut

#: Seconds between two lines about a file that has not arrived completely.
_FILE_EVERY_S = 10.0
#: How many characters of a submitted line are shown.
_MOST_SHOWN = 60
_WHAT = """
With --json it prints one object at the end: `drones`, `seconds`, `created`,
`delivered`, `held` (still on the drones), `lost` by reason, `altered` (always 0),
and the `directory` of --keep.
"""


def register(subparsers: Subparsers) -> None:
    """Add the command."""
    parser = add_command(
        subparsers, "try", _try,
        help="run a drone with a mock vehicle and a base on this machine, until Ctrl-C",
        example="rass-mav try --keys --page --drones 4",
    )  # fmt: skip
    parser.description = f"{parser.description}\n{_WHAT}".rstrip()
    parser.add_argument(
        "--drones",
        type=int,
        default=1,
        metavar="N",
        help="number of drones (default: 1); with 3 or more, one takes a photo and one dies",
    )
    parser.add_argument("--keys", action="store_true", help="give the nodes a mission's keys")
    parser.add_argument(
        "--page", nargs="?", const=LISTEN, metavar="HOST:PORT",
        help=f"serve the mission's page at this address (default: {LISTEN})",
    )  # fmt: skip
    parser.add_argument(
        "--for", type=float, dest="seconds", metavar="SECONDS", help="stop automatically after this time"
    )
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep configurations, stores and logs in DIR")


def _try(options: argparse.Namespace) -> int:
    start_logging(options.verbose)
    if options.seconds is not None and not options.seconds > 0:
        raise ConfigError(f"--for: expected seconds above 0, got {options.seconds:g}")
    from rass_mav.lab.fleet.demo import Options, demo

    def show(line: str) -> None:
        """Print at once, in a pipe too."""
        if not options.json:
            say(line)
            sys.stdout.flush()

    from rass_mav.ground.assembly import Groups

    files = Files(Groups(), time.monotonic)

    def arrived(entry: Entry, payload: bytes) -> None:
        line = files.line(entry) if files.takes(entry) else arrival_line(entry, payload)
        if line is not None:
            show(line)

    with demo(Options(options.drones, options.keep, options.keys, options.page), arrived, show) as nodes:
        # Ctrl-C or SIGTERM: this is how it ends.
        with contextlib.suppress(KeyboardInterrupt, SystemExit):
            for line in opening_lines(nodes, kept=options.keep is not None):
                show(line)
            until = math.inf if options.seconds is None else time.monotonic() + options.seconds
            nodes.run(until)
        nodes.stop()
        for line in files.unfinished():
            show(line)
        summary = nodes.summary()
    summary["directory"] = None if options.keep is None else str(nodes.directory)
    answer(options, summary, closing_lines(summary))
    return 0


def opening_lines(nodes: Demo, *, kept: bool) -> Iterator[str]:
    """What is running, where its files are, and what to type."""
    drones = nodes.drones
    if len(drones) == 1:
        yield f"Node 1 is a base, node {drones[0].node_id} a drone. Its mock vehicle flies past a radiation source."
    else:
        ids = f"{drones[0].node_id} to {drones[-1].node_id}"
        yield f"Node 1 is a base, nodes {ids} are drones. Their mock vehicles fly past a radiation source."
    yield f"Configurations, stores and logs: {nodes.directory}{'' if kept else ' (--keep DIR keeps them)'}"
    yield "In another terminal:"
    program, drone, base = _program(), shlex.quote(str(drones[0].config)), shlex.quote(str(nodes.bases[0].config))
    yield f"    {program} status {drone}"
    yield f"    {program} put -c {drone} --line hello"
    yield f"    {program} ls {base}"
    if nodes.page is not None:
        yield f"The page: http://{nodes.page}/"
    yield "Ctrl-C stops everything. What arrives at the base:"


def _program() -> str:
    """The command that calls this program here."""
    return "rass-mav" if shutil.which("rass-mav") else f"{shlex.quote(sys.executable)} -m rass_mav"


class Files:
    """The files that arrive in parts. They have a line each, not one for each part; a slow one has further ones."""

    def __init__(self, groups: Groups, clock: Callable[[], float]) -> None:
        """`clock`: returns seconds."""
        self._groups, self._clock = groups, clock
        self._manifests: dict[tuple[int, Cut], Entry] = {}
        self._next: dict[tuple[int, Cut], float] = {}
        """When the next line about a file is due, on the clock; infinite: it is complete."""
        self._last: dict[tuple[int, Cut], Group] = {}

    def takes(self, entry: Entry) -> bool:
        """Whether it belongs to such a file."""
        return entry.part is not None or entry.manifest is not None

    def line(self, entry: Entry) -> str | None:
        """One more datum of a file. Returns what there is to say; None: nothing yet."""
        if entry.manifest is not None:
            group = self._groups.parts_of(entry)
            self._manifests[group.key] = entry
        elif (found := self._groups.add(entry)) is not None:
            group = found
        else:
            return None
        key, now = group.key, self._clock()
        self._last[key] = group
        if group.extent.whole and key in self._manifests:
            due, self._next[key] = self._next.get(key, now), math.inf
            return None if due == math.inf else self._line(group)
        if now < self._next.setdefault(key, now + _FILE_EVERY_S):
            return None
        self._next[key] = now + _FILE_EVERY_S
        return self._line(group)

    def unfinished(self) -> list[str]:
        """A line for each file that is not complete."""
        return [self._line(group) for key, group in self._last.items() if self._next[key] != math.inf]

    def _line(self, group: Group) -> str:
        manifest = self._manifests.get(group.key)
        name = group.name if manifest is None or manifest.file is None else manifest.file
        return clean(f"{time.strftime('%H:%M:%S')} node {group.origin} {name} {group.extent.text}")


def arrival_line(entry: Entry, payload: bytes) -> str:
    """A datum that has arrived: when and by which node it was created, and what it is, or the text that was put."""
    words = content(entry)
    if entry.kind_name == "bytes" and entry.file is None:
        text = payload.decode(errors="replace")
        if text.isprintable() and "\ufffd" not in text:
            words = text[:_MOST_SHOWN] + (" ..." if len(text) > _MOST_SHOWN else "")
        else:
            words = f"{len(payload)} bytes"
    return clean(f"{time.strftime('%H:%M:%S', time.localtime(entry.utc))} node {entry.id.origin} {words}")


def closing_lines(summary: dict[str, Any]) -> Iterator[str]:
    """What became of the data."""
    s = summary
    lost = sum(s["lost"].values())
    yield ""
    yield (
        f"{s['seconds']:.0f} s: {s['created']} data created, {s['delivered']} arrived at the base, "
        f"{s['held']} still on the drones, {lost} lost"
    )
    if s["directory"] is not None:
        yield f"Everything is in {s['directory']}"

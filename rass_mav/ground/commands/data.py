"""`ls` and `get`: the data in a store, whether its node runs or not."""

from __future__ import annotations

import argparse
import base64
import contextlib
import json
import sys
import time
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from rass_mav.commands.common import Subparsers, add_command, clean, print_json, say, start_logging, warn
from rass_mav.errors import ConfigError, RassError, installing, os_errors_as

from .filters import add_filters, wanted

if TYPE_CHECKING:
    from rass_mav.ground.assembly import Extent, Group, Groups
    from rass_mav.ground.attention.rules import RuleBook
    from rass_mav.ground.entry import Data, Entry, Filter, Opens

#: Data that are read at a time with --follow.
_MOST_AT_ONCE = 1000
#: Help of the argument that names a store.
STORE_HELP = (
    "a node's configuration, a store's file (a drone's card), or a database (postgresql://...); "
    "default: the only rass-*.db in this directory"
)
_SORTS = ("arrival", "time", "drone", "reading")


def register(subparsers: Subparsers) -> None:
    """Add the commands."""
    ls = add_command(
        subparsers, "ls", _ls, help="list the data in a store; at a base, all that have arrived",
        example="rass-mav ls base.yaml --drone 7 --since 10m --above 0.5",
    )  # fmt: skip
    add_store(ls)
    add_filters(ls)
    ls.add_argument("--sort", choices=_SORTS, default="arrival", help="sort order (default: arrival)")
    ls.add_argument("--reverse", action="store_true", help="reverse the order")
    ls.add_argument(
        "--follow", action="store_true",
        help="keep listing data as they arrive, until Ctrl-C; with --json one object per line",
    )  # fmt: skip
    get = add_command(
        subparsers, "get", _get, help="fetch a datum or a file from a store",
        example="rass-mav get -c base.yaml 7-0123abcd-42 -o photo.jpg",
    )  # fmt: skip
    get.add_argument("-c", "--config", metavar="STORE|CONFIG", dest="store", help=STORE_HELP)
    _add_keys(get)
    get.add_argument("id", metavar="ID|NAME", help="an id as printed by put and ls, or the name of a file")
    get.add_argument("--partial", action="store_true", help="fetch the beginning of an incomplete file")
    add_any_size(get)
    get.add_argument("-o", "--output", type=Path, metavar="FILE", help="file to write to (default: stdout)")


def add_store(parser: argparse.ArgumentParser) -> None:
    """Add the arguments that name a store, and the keys for what is sealed in it."""
    parser.add_argument("store", metavar="STORE|CONFIG", nargs="?", help=STORE_HELP)
    _add_keys(parser)


def add_any_size(parser: argparse.ArgumentParser) -> None:
    """Add the option that lifts the limit of packed files."""
    parser.add_argument(
        "--any-size", action="store_true",
        help="unpack files of any size (default: up to 16 MiB, or 100 times their packed size)",
    )  # fmt: skip


def _add_keys(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--keys", metavar="FILE", help="the ground's keys, for sealed data (default: those that CONFIG names)"
    )


def open_archive(options: argparse.Namespace) -> Data:
    """The archive that the command names. Raises `ConfigError`, `StoreError`."""
    from rass_mav.app.outlets import SCHEMES
    from rass_mav.ground.archive import Archive, opener_of

    store: str | None = options.store
    opens = None if options.keys is None else opener_of(options.keys)
    if store is not None and store.startswith(SCHEMES):
        return _open_database(store, opens)
    if store is None:
        found = sorted(Path().glob("rass-*.db"))
        if len(found) != 1:
            what = "no" if not found else "more than one"
            raise ConfigError(
                f"{what} store rass-*.db in this directory: specify the configuration or the store's file"
            )
        store = str(found[0])
    return Archive.of(store, opens)


def rules_of(options: argparse.Namespace) -> RuleBook:
    """What the configuration and the keys say about what needs attention. Raises `ConfigError`."""
    from rass_mav.app.config import load_config
    from rass_mav.ground.attention.rules import RuleBook

    store: str | None = options.store
    if store is not None and Path(store).suffix in (".yaml", ".yml"):
        return RuleBook.of(load_config(store), options.keys)
    return RuleBook(keys=options.keys)


def _open_database(url: str, opens: Opens | None) -> Data:
    try:
        from rass_mav.ground.database import Database
    except ImportError as error:
        raise ConfigError(
            f"postgresql://: needs the Python package psycopg: {installing('postgres')} ({error})"
        ) from None
    return Database(url, opens=opens)


@contextlib.contextmanager
def read_archive(options: argparse.Namespace) -> Iterator[Data]:
    """The same; what is wrong with the store is said at the end."""
    with contextlib.closing(open_archive(options)) as archive:
        try:
            yield archive
        finally:
            for remark in archive.remarks:
                warn(clean(remark))


def _ls(options: argparse.Namespace) -> int:
    start_logging(options.verbose)
    filter = wanted(options)
    if options.follow and (options.sort != "arrival" or options.reverse):
        raise ConfigError("--follow: shows data as they arrive, so it cannot be combined with --sort or --reverse")
    if options.follow:
        _follow(options, filter)
    from rass_mav.ground.assembly import Groups

    with read_archive(options) as archive:
        listed = _Listed(filter, Groups.of(archive))
        entries, orphans = _sorted(listed.entries(archive), options), listed.orphans(archive)
        if options.json:
            data = [listed.plain(entry) for entry in entries]
            print_json({"data": data, "without_manifest": [orphan.plain() for orphan in orphans]})
        else:
            say(HEADER)
            for entry in entries:
                say(listed.line(entry))
            for orphan in orphans:
                say(orphan_line(orphan))
    return 0


class _Listed:
    """What a list shows: files rather than their parts."""

    def __init__(self, filter: Filter, groups: Groups) -> None:
        """`groups`: the parts that are there."""
        self._filter, self._groups = filter, groups
        self._singly = filter.kinds == {"part"}
        self._files: dict[object, Entry] = {}
        self._whole: set[object] = set()
        """Files that were shown when they were."""

    def entries(self, archive: Data) -> Iterator[Entry]:
        """The data to list."""
        # Parts that nobody can read are listed singly.
        parts = True if self._singly else None if self._groups.unread else False
        for entry in archive.entries(self._filter, parts=parts):
            if self._singly or entry.part is None:
                yield entry

    def orphans(self, archive: Data) -> list[Group]:
        """The files whose manifest is not there, unless the options ask for what only a manifest tells."""
        drones, kinds, *others = self._filter
        if self._singly or (kinds is not None and "file" not in kinds) or any(each is not None for each in others):
            return []
        orphans = self._groups.orphans(archive)
        return [group for group in orphans if drones is None or group.origin in drones]

    def extent(self, entry: Entry) -> Extent | None:
        """How much of a file is there."""
        return None if entry.manifest is None else self._groups.parts_of(entry).extent

    def line(self, entry: Entry) -> str:
        """For people."""
        extent = self.extent(entry)
        return datum_line(entry) if extent is None else f"{datum_line(entry)} {extent.text}"

    def plain(self, entry: Entry) -> dict[str, Any]:
        """For JSON."""
        extent = self.extent(entry)
        return entry.plain() if extent is None else {**entry.plain(), "parts": extent._asdict()}

    def arrived(self, entries: Iterable[Entry]) -> Iterator[Entry]:
        """What to show of the next data: a file once its manifest is there, and again once it is whole."""
        for entry in entries:
            shown: Entry | None = entry
            if entry.manifest is not None:
                file = self._groups.parts_of(entry)
                self._files[file.key] = entry
                self._completed(file)
            elif not self._singly and entry.part is not None and (group := self._groups.add(entry)) is not None:
                shown = self._completed(group)
            if shown is not None and self._filter.admits(shown):
                yield shown

    def _completed(self, group: Group) -> Entry | None:
        """The manifest of a file that is whole now, and was not before."""
        if group.key in self._whole or group.key not in self._files or not group.whole:
            return None
        self._whole.add(group.key)
        return self._files[group.key]


def _sorted(entries: Iterable[Entry], options: argparse.Namespace) -> Iterable[Entry]:
    if options.sort == "arrival" and not options.reverse:
        return entries
    keys = {
        "arrival": lambda entry: 0,
        "time": lambda entry: entry.utc,
        "drone": lambda entry: entry.id,
        # Data without a reading come first, as if it were the lowest.
        "reading": lambda entry: (entry.reading is not None, entry.reading or 0.0),
    }
    ordered = sorted(entries, key=keys[options.sort])
    return reversed(ordered) if options.reverse else ordered


def _follow(options: argparse.Namespace, filter: Filter) -> NoReturn:
    from rass_mav.ground.assembly import Groups
    from rass_mav.ground.feed import LOOK_S, Cursor, Feed

    listed = _Listed(filter, Groups())
    cursor: Cursor | None = None
    said: set[str] = set()

    def complain(remarks: Iterable[str]) -> None:
        """Say what was not said before."""
        for remark in remarks:
            if remark not in said:
                said.add(remark)
                warn(clean(remark))

    with contextlib.closing(Feed(lambda: open_archive(options), keep=True)) as feed:
        if not options.json:
            say(HEADER)
        while True:
            arrivals: list[tuple[Entry, Cursor]] = []
            try:
                with feed.look(cursor) as look:
                    if look.restarted:
                        warn(clean(f"{look.data.path}: recovered after damage: its data are listed again"))
                        listed = _Listed(filter, Groups())
                    cursor = look.start
                    arrivals = list(islice(look.arrivals(), _MOST_AT_ONCE))
                    complain(look.data.remarks)
            except RassError as error:
                if cursor is None:
                    raise
                # Its node finds out, and repairs it.
                complain(error.lines())
            for entry in listed.arrived(entry for entry, _ in arrivals):
                if options.json:
                    print_json(listed.plain(entry))
                else:
                    say(listed.line(entry))
            sys.stdout.flush()
            if arrivals:
                cursor = arrivals[-1][1]
            if len(arrivals) < _MOST_AT_ONCE:
                time.sleep(LOOK_S)


#: The first line of a list.
HEADER = f"{'ID':<28} {'CREATED (UTC)':<24} {'+/- S':>6} {'HOPS':>4} {'BYTES':>7}  CONTENT"


def datum_line(entry: Entry) -> str:
    """One datum of a list. A < before the date: or earlier; no +/-: nobody knows how wrong the date is."""
    from rass_mav.ground.entry import iso

    date = ("<" if entry.at_least else "") + iso(entry.utc) if entry.dated else "unknown"
    error = "" if entry.error_s is None else f"{entry.error_s:.0f}"
    return clean(f"{entry.name:<28} {date:<24} {error:>6} {entry.hops:>4} {entry.size:>7}  {content(entry)}")


def orphan_line(group: Group) -> str:
    """A file whose manifest is not there."""
    blank = f"{group.name:<28} {'unknown':<24} {'':>6} {'':>4} {group.cut.length:>7}"
    return f"{blank}  file of drone {group.origin} with no manifest yet, {group.extent.text}"


def content(entry: Entry) -> str:
    """What a datum contains, in words, and its terms."""
    if entry.priority is None:
        return _words(entry)
    return f"{_words(entry)} (priority {entry.priority}{'' if entry.ttl_s is None else f', ttl {entry.ttl_s} s'})"


def _words(entry: Entry) -> str:
    from rass_mav.wire.measurement import UNIT_NAMES

    if entry.malformed:
        return f"{entry.kind_name}, {entry.malformed}"
    if (status := entry.status) is not None:
        return f"status, {status.held} in custody, {status.alone} of them with no other copy, risk {status.risk:.3f}"
    if (m := entry.measurement) is None:
        if entry.part is not None:
            return f"part {entry.part.number} of file-{entry.part.cut.key.hex()}"
        return entry.kind_name if entry.file is None else f"file {entry.file}"
    parts = ["no reading"]
    if m.reading is not None:
        parts = [f"{m.reading:g} {UNIT_NAMES[m.unit]}" if m.unit else f"reading {m.reading:g}"]
    parts.append(f"risk {m.risk:.3f}")
    if entry.place is not None:
        parts.append(f"at {m.latitude:.7f} {m.longitude:.7f} {m.altitude:.1f} m")
    elif m.local is not None:
        parts.append("at {:.2f} m north, {:.2f} m east, {:.2f} m down".format(*m.local))
    if m.error_m is not None:
        parts.append(f"+/- {m.error_m:.1f} m")
    return ", ".join(parts)


def _get(options: argparse.Namespace) -> int:
    from rass_mav.ground.assembly import find

    start_logging(options.verbose)
    with read_archive(options) as archive:
        entry, file = find(archive, options.id, any_size=options.any_size)
        if file is None:
            assert entry is not None
            content = _content(archive, entry)
            pieces, size = iter([content]), len(content)
        elif options.partial and not file.extent.whole:
            # Read once more, to say its size before it.
            size = sum(map(len, file.beginning())) if options.json else 0
            pieces = file.beginning()
        else:
            size, pieces = file.check(), file.pieces()
        found: dict[str, Any] = {} if entry is None else entry.plain()
        if file is not None:
            found = {"name": file.name, **found, "parts": file.extent._asdict()}
        if options.output is not None:
            with os_errors_as(RassError, options.output), options.output.open("wb") as out:
                found["bytes"] = sum(map(out.write, pieces))
            if options.json:
                print_json(found)
        elif options.json:
            _print_with({**found, "bytes": size}, pieces)
        else:
            for piece in pieces:
                sys.stdout.buffer.write(piece)
    if not options.json and file is not None and not file.extent.whole:
        warn(clean(f"{file.name}: {file.extent.text} have arrived; this is the beginning, up to the first gap"))
    return 0


def _print_with(plain: dict[str, Any], pieces: Iterable[bytes]) -> None:
    """One JSON object on stdout, with `content` in base64 as its last member, which need not fit into memory."""
    write = sys.stdout.write
    write(f'{json.dumps(plain)[:-1]}, "content": "')
    rest = b""
    for piece in pieces:
        rest += piece
        whole = len(rest) - len(rest) % 3
        write(base64.b64encode(rest[:whole]).decode())
        rest = rest[whole:]
    write(f'{base64.b64encode(rest).decode()}"}}\n')


def _content(archive: Data, entry: Entry) -> bytes:
    """Of a datum that is a whole."""
    from rass_mav.app.payloads import unpack_file
    from rass_mav.core.datum import Kind

    payload = archive.payload(entry.name)
    return unpack_file(payload)[1] if entry.kind == Kind.FILE and not entry.malformed else payload

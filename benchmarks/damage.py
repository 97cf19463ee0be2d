"""What a damaged store still gives, by the product's salvage and by SQLite alone, row by row around the damage.

    python -m benchmarks.damage [--faults N] [--data N ...] [--json]

Stores that were closed, and stores as `kill -9` leaves them, get one fault each: flipped bits, a cut, a zeroed page or
sector in the database or its log, or the log is gone. Of each damaged copy it is counted which of the data are whole in

- the store that a node opens (`SqliteStore.open`: all of the log is used, and pages are read one by one if needed).
- what SQLite finds: by rowid up and down until it fails, each id that the index has, and each rowid alone; on the copy
  as it is, and again with the description of the tables lent by a new store. Reading makes it replay the log.

Shares are of the data held at the end, with the 95 % interval of the mean over the faults.
"""

from __future__ import annotations

import argparse
import json
import random
import shutil
import sqlite3
import statistics
import struct
import tempfile
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, NamedTuple

from rass_mav.core.datum import Datum, DatumId, Fate, make_datum
from rass_mav.errors import StoreError
from rass_mav.store.disk import HOST
from rass_mav.store.drafts import connect
from rass_mav.store.payloads import Payloads
from rass_mav.store.sqlite import SqliteStore

NODE = 7
NAME = "node.db"
ENDINGS = ("", "-wal", ".mark", ".payloads")
KINDS = ("one bit", "nine bits", "cut", "4 KiB zeroed", "sector zeroed", "gone")
FILES = ("", "-wal")
#: How many data the stores hold. Each has twelve forms.
DATA = (30, 600)
FORMS = 12
#: Bytes of payload: measurements, and now and then what has pages of its own or lies beside the database.
SIZES = (40, 45, 45, 45, 45, 60, 60, 97, 900, 9000)
#: Of the columns of a row, the arrival last.
_COLUMNS = "origin, epoch, sequence, kind, created, hops, crc, size, at_least, payload, arrival"
_DAMAGE = (sqlite3.Error, OSError, UnicodeDecodeError)


class Past(NamedTuple):
    """A store as it ended."""

    directory: Path
    held: dict[DatumId, Datum]


class Outcome(NamedTuple):
    """The shares of the data held that one damaged copy gave."""

    data: int
    """How many the store held."""
    what: str
    salvage: float
    rows: float


def live(path: Path, rng: random.Random, data: int, *, killed: bool) -> Past:
    """A node's store: it takes data, passes some on, and holds `data` of them in the end."""
    end = path.parent / "end"
    end.mkdir()
    held: dict[DatumId, Datum] = {}
    for last in (False, True):
        store = opened(path, rng)
        while len(held) < (data if last else data // 2):
            for _ in range(rng.randrange(1, 5)):
                id = DatumId(NODE, store.epoch, store.next_sequence())
                held[id] = make_datum(id, 1, 1.5, rng.randbytes(rng.choice(SIZES)))
                store.put(held[id])
            if rng.random() < 0.3:
                id = rng.choice(list(held))
                store.remove(id, Fate.PASSED_ON)
                del held[id]
            commit(store)
        if not last:
            store.close()
    if killed:
        copy(path, end)
        store.abandon()
    else:
        store.close()
        copy(path, end)
    return Past(end, held)


def commit(store: SqliteStore) -> None:
    """Make the changes durable."""
    batch = store.take(force=True)
    if batch is not None:
        store.write(batch)


def opened(path: Path, rng: random.Random) -> SqliteStore:
    """Open a store as its node does."""
    return SqliteStore.open(path, node_id=NODE, draw_epoch=lambda: rng.getrandbits(32))


def copy(path: Path, directory: Path) -> Path:
    """A copy of the store at `path`; returns its path."""
    for ending in ENDINGS:
        file = path.with_name(NAME + ending)
        if file.exists():
            shutil.copy(file, directory / file.name)
    return directory / NAME


def damage(path: Path, rng: random.Random) -> str:
    """Damage the database or its log. Returns what was done."""
    files = [file for ending in FILES if (file := path.with_name(NAME + ending)).exists() and file.stat().st_size]
    file = rng.choice(files)
    content = bytearray(file.read_bytes())
    kind = rng.choice(KINDS if file != path else KINDS[:-1])
    if kind == "gone":
        file.unlink()
    else:
        if kind.endswith(("bit", "bits")):
            for _ in range(1 if kind == "one bit" else 9):
                content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
        elif kind == "cut":
            del content[rng.randrange(len(content)) :]
        else:
            size = 512 if kind.startswith("sector") else 4096
            at = rng.randrange(len(content)) // size * size
            content[at : at + size] = bytes(len(content[at : at + size]))
        file.write_bytes(content)
    return f"{'log' if file != path else 'database'}: {kind}"


def by_salvage(path: Path, rng: random.Random) -> Iterator[Datum]:
    """What the product's own store has after it was opened."""
    with opened(path, rng) as store:
        for id in list(store.ids()):
            datum = store.get(id)
            if datum is not None:
                yield datum


def by_rows(path: Path, lent: dict[int, bytes]) -> Iterator[Datum]:
    """What SQLite alone finds. `lent`: pages of a new store that take the place of this one's."""
    with suppress(OSError, StoreError), closing(Payloads(path, HOST, writable=False)) as payloads:
        yield from _rows(path, payloads)
        content = bytearray(path.read_bytes())
        for number, page in lent.items():
            at = (number - 1) * len(page)
            content.extend(bytes(max(0, at + len(page) - len(content))))
            content[at : at + len(page)] = page
        # How many pages there are.
        struct.pack_into(">I", content, 28, len(content) // len(lent[1]))
        path.write_bytes(content)
        yield from _rows(path, payloads)


def description(empty: Path) -> dict[int, bytes]:
    """The pages of a new store, from 1, that are no page of a table: they say which tables there are, and where. In
    every store they are the same, but for a few numbers in the first."""
    with closing(connect(empty, "ro")) as connection:
        [(size,)] = connection.execute("PRAGMA page_size").fetchall()
        roots = {root for (root,) in connection.execute("SELECT rootpage FROM sqlite_master")}
    content = empty.read_bytes()
    pages = {at // size + 1: content[at : at + size] for at in range(0, len(content), size)}
    return {number: page for number, page in pages.items() if number not in roots}


def _rows(path: Path, payloads: Payloads) -> Iterator[Datum]:
    with suppress(*_DAMAGE), closing(connect(path, "ro")) as connection:
        connection.execute("PRAGMA cell_size_check = OFF")
        last = 0
        for row in (
            *_until_it_fails(connection, f"SELECT {_COLUMNS} FROM datum NOT INDEXED ORDER BY arrival"),
            *_until_it_fails(connection, f"SELECT {_COLUMNS} FROM datum NOT INDEXED ORDER BY arrival DESC"),
        ):
            last = max(last, row[-1])
            yield from _datum(row, payloads)
        ids = "SELECT arrival FROM datum INDEXED BY sqlite_autoindex_datum_1 ORDER BY origin, epoch, sequence"
        indexed = {
            row[0] for way in (ids, ids.replace(",", " DESC,") + " DESC") for row in _until_it_fails(connection, way)
        }
        # Any rowid that can have been there: here they are counted from 1.
        for arrival in {*range(1, last + 500), *indexed}:
            one = _until_it_fails(connection, f"SELECT {_COLUMNS} FROM datum WHERE arrival = {arrival}")
            for row in one:
                yield from _datum(row, payloads)


def _until_it_fails(connection: sqlite3.Connection, statement: str) -> Iterator[tuple[Any, ...]]:
    with suppress(*_DAMAGE):
        yield from connection.execute(statement)


def _datum(row: tuple[Any, ...], payloads: Payloads) -> Iterator[Datum]:
    """The datum that a row is, if it is whole."""
    origin, epoch, sequence, kind, created, hops, crc, size, at_least, payload, _ = row
    with suppress(TypeError, ValueError, OverflowError, struct.error):
        if type(payload) is int:
            payload = payloads.read(payload, size)
        yield Datum(DatumId(origin, epoch, sequence), kind, created, hops, crc, payload, bool(at_least))


def share(found: Iterable[Datum], past: Past) -> float:
    """The part of the data held that is among what was found, whole."""
    whole = set()
    for datum in found:
        original = past.held.get(datum.id)
        if original is not None and (datum.kind, datum.crc, datum.payload) == original[1:2] + original[4:6]:
            whole.add(datum.id)
    return len(whole) / len(past.held)


def measure(faults: int, amounts: Sequence[int]) -> list[Outcome]:
    """Damage, and try both."""
    outcomes = []
    with tempfile.TemporaryDirectory() as directory:
        pasts = defaultdict(list)
        for data in amounts:
            for form in range(FORMS):
                path = Path(directory) / f"past-{data}-{form}" / NAME
                path.parent.mkdir()
                pasts[data].append(live(path, random.Random(form), data, killed=form % 4 > 0))
        empty = Path(directory) / "empty.db"
        opened(empty, random.Random(0)).close()
        lent = description(empty)
        for seed in range(faults):
            rng = random.Random(seed)
            data = amounts[seed % len(amounts)]
            past = rng.choice(pasts[data])
            with (
                tempfile.TemporaryDirectory(dir=directory) as mine,
                tempfile.TemporaryDirectory(dir=directory) as theirs,
            ):
                path = copy(past.directory / NAME, Path(mine))
                what = damage(path, rng)
                again = copy(path, Path(theirs))
                try:
                    salvage = share(by_salvage(path, rng), past)
                except StoreError:
                    # The version has grown: a node does not start on a store that a newer program wrote.
                    continue
                outcomes.append(Outcome(data, what, salvage, share(by_rows(again, lent), past)))
    return outcomes


def interval(values: Sequence[float]) -> tuple[float, float]:
    """Mean, and half of its 95 % interval, in percent."""
    spread = statistics.stdev(values) / len(values) ** 0.5 if len(values) > 1 else 1.0
    return 100 * statistics.mean(values), 196 * spread


def summarize(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """A row for each kind of damage and size of store, and for all."""
    groups: dict[tuple[str, str], list[Outcome]] = defaultdict(list)
    for outcome in outcomes:
        for data in (str(outcome.data), "all"):
            for what in (outcome.what, outcome.what.partition(":")[0], "all"):
                groups[data, what].append(outcome)
    return [
        {
            "data": data,
            "what": what,
            "faults": len(group),
            "salvage": interval([outcome.salvage for outcome in group]),
            "rows": interval([outcome.rows for outcome in group]),
            "difference": interval([outcome.salvage - outcome.rows for outcome in group]),
        }
        for (data, what), group in sorted(groups.items())
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--faults", type=int, default=1_000, metavar="N")
    parser.add_argument("--data", type=int, nargs="+", default=DATA, metavar="N", help="how many data a store holds")
    parser.add_argument("--json", action="store_true", help="print a JSON object")
    options = parser.parse_args(arguments)
    rows = summarize(measure(options.faults, options.data))
    if options.json:
        print(json.dumps(rows))
        return
    print(f"{'data':>5} {'damage':<25} {'faults':>7} {'salvage, %':>14} {'SQLite, %':>14} {'difference':>14}")
    for row in rows:
        cells = (f"{row[name][0]:>7.2f} ± {row[name][1]:<4.2f}" for name in ("salvage", "rows", "difference"))
        print(f"{row['data']:>5} {row['what']:<25} {row['faults']:>7} " + " ".join(cells))


if __name__ == "__main__":
    main()

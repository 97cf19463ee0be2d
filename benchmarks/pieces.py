"""What keeping large data that come in pieces costs: the store, and a table of pieces in SQLite instead.

    python -m benchmarks.pieces [--sizes BYTES ...] [--pieces BYTES ...]        (Python 3.11)

A datum comes in pieces of some bytes, each with a commit of its own: in order, or every other one first. When all have
come, its row is committed to the database (WAL, `synchronous = FULL`). A datum leaves 64 data later. Data above 32 KiB
come as parts of that size, as files do. What the write calls are given and the calls that sync are counted in the
simulated disk's layer under SQLite and under the files beside it, from opening to closing: logs, checkpoints and
rollback journals are included. The variants:

- store: what a node uses, `SqliteStore` with `keep_partial`.
- WAL, rows: the pieces are rows of a table in the database.
- WAL, blob: a zeroblob in the database, written by incremental I/O.
- file, rows / blob: the same in a second file with a rollback journal (`TRUNCATE`), `synchronous = FULL`.
- file, OFF: the same blob in a second file without any journal. A crash in a commit can destroy that file.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from contextlib import closing
from itertools import count
from pathlib import Path
from random import Random

from rass_mav.core.datum import DatumId, Fate, make_datum
from rass_mav.core.store import key_of
from rass_mav.lab.disk import Disk
from rass_mav.store.disk import BlockFile
from rass_mav.store.drafts import connect
from rass_mav.store.schema import PAGE_BYTES
from rass_mav.store.sqlite import SqliteStore

PART = 32 << 10
#: Data that are stored at a time.
LAG = 64
VARIANTS = ("store", "WAL, rows", "WAL, blob", "file, rows", "file, blob", "file, OFF")
#: Of the second file, bytes: with larger ones more is written.
FILE_PAGE_BYTES = 512


class CountingDisk(Disk):
    """Counts the syncs too."""

    def __init__(self, rng: Random) -> None:
        super().__init__(rng)
        self.syncs = 0

    def _sync(self, address: int, flags: int) -> int:
        self.syncs += 1
        return super()._sync(address, flags)

    def open_file(self, path: Path, *, writable: bool) -> BlockFile:
        file = super().open_file(path, writable=writable)
        sync = file.sync

        def count_sync() -> None:
            self.syncs += 1
            sync()

        file.sync = count_sync  # type: ignore[method-assign]
        return file


def pieces(payload: bytes, size: int, ordered: bool) -> Iterator[tuple[int, bytes]]:
    """The pieces of a payload with their offsets."""
    starts = range(0, len(payload), size)
    for start in starts if ordered else (*starts[1::2], *starts[::2]):
        yield start, payload[start : start + size]


def by_store(path: Path, disk: CountingDisk, payloads: Iterator[bytes], size: int, ordered: bool) -> None:
    """What a node uses."""
    store = SqliteStore.open(path, node_id=7, draw_epoch=count(0xFEDC0001).__next__, disk=disk)
    held: list[DatumId] = []
    for payload in payloads:
        datum = make_datum(DatumId(9, 0xFEDC0009, len(held)), 1, 0.0, payload)
        for offset, data in pieces(payload, size, ordered):
            store.keep_partial(key_of(datum), offset, data)
            if (batch := store.take()) is not None:
                store.write(batch)
        store.put(datum)
        held.append(datum.id)
        if len(held) > LAG:
            store.remove(held[-LAG - 1], Fate.PASSED_ON)
        store.write(store.take())
    store.close()


def by_table(path: Path, disk: CountingDisk, payloads: Iterator[bytes], size: int, ordered: bool, variant: str) -> None:
    """A table of pieces, or of blobs."""
    where, _, how = variant.partition(", ")
    main = connect(path, "rwc", vfs=disk.vfs)
    main.execute("PRAGMA synchronous = FULL")
    main.execute(f"PRAGMA page_size = {PAGE_BYTES}")
    main.execute("CREATE TABLE datum (arrival INTEGER PRIMARY KEY, origin, epoch, sequence, kind, created, hops, crc, "
                 "size, at_least, payload, UNIQUE (origin, epoch, sequence))")  # fmt: skip
    main.execute("PRAGMA journal_mode = WAL").fetchall()
    main.execute("PRAGMA wal_autocheckpoint = 7825")
    second = main if where == "WAL" else connect(path.with_name("pieces"), "rwc", vfs=disk.vfs)
    for connection in (main, second):
        # Debian's SQLite writes zeros over what is removed.
        connection.execute("PRAGMA secure_delete = OFF").fetchall()
    if second is not main:
        second.execute("PRAGMA synchronous = FULL")
        second.execute(f"PRAGMA page_size = {FILE_PAGE_BYTES}")
        second.execute(f"PRAGMA journal_mode = {'OFF' if how == 'OFF' else 'TRUNCATE'}").fetchall()
    second.execute("CREATE TABLE piece (datum, at, data, PRIMARY KEY (datum, at))" if how == "rows" else
                   "CREATE TABLE piece (datum INTEGER PRIMARY KEY, data)")  # fmt: skip
    with closing(main), closing(second):
        for number, payload in enumerate(payloads):
            if how != "rows":
                second.execute("INSERT INTO piece VALUES (?, zeroblob(?))", (number, len(payload)))
            for offset, data in pieces(payload, size, ordered):
                if how == "rows":
                    second.execute("INSERT INTO piece VALUES (?, ?, ?)", (number, offset, data))
                else:
                    with second.blobopen("piece", "data", number) as blob:  # type: ignore[attr-defined]
                        blob.seek(offset)
                        blob.write(data)
            row = (9, 0xFEDC0009, number, 1, 0.0, 0, 0xFEDCBA98, len(payload), 0, number)
            main.execute("BEGIN")
            main.execute("INSERT INTO datum VALUES (NULL, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", row)
            main.execute("DELETE FROM datum WHERE sequence = ?", (number - LAG,))
            main.execute("COMMIT")
            second.execute("DELETE FROM piece WHERE datum = ?", (number - LAG,))


def measure(variant: str, total: int, size: int, ordered: bool) -> tuple[float, float]:
    """Bytes written for each byte stored, and syncs a datum."""
    each = min(total, PART)
    amount = max(total // each, 4 * LAG)
    rng = Random(1)
    disk = CountingDisk(rng)
    with disk:
        payloads = (rng.randbytes(each) for _ in range(amount))
        path = disk.directory / "node.db"
        if variant == "store":
            by_store(path, disk, payloads, size, ordered)
        else:
            by_table(path, disk, payloads, size, ordered, variant)
        return disk.written / (amount * each), disk.syncs / amount


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=[1_000, 100_000, 5_000_000], metavar="BYTES")
    parser.add_argument("--pieces", type=int, nargs="+", default=[1_230, 8_192, PART], metavar="BYTES")
    options = parser.parse_args(arguments)
    print(f"{'':33} {'bytes written a byte, syncs a datum':^60}")
    print(f"{'stored':>10} {'piece':>7} {'order':>10} " + " ".join(f"{name:>14}" for name in VARIANTS))
    for total in options.sizes:
        for size in options.pieces:
            for ordered in (True, False):
                cells = [measure(variant, total, size, ordered) for variant in VARIANTS]
                text = " ".join(f"{ratio:>7.2f} {syncs:>6.1f}" for ratio, syncs in cells)
                print(f"{total:>10} {size:>7} {'in order' if ordered else 'alternate':>10} {text}", flush=True)


if __name__ == "__main__":
    main()

"""A store's files with bytes changed: it opens, takes nothing wrong for right, and gives no number twice."""

from __future__ import annotations

import tempfile
from functools import cache
from itertools import count
from pathlib import Path

from rass_mav.core.datum import DatumId, Fate, make_datum
from rass_mav.errors import StoreError
from rass_mav.store.repairs import OpenReport
from rass_mav.store.sqlite import SqliteStore
from tests.some import some

from .source import Source

NODE = 7
FILES = ("node.db", "node.db.mark", "node.db-wal", "node.db.payloads")
#: Data in the store; every other one is beside the database.
COUNT = 6
#: Places that change at most.
MOST_CHANGES = 8


def _payload(sequence: int) -> bytes:
    return bytes([sequence + 1]) * (40 if sequence % 2 else 4500)


def _open(path: Path, epoch: int) -> SqliteStore:
    return SqliteStore.open(path, draw_epoch=count(epoch).__next__, node_id=NODE)


@cache
def _images() -> tuple[tuple[int, dict[str, bytes]], ...]:
    """The epoch and the files of a store that was closed, and of one that lost its power with all of it in the log."""
    images = []
    for closed in (True, False):
        with tempfile.TemporaryDirectory() as directory:
            path = Path(directory) / FILES[0]
            store = _open(path, 100)
            for _ in range(COUNT):
                sequence = store.next_sequence()
                store.put(make_datum(DatumId(NODE, store.epoch, sequence), 0, 1.0, _payload(sequence)))
            store.lose(DatumId(3, 4, 5), Fate.CORRUPTED)
            batch = some(store.take(force=True))
            store.write(batch)
            if closed:
                store.close()
            found = {name: (path.parent / name) for name in FILES if (path.parent / name).exists()}
            images.append((store.epoch, {name: file.read_bytes() for name, file in found.items()}))
            store.close()
    return tuple(images)


def damage(data: bytes, directory: Path) -> None:
    """The first byte says which store it is; then come a file, a place in it and what stands there."""
    source = Source(data)
    epoch, image = source.pick(_images())
    files = {name: bytearray(content) for name, content in image.items()}
    for _ in range(MOST_CHANGES):
        if not source:
            break
        content = files[source.pick(list(files))]
        at = int.from_bytes(source.some(3), "little") % (len(content) + 1)
        if source.byte() % 16 == 0:
            del content[at:]
        else:
            new = source.some(source.byte() % 8)
            content[at : at + len(new)] = new
    for name, content in files.items():
        (directory / name).write_bytes(content)
    _check(directory / FILES[0], epoch)


def _check(path: Path, epoch: int) -> None:
    given = {(epoch, sequence) for sequence in range(COUNT)}
    for first in (1000, 2000):
        try:
            store = _open(path, first)
        except StoreError:
            return
        with store:
            if first == 2000:
                assert store.report == OpenReport(), store.report
            for id in list(store.ids()):
                datum = store.get(id)
                if datum is not None and datum.intact:
                    assert datum.payload == _payload(id.sequence)
            sequence = store.next_sequence()
            assert (store.epoch, sequence) not in given
            given.add((store.epoch, sequence))
            store.put(make_datum(DatumId(NODE, store.epoch, sequence), 0, 1.0, _payload(sequence)))

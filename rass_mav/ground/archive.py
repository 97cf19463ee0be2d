"""The data in a store, read without its node: while that runs, after it has stopped, or from a drone's card."""

from __future__ import annotations

import os
import re
import time
from codecs import getincrementaldecoder
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from itertools import chain
from math import isinf
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unicodedata import category

from rass_mav.app.clock import MOST_S, DateNote
from rass_mav.app.config import RunConfig, load_config
from rass_mav.app.payloads import parse_name, unpack_file
from rass_mav.config.keys import check_package
from rass_mav.core.datum import PARTS, TERMS, TERMS_SIZE, Datum, DatumId, Fate, Kind, datum_crc, parted, terms_of
from rass_mav.core.seals import SEALED
from rass_mav.core.store import StoredInfo
from rass_mav.errors import ConfigError, ForgedError, KeysError, MalformedError, StoreDamagedError, StoreError
from rass_mav.link.airtime import STALE_TURNS
from rass_mav.store.files import PAYLOADS, beside
from rass_mav.store.reader import SqliteReader
from rass_mav.store.reading import salvaged_copy
from rass_mav.store.schema import ARRIVAL_0_MS, Row
from rass_mav.wire.file import decode_head, decode_manifest
from rass_mav.wire.measurement import decode_measurement
from rass_mav.wire.nodestatus import decode_status

from .entry import Data, Entry, Opens

#: Bytes of a payload that a list needs: terms, and a manifest with the longest name of a file.
HEAD_BYTES = TERMS_SIZE + 384
#: What a clock that is set by NTP or GPS may be wrong by, seconds; and the drift of a computer's clock without them.
DATE_ERROR_S = 1.0
DRIFT = 1e-4
#: A number in a store that is 1 once nothing more will come: the run that wrote it is over.
ENDED = "run.ended"
#: Why a drone releases data that may have arrived. A base releases none.
_RELEASED = (Fate.PASSED_ON, Fate.DELIVERED, Fate.VANISHED)
_DRONES_STORE = (
    "This store is a drone's, not a base's: \"missing\" includes data that it has handed over, which may have arrived. "
    "Only the report of a base tells."
)
# A node's store, unless it has another name, and that of the base of `try`: they say nothing about the mission.
_USUAL_NAME = re.compile(r"rass-\d+|base")


class Archive(Data):
    """The data in a store. It changes nothing, and needs no node.

    A damaged store is read as far as it goes: `remarks` says what was done.
    """

    def __init__(
        self, path: str | os.PathLike[str], now: Callable[[], float] = time.time, *, salvage: bool = True,
        opens: Opens | None = None, title: str | None = None,
    ) -> None:  # fmt: skip
        """`now`: the date, seconds since 1970. `opens`: opens sealed data; None: they stay sealed. `title`: the
        mission's name; None: that of the file, with its folder if it is a usual one. Raises `StoreError` if there is
        nothing to read; without `salvage`, also if the store is damaged."""
        super().__init__(now, opens)
        self.path = Path(path)
        self.title = title or _title(self.path)
        self._stack = ExitStack()
        self._may_salvage = salvage
        self._open()

    def _open(self) -> None:
        self._salvaged = False
        # Before they are opened: if they are replaced at this moment, the next `renew` opens them again.
        self._files = self._files_now()
        try:
            self._reader = self._stack.enter_context(SqliteReader(self.path))
        except StoreDamagedError as error:
            try:
                self._salvage(error)
            except BaseException:
                self._stack.close()
                raise
        self._look_at_clock()

    def _files_now(self) -> tuple[int | None, int | None]:
        """The number of the database's file and of that of its large payloads; None: it does not exist."""
        return _inode(self.path), _inode(beside(self.path, PAYLOADS))

    @classmethod
    def of(cls, store_or_config: str, opens: Opens | None = None) -> Archive:
        """The archive of a store's file, or of the node of a configuration (`.yaml` or `.yml`). `opens`: None: with the
        keys that the configuration names, if they can be used. Raises `ConfigError`, `StoreError`."""
        path = Path(store_or_config)
        trouble, title = "", None
        if path.suffix in (".yaml", ".yml"):
            config = load_config(path)
            path, title = config.store_path, title_of(config)
            try:
                opens = opens or opener_of_node(config)
            except KeysError as error:
                trouble = str(error)
        if not path.exists():
            raise ConfigError(f"{path}: no such store")
        if path.is_dir():
            raise ConfigError(f"{path} is a folder, not a store or a configuration")
        archive = cls(path, opens=opens, title=title)
        archive.remarks += [trouble] if trouble else []
        return archive

    def _salvage(self, error: StoreError) -> None:
        """Read from now on a copy of what can be read. Raises the error if there is none."""
        if self._salvaged or not self._may_salvage:
            raise error
        copy = Path(self._stack.enter_context(TemporaryDirectory(prefix="rass-mav-"))) / "salvaged.db"
        found = salvaged_copy(self.path, copy)
        if not found:
            raise error
        self._reader = self._stack.enter_context(SqliteReader(copy))
        self._salvaged = True
        self.remarks.append(f"{error}; {found} data could be read")

    @property
    def notes(self) -> list[str]:
        return [_DRONES_STORE] if self.drones_store else []

    @property
    def drones_store(self) -> bool:
        """Whether its node has released data that may have arrived elsewhere, which no base does."""
        reader = self._reader
        if any(reader.counters().get(fate.value) for fate in _RELEASED):
            return True
        # Counters reach the disk late. Of its own data, those that it neither holds nor has lost were handed over.
        if not reader.assigned:
            return False
        ids = chain(reader.ids(), (id for id, _ in reader.losses()))
        return len({id for id in ids if id.epoch == reader.epoch}) < reader.assigned

    def _look_at_clock(self) -> None:
        meta = self._reader.meta()
        self._date = DateNote.of(meta)
        # On a slow link a frame may wait for its turn, after the age in it was written.
        self._hop_s = STALE_TURNS * max(meta.get("turn", 0) / 10, 1.0)

    def renew(self) -> None:
        """Read from now on what the store holds now, also if its node has replaced or repaired it meanwhile."""
        files = self._files_now()
        if files != self._files and files[0] is not None:
            self._stack.close()
            self._open()
        elif not self._salvaged:
            self._reader.renew()
            self._look_at_clock()

    def rest(self) -> None:
        """Read nothing until `renew`."""
        if not self._salvaged:
            self._reader.rest()

    @property
    def lineage(self) -> tuple[int, int]:
        """The life and the epoch of the store, 32 bits each; of a copy of a damaged one, its file. While they stay the
        same, no `Entry.arrival` is used for another datum."""
        return (0, self._files[0] or 0) if self._salvaged else (self._reader.life, self._reader.epoch)

    @property
    def ended(self) -> bool:
        """Whether the run that wrote it is over."""
        return self._reader.meta().get(ENDED) == 1

    @property
    def date(self) -> DateNote:
        """When its node wrote last, and whether it knew the date."""
        return self._date

    def count(self, *, after: int = -1) -> int:
        """How many rows `entries` reads. `after`: only data that arrived later, without second contents."""
        try:
            return self._reader.count(after)
        except StoreDamagedError as error:
            self._salvage(error)
            return self._reader.count(after)

    def arrivals(self, after: int, *, apart: bool = False, parts: bool | None = None) -> Iterator[Entry]:
        """What arrived later than this `Entry.arrival`, in this order."""
        return (self._entry(row, apart) for row in self._rows(after, apart, parts))

    def _rows(self, after: int, apart: bool, parts: bool | None) -> Iterator[Row]:
        unsound = empty = 0
        try:
            for row in self._reader.rows(HEAD_BYTES, after=after, apart=apart, parts=parts):
                if row is None:
                    unsound += 1
                else:
                    after = row.arrival
                    empty += _lacks_content(row.info, row.head)
                    yield row
        except StoreDamagedError as error:
            self._salvage(error)
            yield from self._rows(after, apart, parts)
        # Whoever follows the store comes to the same rows again.
        if unsound:
            self._remark(f"{self.path}: {unsound} damaged rows skipped")
        if empty:
            self._remark(f"{self._reader.about_payloads()}: the contents of {empty} data cannot be read")

    def _remark(self, remark: str) -> None:
        if remark not in self.remarks:
            self.remarks.append(remark)

    def _entry(self, row: Row, apart: bool, whole: Callable[[], bytes] | None = None) -> Entry:
        """`whole`: returns the payload; None: from the store."""
        arrival, info, head = row
        date = self._date
        arrived = date.offset_s + (arrival - ARRIVAL_0_MS) / 1000 if arrival >= ARRIVAL_0_MS and not apart else None
        if not abs(info.created) < MOST_S:
            latest = date.lived_s if arrived is None else arrived - date.offset_s
            info = info._replace(created=0.0 if isinf(latest) else latest, at_least=True)
        utc = info.created + date.offset_s
        # A flipped bit on the disk must not put a datum in the future.
        age_s = max(0.0, self._now() - utc if date.trusted or isinf(date.lived_s) else date.lived_s - info.created)
        bounded = date.trusted and not info.at_least
        # Clocks drift until it arrives; where that is not known, until the store was last used.
        aged_s = max(0.0, date.lived_s - info.created if arrived is None else arrived - utc)
        entry = Entry(
            arrival, info.id, info.crc, info.kind, info.size, info.hops, utc,
            DATE_ERROR_S + DRIFT * aged_s + info.hops * self._hop_s if bounded else None,
            info.at_least, age_s, arrived=arrived, apart=apart,
        )  # fmt: skip
        return entry._replace(**content(info, head, whole or (lambda: self._stored(info, apart)), self._opens))

    def _stored(self, info: StoredInfo, apart: bool) -> bytes:
        datum = self._reader.get_apart(info.id, info.crc) if apart else self._reader.get(info.id)
        return b"" if datum is None else datum.payload

    def datum(self, name: str) -> Datum:
        """A datum by its name, as it is stored. Raises `DatumError`: not a name; `StoreError`: there is none, or it is
        corrupt."""
        id, crc = parse_name(name)
        datum = self._reader.get(id) if crc is None else self._reader.get_apart(id, crc)
        if datum is None:
            raise StoreError(f"{name}: not in {self.path}")
        if not datum.intact:
            raise StoreError(f"{name}: corrupt, its checksum does not match")
        return datum

    def entry(self, name: str) -> Entry:
        """The same as an entry."""
        datum, (_, crc) = self.datum(name), parse_name(name)
        info = StoredInfo(*datum[:5], len(datum.payload), datum.at_least)
        return self._entry(Row(-1, info, datum.payload[:HEAD_BYTES]), crc is not None, lambda: datum.payload)

    def losses(self) -> list[tuple[DatumId, Fate]]:
        """What is known to be lost."""
        return self._reader.losses()

    def close(self) -> None:
        """Release the files."""
        self._stack.close()


def title_of(config: RunConfig) -> str | None:
    """The mission's name in a node's configuration; None: it has none."""
    return None if config.postgres is None else config.postgres.mission


def _title(path: Path) -> str:
    folder = path.absolute().parent.name
    return f"{folder}/{path.stem}" if folder and _USUAL_NAME.fullmatch(path.stem) else path.stem


def _inode(path: Path) -> int | None:
    try:
        return path.stat().st_ino
    except OSError:
        return None


def content(info: StoredInfo, head: bytes, whole: Callable[[], bytes], opens: Opens | None) -> dict[str, Any]:
    """The fields of an entry that its payload tells. `head`: its first `HEAD_BYTES`. `whole`: returns all of it."""
    if _lacks_content(info, head):
        return {"malformed": "its content is missing"}
    if info.size == len(head) and datum_crc(info.id, info.kind, head) != info.crc:
        return {"kind": info.kind & ~TERMS, "malformed": "corrupt, its checksum does not match"}
    known: dict[str, Any] = {}
    if info.kind & TERMS:
        if info.size <= TERMS_SIZE:
            return {"kind": info.kind & ~TERMS, "malformed": "truncated terms"}
        terms = terms_of(info.kind, head)
        known = {"kind": info.kind & ~TERMS, "size": info.size - TERMS_SIZE, **terms._asdict()}
    if not info.kind & SEALED:
        return {**known, **_decoded(info.kind & ~TERMS, parted(info.kind, head)[1])}
    if opens is None:
        return known
    open_part, sealed = parted(info.kind, head if info.size == len(head) else whole())
    try:
        clear = opens(info.id, info.kind & ~SEALED, sealed, open_part)
    except (ForgedError, MalformedError) as error:
        return {**known, "malformed": str(error)}
    kind = info.kind & ~(SEALED | TERMS)
    return {**known, "kind": kind, "size": len(clear), **_decoded(kind, clear[:HEAD_BYTES])}


def _lacks_content(info: StoredInfo, head: bytes) -> bool:
    return len(head) < min(info.size, HEAD_BYTES)


def _decoded(kind: int, head: bytes) -> dict[str, Any]:
    try:
        if kind == Kind.MEASUREMENT:
            return {"measurement": decode_measurement(head)}
        if kind == Kind.BYTES:
            return {"text": _text_of(head)}
        if kind == Kind.STATUS:
            return {"status": decode_status(head)}
        if kind == Kind.FILE:
            return {"file": unpack_file(head)[0]}
        if kind == Kind.MANIFEST:
            manifest = decode_manifest(head)
            return {"manifest": manifest, "file": manifest.name, "size": manifest.size}
        if kind in PARTS:
            return {"part": decode_head(head)}
    except MalformedError as error:
        return {"malformed": str(error)}
    return {}


#: Characters that are not printed, and that texts of people have: those that join emoji among them.
_UNSEEN = "\t\r\n\u200c\u200d"


def _text_of(head: bytes) -> str | None:
    """The beginning of a text; None: it is none. A character that the end of `head` cuts off is left out. What would
    turn the text around it is replaced."""
    try:
        text = getincrementaldecoder("utf-8")().decode(head)
    except UnicodeDecodeError:
        return None
    if not text or any(category(one) == "Cc" and one not in "\t\r\n" for one in text):
        return None
    return "".join(one if one.isprintable() or one in _UNSEEN else "\ufffd" for one in text)


# -- sealed data -------------------------------------------------------------------------------------------------------


def opener_of(path: str) -> Opens:
    """With the ground's keys in a file. Raises `KeysError`."""
    check_package()
    from rass_mav.trust.keys.files import read_ground  # with PyNaCl, which is needed for nothing else here
    from rass_mav.trust.keys.sealing import Opener

    return Opener(read_ground(path)).open


def opener_of_node(config: RunConfig) -> Opens | None:
    """With the keys of a node; None: it has none, or it is a drone, which can open nothing. Raises `KeysError`."""
    return None if config.keys is None or not config.is_base else opener_of(config.keys.file)

"""What drones have put: each named file, and each datum of plain bytes, as a file; and a list of them."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

from rass_mav.app.payloads import unpack_file
from rass_mav.core.datum import Kind
from rass_mav.errors import DatumError, StoreError, UnpackedSizeError
from rass_mav.ground.assembly import File, Groups
from rass_mav.ground.entry import Data, Entry

from . import Exported, Format, csv

#: The longest name of a file, bytes in UTF-8.
MOST_BYTES = 200
#: The longest ending that is kept when a name is shortened, bytes in UTF-8.
_MOST_ENDING = 16
# What some systems do not take, and a semicolon: a spreadsheet may cut the index there.
_RESERVED = frozenset('<>:"/\\|?*;')
#: The latest date that all file systems take, seconds since 1970.
_LATEST_S = 4_294_967_295.0


def write(entries: Iterable[Entry], out: Path, source: Data) -> Exported:
    """Files into the folder `out`, dated as they were created, with `index.csv`, which has a line for each: the columns
    of CSV, with the name in the folder. Their bytes are read one datum at a time; what is corrupt or not whole is left
    out."""
    out.mkdir()
    left_out = Counter[str]()
    groups = Groups.of(source)

    def written() -> Iterator[Entry]:
        for entry in entries:
            if entry.kind not in (Kind.FILE, Kind.BYTES, Kind.MANIFEST):
                left_out["no file"] += 1
                continue
            try:
                name = _write_file(entry, out, source, groups)
            except UnpackedSizeError:
                left_out["much larger than its parts: get --any-size"] += 1
                continue
            if name is None:
                left_out["incomplete or corrupt"] += 1
            else:
                yield entry._replace(file=name)

    count = csv.write(written(), out / "index.csv", source).data
    # The folder, because the list of its files would grow with the data.
    return Exported(count, left_out, [out])


def _write_file(entry: Entry, out: Path, source: Data, groups: Groups) -> str | None:
    """Write one datum or file; returns the name of its file, or None if it cannot be read whole. Raises
    `UnpackedSizeError`."""
    if entry.malformed:
        return None
    try:
        pieces = _pieces(entry, source, groups)
    except UnpackedSizeError:
        raise
    except (DatumError, StoreError):
        return None
    name = safe_name(entry.name, entry.file or "")
    # Not a Path for each: it would keep the name in Python's table of strings for a while.
    path = os.path.join(out, name)
    with open(path, "wb") as file:
        file.writelines(pieces)
    taken = None if entry.manifest is None else entry.manifest.time
    created = min(max(entry.utc if taken is None else taken, 0.0), _LATEST_S)
    os.utime(path, (created, created))
    return name


def _pieces(entry: Entry, source: Data, groups: Groups) -> Iterable[bytes]:
    """Its contents. Raises `DatumError`, `StoreError`."""
    if entry.manifest is not None:
        found = File(groups.parts_of(entry), entry, source.payload)
        found.check()
        return found.pieces()
    content = source.payload(entry.name)
    return [unpack_file(content)[1] if entry.kind == Kind.FILE else content]


def safe_name(id: str, name: str) -> str:
    """A name for a datum's file, on any system, that leads out of no folder. `name`: as its drone gave it; empty: none.

    The id comes first, so that no two are the same, and none is a device of Windows. At most `MOST_BYTES`.
    """
    kept = "".join("_" if c in _RESERVED or not c.isprintable() else c for c in name).strip(". ")
    if not kept:
        return f"{id}.bin"
    root, ending = os.path.splitext(kept)
    if len(ending.encode()) > _MOST_ENDING:
        root, ending = kept, ""
    room = MOST_BYTES - len(f"{id}-{ending}".encode())
    return f"{id}-{root.encode()[:room].decode(errors='ignore')}{ending}".rstrip(". ")


FORMAT = Format("", "named files and bytes", write)

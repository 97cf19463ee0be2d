"""Files in parts, as drones create them."""

from __future__ import annotations

import random
from collections.abc import Iterable
from hashlib import sha256
from pathlib import Path

import pytest

from rass_mav.app.packing import packer
from rass_mav.app.redundancy import shares_of
from rass_mav.cli import main
from rass_mav.core.datum import Datum, Kind
from rass_mav.wire.file import PLAIN, Cut, Manifest, Part, cut_file, encode_manifest, encode_part

from .mission_stores import put, stored

PHOTO = random.Random(3).randbytes(100_000)
HERE = (47.3769, 8.5417, 412.5)


def cut_of(
    content: bytes, *, packing: int = PLAIN, most: int = 1 << 14, redundancy: tuple[int, int] | None = None
) -> Cut:
    """How a drone cuts a file into parts of at most `most` bytes."""
    return cut_file(len(content), len(_packed(content, packing)), sha256(content).digest(), packing, most, redundancy)


def _packed(content: bytes, packing: int) -> bytes:
    one = packer(packing)
    return one.compress(content) + one.flush()


def manifest_of(cut: Cut, name: str, content: bytes, sequence: int = 0, *, drone: int = 7) -> Datum:
    """The manifest of a file."""
    manifest = Manifest(cut, name, len(content), sha256(content).digest(), 1_795_341_600.0, HERE)
    return put(sequence, Kind.MANIFEST, encode_manifest(manifest), drone=drone)


def part(cut: Cut, index: int, content: bytes, sequence: int, *, drone: int = 7) -> Datum:
    """A part, or a share."""
    return put(sequence, Kind.SHARE if cut.needed else Kind.PART, encode_part(Part(cut, index, content)), drone=drone)


def data_of(
    name: str, content: bytes, first: int = 0, *, packing: int = PLAIN, drone: int = 7, most: int = 1 << 14,
    redundancy: tuple[int, int] | None = None,
) -> list[Datum]:  # fmt: skip
    """The manifest and the parts of a file."""
    cut = cut_of(content, packing=packing, most=most, redundancy=redundancy)
    whole = b"".join(shares_of(iter([_packed(content, packing)]), cut))
    return [
        manifest_of(cut, name, content, first, drone=drone),
        *(
            part(cut, index, whole[cut.offset(index) :][: cut.size(index)], first + 1 + index, drone=drone)
            for index in cut.indexes()
        ),
    ]


def store(*data: Iterable[Datum], apart: Iterable[Datum] = ()) -> str:
    """The store of a base in this directory, with data in the order of arrival. `apart`: second contents of ids."""
    return str(stored(Path("rass-1.db"), [datum for each in data for datum in each], apart=apart))


def got(capture: pytest.CaptureFixture[bytes], *options: str) -> tuple[int, bytes, str]:
    """What `get` returns, gives and says of that store."""
    code = main(["get", "-c", "rass-1.db", *options])
    said = capture.readouterr()
    return code, said.out, said.err.decode()

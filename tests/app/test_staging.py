"""Reading a file that is put, and packing it: nothing is put of one that changes, and packing must pay."""

from __future__ import annotations

import os
import random
import sys
import zlib
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.app import packing
from rass_mav.app.packing import PIECE, best, packer, unpacked
from rass_mav.app.staging import Staging, in_pieces
from rass_mav.errors import ConfigError, DatumError, MalformedError, RassError
from rass_mav.wire.file import PLAIN, ZLIB, ZSTD

PACKINGS = [PLAIN, ZLIB, pytest.param(ZSTD, marks=pytest.mark.skipif(best() != ZSTD, reason="no zstd here"))]


def test_a_file_that_changes_while_it_is_read_is_not_put(tmp_path: Path) -> None:
    path = tmp_path / "growing.log"
    path.write_bytes(bytes(200_000))
    with Staging(path) as staging:
        about = staging.look()
        pieces = staging.packed(about)
        next(pieces)
        with path.open("ab") as file:
            file.write(b"one more line")
        with pytest.raises(DatumError, match="changed while being read; nothing was submitted"):
            list(pieces)


def test_a_file_that_keeps_its_size_and_date_is_not_put_either(tmp_path: Path) -> None:
    path = tmp_path / "map.bin"
    path.write_bytes(bytes(200_000))
    date = path.stat().st_mtime_ns
    with Staging(path) as staging:
        about = staging.look(pack=False)
        path.write_bytes(bytes(199_999) + b"x")
        os.utime(path, ns=(date, date))
        with pytest.raises(DatumError, match="changed"):
            list(staging.packed(about))


def test_a_file_that_is_replaced_is_read_to_its_end(tmp_path: Path) -> None:
    path, fresh = tmp_path / "photo.jpg", tmp_path / "new"
    path.write_bytes(b"old" * 50_000)
    fresh.write_bytes(b"new" * 50_000)
    with Staging(path) as staging:
        about = staging.look(pack=False)
        fresh.replace(path)
        assert b"".join(staging.packed(about)) == b"old" * 50_000


def test_what_is_no_plain_file_is_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to(tmp_path / "pipe")
    for name, why in (("pipe", "not a regular file"), (".", "not a regular file"), ("none", "no such file")):
        with pytest.raises(ConfigError, match=why):
            Staging(tmp_path / name)
    with pytest.raises(ConfigError, match="link"):
        Staging(tmp_path / "link", follow=False)


def test_only_what_gets_smaller_is_packed(tmp_path: Path) -> None:
    noise = random.Random(1).randbytes(300_000)
    for content, packed in (
        (b"a line of a log\n" * 20_000, True),
        (noise, False),
        # The beginning promises more than the rest keeps.
        (bytes(1 << 18) + random.Random(2).randbytes(4_000_000), False),
    ):
        (tmp_path / "f").write_bytes(content)
        with Staging(tmp_path / "f") as staging:
            about = staging.look()
            assert (about.packing != PLAIN) is packed
            assert about.length <= (0.9 if packed else 1.0) * len(content)
            pieces = list(staging.packed(about))
        assert sum(map(len, pieces)) == about.length
        assert b"".join(unpacked(pieces, about.packing, about.size)) == content


@pytest.mark.parametrize("kind", PACKINGS)
@given(data=st.data())
def test_what_is_packed_is_unpacked_in_bounded_pieces(kind: int, data: st.DataObject) -> None:
    content = data.draw(st.binary(max_size=500)) * data.draw(st.integers(1, 2000))
    one = packer(kind)
    whole = b"".join([one.compress(content), one.flush()])
    cut = data.draw(st.integers(1, max(1, len(whole))))
    pieces = [whole[at : at + cut] for at in range(0, len(whole), cut)] if len(whole) < 5000 * cut else [whole]
    found = list(unpacked(pieces, kind, len(content)))
    assert b"".join(found) == content
    assert all(len(piece) <= max(PIECE, cut) for piece in found)


@pytest.mark.parametrize("kind", PACKINGS[1:])
def test_what_is_not_packed_so_is_malformed(kind: int) -> None:
    one = packer(kind)
    whole = b"".join([one.compress(bytes(100_000)), one.flush()])
    for bad in (b"noise", whole[:-1], b"", b"\0" + whole):
        with pytest.raises(MalformedError):
            list(unpacked([bad], kind, 100_000))


@pytest.mark.parametrize("kind", PACKINGS[1:])
def test_a_bomb_costs_no_more_than_the_file_it_claims_to_be(kind: int) -> None:
    one = packer(kind)
    bomb = b"".join([one.compress(bytes(1 << 20)) for _ in range(64)] + [one.flush()])
    with pytest.raises(MalformedError, match="larger than the stated 100000 bytes"):
        list(unpacked([bomb], kind, 100_000))
    assert len(next(unpacked([bomb], kind, 100_000))) <= PIECE


def test_without_zstd_zlib_packs_and_unpacking_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("compression.zstd", "backports.zstd"):
        monkeypatch.setitem(sys.modules, name, None)
    assert packing.best() == ZLIB
    with pytest.raises(RassError, match=r"packed with zstd.*'\.\[zstd\]'"):
        list(unpacked([b"x"], ZSTD, 10))


def test_pieces_are_cut_small() -> None:
    def large() -> Iterator[bytes]:
        yield zlib.compress(random.Random(2).randbytes(300_000))

    assert max(map(len, in_pieces(large(), 1000))) == 1000

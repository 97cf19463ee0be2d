"""The operator's own map."""

from __future__ import annotations

import gzip
import json
import sqlite3
import struct
import tracemalloc
from itertools import pairwise, product
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from rass_mav.errors import ConfigError, MalformedError
from rass_mav.ground.page.pmtiles import tile_number, varints
from rass_mav.ground.page.tiles import MOST_BYTES, NOTHING, Tiles, kind_of

JPEG = b"\xff\xd8\xff\xe0 a picture"


def mbtiles(path: Path, tiles: dict[tuple[int, int, int], bytes], **metadata: str) -> Path:
    """A file with these tiles: (zoom, column, row from the south) -> image."""
    with sqlite3.connect(path) as connection:
        connection.execute("CREATE TABLE metadata (name text, value text)")
        connection.execute("CREATE TABLE tiles (zoom_level int, tile_column int, tile_row int, tile_data blob)")
        connection.executemany("INSERT INTO metadata VALUES (?, ?)", metadata.items())
        connection.executemany("INSERT INTO tiles VALUES (?, ?, ?, ?)", [(*key, image) for key, image in tiles.items()])
    connection.close()
    return path


def test_rows_are_counted_from_the_north(tmp_path: Path) -> None:
    images = {(0, 0, 0): NOTHING, (2, 1, 3): JPEG}
    tiles = Tiles(mbtiles(tmp_path / "map.mbtiles", images, bounds="8.4,47.3,8.6,47.5", attribution="<b>crew</b>"))
    assert tiles.get(2, 1, 0) == (JPEG, "image/jpeg")
    assert tiles.get(0, 0, 0) == (NOTHING, "image/png")
    for outside in ((2, 1, 3), (2, 4, 0), (-1, 0, 0), (30, 0, 0), (2, 1, -1)):
        assert tiles.get(*outside) is None
    assert tiles.plain() == {
        "least_zoom": 0, "most_zoom": 2, "attribution": "<b>crew</b>", "bounds": [8.4, 47.3, 8.6, 47.5]
    }  # fmt: skip
    tiles.close()


def test_bounds_that_are_none_are_left_out(tmp_path: Path) -> None:
    for number, bounds in enumerate(("1,2,3", "a,b,c,d", "nan,0,1,1", "8,47,7,48", "-inf,0,1,1", "0,0,1,91", "")):
        tiles = Tiles(mbtiles(tmp_path / f"{number}.mbtiles", {(0, 0, 0): JPEG}, bounds=bounds))
        assert tiles.plain()["bounds"] is None
        tiles.close()


def test_what_is_no_file_of_images(tmp_path: Path) -> None:
    (tmp_path / "text").write_text("not a database, though long enough to be looked at as one" * 20)
    (tmp_path / "nothing").touch()
    (tmp_path / "damaged").write_bytes(b"SQLite format 3\0 and then nothing of the kind")
    sqlite3.connect(mbtiles(tmp_path / "words", {})).executescript(
        "INSERT INTO tiles VALUES ('all', 0, 0, 'no zoom')"
    ).connection.close()
    mbtiles(tmp_path / "vector", {(0, 0, 0): b"\x1f\x8b\x08 a vector tile"})
    mbtiles(tmp_path / "empty", {})
    mbtiles(tmp_path / "huge", {(0, 0, 0): JPEG + bytes(MOST_BYTES)})
    for name, why in {
        "missing": "no such file",
        ".": "is a directory",
        "text": "expected MBTiles or PMTiles",
        "nothing": "expected MBTiles or PMTiles",
        "damaged": "not a file of tiles",
        "words": "contains no tiles",
        "vector": "expected images .* QGIS",
        "empty": "contains no tiles",
        "huge": "expected images",
    }.items():
        with pytest.raises(ConfigError, match=why):
            Tiles(tmp_path / name)
    assert kind_of("text") is None
    assert kind_of(b"<svg onload='alert(1)'>") is None


def test_an_image_that_is_too_large_and_a_text_that_is_too_long_are_left_out(tmp_path: Path) -> None:
    images = {(0, 0, 0): JPEG, (1, 0, 0): JPEG + bytes(MOST_BYTES)}
    tiles = Tiles(mbtiles(tmp_path / "map", images, attribution="x" * 1_000_000))
    assert tiles.get(1, 0, 1) is None
    assert len(tiles.plain()["attribution"]) == 2000
    tiles.close()


class TestPMTiles:
    def test_the_tiles_of_a_file_from_the_authors_own_program(self) -> None:
        """It was made with their package `pmtiles` 3.8.1, in two levels: zooms 0 to 3, without the tile in the
        south-east of zoom 3, and with one image for all eight in its north-east."""
        tiles = Tiles(Path(__file__).with_name("golden.pmtiles"))
        for zoom in range(4):
            for x, y in product(range(1 << zoom), repeat=2):
                said = b"sea" if zoom == 3 and x >= 6 and y < 4 else f"{zoom}/{x}/{y}".encode()
                expected = None if (zoom, x, y) == (3, 7, 7) else (b"\x89PNG\r\n\x1a\n" + said, "image/png")
                assert tiles.get(zoom, x, y) == expected
        assert tiles.get(4, 0, 0) is None
        assert tiles.plain() == {
            "least_zoom": 0, "most_zoom": 3, "attribution": "<b>crew</b>", "bounds": [8.4, 47.3, 8.6, 47.5]
        }  # fmt: skip
        tiles.close()

    def test_plain_directories(self, tmp_path: Path) -> None:
        tiles = Tiles(pmtiles(tmp_path / "map", [(0, 1, len(JPEG), 0), (2, 3, len(JPEG), 0)], JPEG))
        assert tiles.get(0, 0, 0) == (JPEG, "image/jpeg")
        assert [tiles.get(1, x, y) is None for x, y in ((0, 0), (0, 1), (1, 1), (1, 0))] == [True, False, False, False]
        tiles.close()

    def test_a_directory_that_leads_to_itself_ends(self, tmp_path: Path) -> None:
        root = directory([(0, 1, len(JPEG), 0), (1, 0, 0, 0)])
        leaf = (1, 0, len(root), 0)
        tiles = Tiles(pmtiles(tmp_path / "map", [(0, 1, len(JPEG), 0), leaf], JPEG, leaves_at=127))
        assert tiles.get(5, 1, 1) is None
        tiles.close()

    @pytest.mark.parametrize(
        "row",
        [(1, 1, MOST_BYTES + 1, 0), (1, 1, 1 << 40, 0), (1, 1, 9, 1 << 62), (1, 1, 9, (1 << 64) - 2),
         (1, 0, 1 << 40, 0), (1, 0, 9, 1 << 62), (1, 0, 0, 0), (1, 1, 0, 0)],
    )  # fmt: skip
    def test_what_is_too_long_or_outside_of_the_file_is_no_tile(
        self, tmp_path: Path, row: tuple[int, int, int, int]
    ) -> None:
        tiles = Tiles(pmtiles(tmp_path / "map", [(0, 1, len(JPEG), 0), row], JPEG))
        assert tiles.get(0, 0, 0) is not None
        assert tiles.get(1, 0, 0) is None
        tiles.close()

    def test_what_is_no_file_of_images(self, tmp_path: Path) -> None:
        row = [(0, 1, len(JPEG), 0)]
        whole = pmtiles(tmp_path / "whole", row, JPEG, metadata=json.dumps({"attribution": "crew"}).encode())
        (tmp_path / "cut").write_bytes(whole.read_bytes()[:100])
        (tmp_path / "old").write_bytes(b"PMTiles\x02" + whole.read_bytes()[8:])
        pmtiles(tmp_path / "zstd", row, JPEG, compression=4)
        pmtiles(tmp_path / "not gzip", row, JPEG, compression=2)
        pmtiles(tmp_path / "vector", row, b"\x1f\x8b\x08 a vector tile")
        pmtiles(tmp_path / "empty", [], JPEG)
        pmtiles(tmp_path / "image elsewhere", [(0, 1, 5, 1 << 50)], JPEG)
        pmtiles(tmp_path / "deep", row, JPEG, metadata=b"[" * 100_000)
        pmtiles(tmp_path / "words", row, JPEG, metadata=b"crew")
        pmtiles(tmp_path / "long", row, JPEG, metadata=b" " * (1 << 21))
        pmtiles(tmp_path / "many", row, JPEG, root=b"\xff\xff\xff\xff\x0f")
        pmtiles(tmp_path / "large", row, JPEG, root=b"\x01" + b"\xff" * 20)
        pmtiles(tmp_path / "beyond", row, JPEG, root=b"\x02" + 8 * (b"\xff" * 9 + b"\x01"))
        for name, why in {
            "cut": "truncated",
            "old": "version 2, ours is 3: convert it",
            "zstd": "not compressed with gzip",
            "not gzip": "not gzip",
            "vector": "expected images .* QGIS",
            "empty": "contains no tiles",
            "image elsewhere": "expected images",
            "deep": "not JSON",
            "words": "not JSON",
            "long": "too long",
            "many": "a truncated directory",
            "large": "a number that is too large",
            "beyond": "a damaged directory",
        }.items():
            with pytest.raises(ConfigError, match=why) as caught:
                Tiles(tmp_path / name)
            assert str(tmp_path / name) in str(caught.value)

    def test_a_bomb_is_not_unpacked(self, tmp_path: Path) -> None:
        bomb = gzip.compress(bytes(200_000_000))
        pmtiles(tmp_path / "map", [], JPEG, root=bomb, compression=2)
        tracemalloc.start()
        with pytest.raises(ConfigError, match="too long"):
            Tiles(tmp_path / "map")
        assert tracemalloc.get_traced_memory()[1] < 5_000_000
        tracemalloc.stop()

    def test_metadata_without_a_name(self, tmp_path: Path) -> None:
        for number, metadata in enumerate((b"[1]", b"{}", b"")):
            tiles = Tiles(pmtiles(tmp_path / str(number), [(0, 1, len(JPEG), 0)], JPEG, metadata=metadata))
            assert tiles.plain()["attribution"] == ""
            tiles.close()

    @given(st.binary(max_size=200), st.binary(max_size=200))
    @example(b"", b"")
    def test_whatever_is_in_the_file_it_opens_or_it_does_not(
        self, tmp_path_factory: pytest.TempPathFactory, header: bytes, rest: bytes
    ) -> None:
        golden = Path(__file__).with_name("golden.pmtiles").read_bytes()
        path = tmp_path_factory.mktemp("map") / "map"
        for damaged in (b"PMTiles\x03" + header + rest, golden[:127] + rest, golden[: 127 + len(header)] + rest):
            path.write_bytes(damaged)
            try:
                tiles = Tiles(path)
            except ConfigError:
                continue
            json.dumps(tiles.plain(), allow_nan=False)
            for x, y in product(range(4), repeat=2):
                tiles.get(2, x, y)
            tiles.close()

    def test_the_numbers_follow_a_curve(self) -> None:
        assert tile_number(12, 3423, 1763) == 19078479
        number = 0
        for zoom in range(5):
            by_number = {tile_number(zoom, *spot): spot for spot in product(range(1 << zoom), repeat=2)}
            assert sorted(by_number) == list(range(number, number + 4**zoom))
            way = [by_number[at] for at in sorted(by_number)]
            assert all(abs(x - u) + abs(y - v) == 1 for (x, y), (u, v) in pairwise(way))
            number += 4**zoom

    @given(st.lists(st.integers(0, 2**64 - 1)))
    def test_numbers_are_read(self, numbers: list[int]) -> None:
        assert list(varints(b"".join(map(varint, numbers)))) == numbers

    def test_numbers_of_more_than_64_bits_are_not(self) -> None:
        for number in (2**64, 2**70, 2**700):
            with pytest.raises(MalformedError):
                varints(varint(number))


def varint(number: int) -> bytes:
    groups = []
    while number >= 128:
        groups.append(number & 127 | 128)
        number >>= 7
    return bytes([*groups, number])


def directory(rows: list[tuple[int, int, int, int]]) -> bytes:
    """Rows of number, run, length and offset."""
    steps = [row[0] - before for row, before in zip(rows, (0, *(row[0] for row in rows)), strict=False)]
    columns = [steps, *([row[n] for row in rows] for n in (1, 2)), [row[3] + 1 for row in rows]]
    return b"".join(map(varint, (len(rows), *(number for column in columns for number in column))))


def pmtiles(
    path: Path, rows: list[tuple[int, int, int, int]], tiles: bytes, *, metadata: bytes = b"{}", compression: int = 1,
    root: bytes | None = None, leaves_at: int | None = None,
) -> Path:  # fmt: skip
    """A file with this root directory, and at most zoom 5."""
    root = directory(rows) if root is None else root
    at, end = 127 + len(root), 127 + len(root) + len(metadata)
    places = (127, len(root), at, len(metadata), end if leaves_at is None else leaves_at, 0, end, len(tiles), 0, 0, 0)
    header = struct.pack("<7sB11Q6B4i9x", b"PMTiles", 3, *places, 1, compression, 1, 2, 0, 5, 0, 0, 0, 0)
    path.write_bytes(header + root + metadata + tiles)
    return path

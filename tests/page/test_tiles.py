"""The crew's own map."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import pytest

from rass_mav.errors import ConfigError
from rass_mav.page.tiles import NOTHING, Tiles, kind_of

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
    for number, bounds in enumerate(("1,2,3", "a,b,c,d", "nan,0,1,1")):
        tiles = Tiles(mbtiles(tmp_path / f"{number}.mbtiles", {(0, 0, 0): JPEG}, bounds=bounds))
        assert tiles.plain()["bounds"] is None
        tiles.close()


def test_what_is_no_file_of_images(tmp_path: Path) -> None:
    (tmp_path / "text.mbtiles").write_text("not a database, though long enough to be looked at as one" * 20)
    mbtiles(tmp_path / "vector.mbtiles", {(0, 0, 0): b"\x1f\x8b\x08 a vector tile"})
    mbtiles(tmp_path / "empty.mbtiles", {})
    for name, why in {
        "missing.mbtiles": "no such file",
        "map.zip": "expected a file .mbtiles",
        "text.mbtiles": "not a file of tiles",
        "vector.mbtiles": "expected images",
        "empty.mbtiles": "expected images",
    }.items():
        with pytest.raises(ConfigError, match=why):
            Tiles(tmp_path / name)
    assert kind_of("text") is None
    assert kind_of(b"<svg onload='alert(1)'>") is None

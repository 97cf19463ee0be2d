"""Map tiles from the operator's own file: images in MBTiles or PMTiles."""

from __future__ import annotations

import sqlite3
from pathlib import Path
from typing import Any, Protocol

from rass_mav.errors import ConfigError, os_errors_as

from . import pmtiles

#: How MBTiles begin.
_SQLITE = b"SQLite format 3\0"
#: How images begin, and what browsers call them.
_KINDS = ((b"\x89PNG", "image/png"), (b"\xff\xd8\xff", "image/jpeg"), (b"RIFF", "image/webp"))
_MOST_ZOOM = 24
#: Bytes of an image.
MOST_BYTES = 4 << 20
#: Characters of the owner's text, and of other metadata.
_MOST_TEXT = 2000
#: A transparent pixel, for tiles that the file does not have.
NOTHING = bytes.fromhex(
    "89504e470d0a1a0a0000000d49484452000000010000000108060000001f15c4890000000b4944415478da636000020000050001e9fadcd8"
    "0000000049454e44ae426082"
)


class Source(Protocol):
    """A file of tiles, whatever they are."""

    zooms: tuple[int, int]
    """The least and the most; not trustworthy."""
    attribution: str
    """Whose they are."""
    bounds: list[float]
    """West, south, east, north, degrees; not trustworthy."""

    def sample(self, most: int) -> object:
        """Some tile. None: there is none of at most `most` bytes."""

    def get(self, zoom: int, x: int, y: int, most: int) -> object:
        """The tile with the usual numbers (rows counted from the north). None: there is none of at most `most`
        bytes."""

    def close(self) -> None:
        """Release the file."""


class MBTiles:
    """A file of tiles as MBTiles (https://github.com/mapbox/mbtiles-spec): an SQLite database. Any thread may use it,
    one at a time."""

    def __init__(self, path: Path) -> None:
        """Raises `ConfigError`: it is damaged, or has no tiles."""
        try:
            # Nobody changes the file meanwhile.
            self._connection = sqlite3.connect(
                f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True, check_same_thread=False
            )
            rows = self._connection.execute(
                "SELECT name, substr(value, 1, ?) FROM metadata WHERE name IN ('attribution', 'bounds')", (_MOST_TEXT,)
            )
            named = {str(name): str(value) for name, value in rows.fetchmany(2)}
            zooms = self._connection.execute(
                "SELECT (SELECT min(zoom_level) FROM tiles), (SELECT max(zoom_level) FROM tiles)"
            ).fetchone()
        except sqlite3.Error as error:
            raise ConfigError(f"{path}: not a file of tiles ({error})") from None
        if not all(isinstance(zoom, int) for zoom in zooms):
            raise ConfigError(f"{path}: it contains no tiles")
        self.zooms: tuple[int, int] = zooms
        self.attribution = named.get("attribution", "")
        self.bounds = _numbers(named.get("bounds", ""))

    def sample(self, most: int) -> object:
        """Some tile."""
        return self._one(
            "SELECT tile_data FROM (SELECT tile_data FROM tiles LIMIT 1) WHERE length(tile_data) <= ?", most
        )

    def get(self, zoom: int, x: int, y: int, most: int) -> object:
        """The tile with the usual numbers."""
        # MBTiles counts rows from the south.
        return self._one(
            "SELECT tile_data FROM tiles WHERE zoom_level = ? AND tile_column = ? AND tile_row = ? "
            "AND length(tile_data) <= ?",
            zoom, x, (1 << zoom) - 1 - y, most,
        )  # fmt: skip

    def _one(self, query: str, *values: int) -> object:
        try:
            row = self._connection.execute(query, values).fetchone()
        except sqlite3.Error:
            return None
        return None if row is None else row[0]

    def close(self) -> None:
        """Release the file."""
        self._connection.close()


class Tiles:
    """The images of a file."""

    def __init__(self, path: Path) -> None:
        """Raises `ConfigError`: there is no such file, or it has no images."""
        self._source = _source(path)
        if kind_of(self._source.sample(MOST_BYTES)) is None:
            self._source.close()
            raise ConfigError(
                f"{path}: expected images (PNG, JPEG or WebP), not vector tiles: draw them, for example in QGIS with "
                "Generate XYZ tiles (MBTiles)"
            )

    def plain(self) -> dict[str, Any]:
        """For the page: zooms, bounds (west, south, east, north, or null), and whose they are."""
        least, most = (min(max(zoom, 0), _MOST_ZOOM) for zoom in self._source.zooms)
        return {
            "least_zoom": least,
            "most_zoom": max(least, most),
            "attribution": self._source.attribution[:_MOST_TEXT],
            "bounds": self._source.bounds if _is_box(self._source.bounds) else None,
        }

    def get(self, zoom: int, x: int, y: int) -> tuple[bytes, str] | None:
        """The image with the usual numbers (rows counted from the north), and its type; None: there is none."""
        if not (0 <= zoom <= _MOST_ZOOM and 0 <= x < 1 << zoom and 0 <= y < 1 << zoom):
            return None
        image = self._source.get(zoom, x, y, MOST_BYTES)
        kind = kind_of(image)
        return (image, kind) if isinstance(image, bytes) and kind is not None else None

    def close(self) -> None:
        """Release the file."""
        self._source.close()


def _source(path: Path) -> Source:
    """What the file is, by its first bytes. Raises `ConfigError`."""
    with os_errors_as(ConfigError, path), path.open("rb") as file:
        head = file.read(len(_SQLITE))
    if head == _SQLITE:
        return MBTiles(path)
    if head.startswith(pmtiles.MAGIC):
        return pmtiles.PMTiles(path)
    raise ConfigError(f"{path}: expected MBTiles or PMTiles with images")


def kind_of(image: object) -> str | None:
    """The type of an image by its first bytes; None: it is none that is served."""
    if not isinstance(image, bytes):
        return None
    return next((kind for start, kind in _KINDS if image.startswith(start)), None)


def _numbers(text: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        return []


def _is_box(bounds: list[float]) -> bool:
    if len(bounds) != 4:
        return False
    west, south, east, north = bounds
    return -180.0 <= west < east <= 180.0 and -90.0 <= south < north <= 90.0

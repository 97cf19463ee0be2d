"""Map tiles from the crew's own file: MBTiles, an SQLite database of images."""

from __future__ import annotations

import math
import sqlite3
from pathlib import Path
from typing import Any

from rass_mav.errors import ConfigError

#: How images begin, and what browsers call them.
_KINDS = ((b"\x89PNG", "image/png"), (b"\xff\xd8\xff", "image/jpeg"), (b"RIFF", "image/webp"))
_MOST_ZOOM = 24
#: A transparent pixel, for tiles that the file does not have.
NOTHING = bytes.fromhex(
    "89504e470d0a1a0a0000000d49484452000000010000000108060000001f15c4890000000b4944415478da636000020000050001e9fadcd8"
    "0000000049454e44ae426082"
)


class Tiles:
    """The tiles of a file."""

    def __init__(self, path: Path) -> None:
        """Raises `ConfigError`: there is no such file, or it has no images."""
        if path.suffix != ".mbtiles":
            raise ConfigError(f"--tiles: expected a file .mbtiles with images, got {path}")
        if not path.is_file():
            raise ConfigError(f"--tiles: {path}: no such file")
        try:
            # Any thread may use it, one at a time. Nobody changes the file meanwhile.
            self._connection = sqlite3.connect(
                f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True, check_same_thread=False
            )
            named = dict(self._connection.execute("SELECT name, value FROM metadata").fetchall())
            zooms = self._connection.execute("SELECT min(zoom_level), max(zoom_level) FROM tiles").fetchone()
            sample = self._connection.execute("SELECT tile_data FROM tiles LIMIT 1").fetchone()
        except sqlite3.Error as error:
            raise ConfigError(f"--tiles: {path}: not a file of tiles ({error})") from None
        if sample is None or kind_of(sample[0]) is None:
            raise ConfigError(f"--tiles: {path}: expected images (PNG, JPEG or WebP), not vector tiles")
        self._about = {
            "least_zoom": int(zooms[0]),
            "most_zoom": int(zooms[1]),
            "attribution": str(named.get("attribution", "")),
            "bounds": _bounds(named.get("bounds")),
        }

    def plain(self) -> dict[str, Any]:
        """For the page: zooms, bounds (west, south, east, north, or null), and whose they are."""
        return self._about

    def get(self, zoom: int, x: int, y: int) -> tuple[bytes, str] | None:
        """The image with the usual numbers (rows counted from the north), and its type; None: there is none."""
        if not (0 <= zoom <= _MOST_ZOOM and 0 <= x < 1 << zoom and 0 <= y < 1 << zoom):
            return None
        # MBTiles counts rows from the south.
        try:
            row = self._connection.execute(
                "SELECT tile_data FROM tiles WHERE zoom_level = ? AND tile_column = ? AND tile_row = ?",
                (zoom, x, (1 << zoom) - 1 - y),
            ).fetchone()
        except sqlite3.Error:
            return None
        kind = None if row is None else kind_of(row[0])
        return None if kind is None else (bytes(row[0]), kind)

    def close(self) -> None:
        """Release the file."""
        self._connection.close()


def kind_of(image: object) -> str | None:
    """The type of an image by its first bytes; None: it is none that is served."""
    if not isinstance(image, bytes):
        return None
    return next((kind for start, kind in _KINDS if image.startswith(start)), None)


def _bounds(text: object) -> list[float] | None:
    try:
        west, south, east, north = (float(part) for part in str(text).split(","))
    except ValueError:
        return None
    bounds = [west, south, east, north]
    return bounds if all(map(math.isfinite, bounds)) else None

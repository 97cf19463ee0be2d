"""A file of map tiles as MBTiles (https://github.com/mapbox/mbtiles-spec): an SQLite database."""

from __future__ import annotations

import sqlite3
from pathlib import Path

from rass_mav.errors import ConfigError

#: How such a file begins.
MAGIC = b"SQLite format 3\0"
# Characters of a value in the table of metadata that are read.
_MOST_TEXT = 2000


class MBTiles:
    """The tiles of a file. Any thread may use it, one at a time."""

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
            raise ConfigError(f"{path}: there are no tiles in it")
        self.zooms: tuple[int, int] = zooms
        self.attribution = named.get("attribution", "")
        self.bounds = _numbers(named.get("bounds", ""))

    def sample(self, most: int) -> object:
        """Some tile. None: it has more than `most` bytes."""
        return self._one(
            "SELECT tile_data FROM (SELECT tile_data FROM tiles LIMIT 1) WHERE length(tile_data) <= ?", most
        )

    def get(self, zoom: int, x: int, y: int, most: int) -> object:
        """The tile with the usual numbers (rows counted from the north). None: there is none, or it has more than
        `most` bytes."""
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


def _numbers(text: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        return []

"""GeoPackage 1.3 (OGC): all data in one file for QGIS and other geographic programs, which draws them coloured."""

from __future__ import annotations

import sqlite3
import struct
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from html import escape
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

from rass_mav.ground.entry import Data, Entry
from rass_mav.store.errors import explained
from rass_mav.wire.measurement import UNIT_NAMES

from . import Exported, Format
from .csv import COLUMNS
from .csv import row as columns_of
from .geojson import point_of
from .kml import COLOURS

#: Rows that are in memory at a time.
_BATCH = 100
_APPLICATION_ID, _VERSION = 0x47504B47, 10300
_WGS84 = (
    'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563,AUTHORITY["EPSG","7030"]],'
    'AUTHORITY["EPSG","6326"]],PRIMEM["Greenwich",0,AUTHORITY["EPSG","8901"]],'
    'UNIT["degree",0.0174532925199433,AUTHORITY["EPSG","9122"]],AUTHORITY["EPSG","4326"]]'
)
_SYSTEMS = (
    ("Undefined Cartesian SRS", -1, "NONE", -1, "undefined", "undefined Cartesian coordinate reference system"),
    ("Undefined geographic SRS", 0, "NONE", 0, "undefined", "undefined geographic coordinate reference system"),
    ("WGS 84 geodetic", 4326, "EPSG", 4326, _WGS84, "longitude and latitude in degrees on WGS 84"),
)
# Columns that are neither a date nor a number with a fraction.
_TYPES = {
    "id": "TEXT", "drone": "INTEGER", "kind": "TEXT", "at_least_so_old": "BOOLEAN", "unit": "TEXT", "hops": "INTEGER",
    "bytes": "INTEGER", "file": "TEXT",
}  # fmt: skip
_COLUMNS = ", ".join(
    f"{name} {_TYPES.get(name, 'DATETIME' if name.endswith('_utc') else 'DOUBLE')}" for name in COLUMNS
)
_TABLES = (
    "CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT NOT NULL, srs_id INTEGER PRIMARY KEY, organization TEXT NOT NULL,"
    " organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL, description TEXT)",
    "CREATE TABLE gpkg_contents (table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL, identifier TEXT UNIQUE,"
    " description TEXT DEFAULT '', last_change DATETIME NOT NULL DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')),"
    " min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER,"
    " CONSTRAINT fk_gc_r_srs_id FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id))",
    "CREATE TABLE gpkg_geometry_columns (table_name TEXT NOT NULL, column_name TEXT NOT NULL,"
    " geometry_type_name TEXT NOT NULL, srs_id INTEGER NOT NULL, z TINYINT NOT NULL, m TINYINT NOT NULL,"
    " CONSTRAINT pk_geom_cols PRIMARY KEY (table_name, column_name), CONSTRAINT uk_gc_table_name UNIQUE (table_name),"
    " CONSTRAINT fk_gc_tn FOREIGN KEY (table_name) REFERENCES gpkg_contents(table_name),"
    " CONSTRAINT fk_gc_srs FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys (srs_id))",
    f"CREATE TABLE measurements (fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, geom POINT, {_COLUMNS})",
    f"CREATE TABLE data (fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, {_COLUMNS})",
    # As QGIS creates it when it stores a style.
    "CREATE TABLE layer_styles (id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, f_table_catalog TEXT(256),"
    " f_table_schema TEXT(256), f_table_name TEXT(256), f_geometry_column TEXT(256), styleName TEXT(30),"
    " styleQML TEXT, styleSLD TEXT, useAsDefault BOOLEAN, description TEXT, owner TEXT(30), ui TEXT(30),"
    " update_time DATETIME DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')))",
)
_INSERT = "INSERT INTO {} VALUES (NULL, {})"
_INSERT_POINT = _INSERT.format("measurements", ", ".join("?" * (1 + len(COLUMNS))))
_INSERT_OTHER = _INSERT.format("data", ", ".join("?" * len(COLUMNS)))
_INSERT_CONTENT = (
    "INSERT INTO gpkg_contents (table_name, data_type, identifier, min_x, min_y, max_x, max_y, srs_id)"
    " VALUES (?, ?, ?, ?, ?, ?, ?, ?)"
)
_BOX = "SELECT min(longitude), min(latitude), max(longitude), max(latitude) FROM measurements"
#: A GeoPackageBinary, little endian, without an envelope, in EPSG 4326; then a WKB of type PointZ.
_POINT = struct.Struct("<2sBBiBI3d")

#: The shares of the readings where one colour ends and the next begins: most are background, few are of interest.
_SHARES = (0.0, 0.5, 0.75, 0.9, 0.98, 1.0)
_GREY = (160, 160, 160)
_NO_READING = -1.0


def write(entries: Iterable[Entry], out: Path, source: Data) -> Exported:
    """A layer `measurements` of points with the columns of CSV, a table `data` with those that have no position, and a
    style for QGIS."""
    with explained(Path(out.name), "writing the GeoPackage"), closing(sqlite3.connect(out, isolation_level=None)) as db:
        # Whoever calls removes the file if it does not become complete, so nothing has to be rolled back.
        db.execute("PRAGMA journal_mode = OFF")
        db.execute("PRAGMA synchronous = OFF")
        db.execute(f"PRAGMA application_id = {_APPLICATION_ID}")
        db.execute(f"PRAGMA user_version = {_VERSION}")
        db.execute("BEGIN")
        for statement in _TABLES:
            db.execute(statement)
        db.executemany("INSERT INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, ?)", _SYSTEMS)
        count = sum(_write_batch(db, batch) for batch in _batches(iter(entries)))
        (box,) = db.execute(_BOX)
        db.execute(_INSERT_CONTENT, ("measurements", "features", "measurements", *box, 4326))
        for table in ("data", "layer_styles"):
            db.execute(_INSERT_CONTENT, (table, "attributes", table, None, None, None, None, 0))
        db.execute("INSERT INTO gpkg_geometry_columns VALUES ('measurements', 'geom', 'POINT', 4326, 1, 0)")
        _write_style(db)
        db.execute("COMMIT")
    return Exported(count, Counter(), [out])


def _batches(entries: Iterator[Entry]) -> Iterator[list[Entry]]:
    while batch := list(islice(entries, _BATCH)):
        yield batch


def _write_batch(db: sqlite3.Connection, batch: list[Entry]) -> int:
    points: list[list[object]] = []
    others: list[list[object]] = []
    for entry in batch:
        row = columns_of(entry)
        point = point_of(entry)
        if point is None:
            others.append(row)
        else:
            points.append([_POINT.pack(b"GP", 0, 1, 4326, 1, 1001, *point), *row])
    db.executemany(_INSERT_POINT, points)
    db.executemany(_INSERT_OTHER, others)
    return len(batch)


def _write_style(db: sqlite3.Connection) -> None:
    units = db.execute("SELECT DISTINCT unit FROM measurements WHERE reading IS NOT NULL LIMIT 2").fetchall()
    if len(units) == 1:
        ((unit,),) = units
        style = _by_reading(_bounds(db), UNIT_NAMES.get(unit, ""))
    else:
        style = _by_risk()
    db.execute(
        "INSERT INTO layer_styles (f_table_catalog, f_table_schema, f_table_name, f_geometry_column, styleName,"
        " styleQML, styleSLD, useAsDefault, description, owner) VALUES ('', '', 'measurements', 'geom', ?, ?, '', 1,"
        " '', '')",
        ("dose" if len(units) == 1 else "risk", style),
    )


def _bounds(db: sqlite3.Connection) -> list[float]:
    """The readings between the classes: with shares, one wild reading does not take all other colours away."""
    count: int = db.execute("SELECT count(reading) FROM measurements").fetchall()[0][0]
    places = [round(share * (count - 1)) for share in _SHARES]
    query = "SELECT reading FROM measurements WHERE reading IS NOT NULL ORDER BY reading LIMIT 1 OFFSET ?"
    return [db.execute(query, (place,)).fetchall()[0][0] for place in places]


def _by_reading(bounds: Sequence[float], unit: str) -> str:
    """Readings of one unit."""
    classes: list[tuple[float, float, str]] = [(_NO_READING, _NO_READING, "no reading")]
    classes += [(low, high, f"{low:.3g} to {high:.3g} {unit}".rstrip()) for low, high in pairwise(bounds)]
    # What has no value is not drawn at all.
    return _qml(f'coalesce("reading", {_NO_READING:g})', classes, (_GREY, *COLOURS))


def _by_risk() -> str:
    """Readings of several units cannot be compared, but their risks can."""
    steps = len(COLOURS)
    classes = [(n / steps, (n + 1) / steps, f"risk {n / steps:g} to {(n + 1) / steps:g}") for n in range(steps)]
    return _qml("risk", classes, COLOURS)


def _qml(value: str, classes: Sequence[tuple[float, float, str]], colours: Sequence[tuple[int, int, int]]) -> str:
    """A style of QGIS: classes of a value, each with its lower and upper bound and its name in the legend."""
    ranges = "".join(
        f'<range lower="{low!r}" upper="{high!r}" symbol="{n}" label="{escape(label)}" render="true"/>'
        for n, (low, high, label) in enumerate(classes)
    )
    symbols = "".join(
        f'<symbol type="marker" name="{n}" alpha="1" clip_to_extent="1" force_rhr="0">'
        f'<layer class="SimpleMarker" enabled="1" locked="0" pass="0"><Option type="Map">{_options(colour)}</Option>'
        "</layer></symbol>"
        for n, colour in enumerate(colours)
    )
    return (
        "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n"
        '<qgis version="3.28.0" styleCategories="Symbology">'
        f'<renderer-v2 type="graduatedSymbol" attr="{escape(value)}" graduatedMethod="GraduatedColor"'
        ' symbollevels="0" enableorderby="0" forceraster="0">'
        f"<ranges>{ranges}</ranges><symbols>{symbols}</symbols></renderer-v2></qgis>\n"
    )


def _options(colour: tuple[int, int, int]) -> str:
    red, green, blue = colour
    options: dict[str, Any] = {
        "name": "circle", "color": f"{red},{green},{blue},255", "outline_style": "no", "size": "2", "size_unit": "MM",
    }  # fmt: skip
    return "".join(f'<Option type="QString" name="{name}" value="{text}"/>' for name, text in options.items())


FORMAT = Format(".gpkg", "all data", write)

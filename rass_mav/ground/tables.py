"""The tables of a mission's database (PostgreSQL with PostGIS, docs/integrate/outputs.md)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import parse_qsl, quote, urlencode, urlsplit

import psycopg

from rass_mav.errors import StoreError

#: The version of the tables below, which `rass.version` holds.
VERSION = 1
#: Who creates tables, or writes data, holds this lock until the end of the transaction. So the numbers of data rise in
#: the order in which they become visible.
WRITERS_LOCK = 0x52415353
#: A connection that is dead is noticed after this many seconds, and so is a statement that does not end.
DEAD_S = 15
STATEMENT_S = 30

_TABLES = (
    "CREATE EXTENSION IF NOT EXISTS postgis",
    "CREATE SCHEMA IF NOT EXISTS rass",
    "CREATE TABLE rass.version (version integer NOT NULL)",
    """CREATE TABLE rass.datum (
        number bigint GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
        mission text NOT NULL,
        origin bigint NOT NULL, epoch bigint NOT NULL, sequence bigint NOT NULL, crc bigint NOT NULL,
        apart boolean NOT NULL,
        kind bigint NOT NULL, hops bigint NOT NULL,
        utc double precision NOT NULL, created timestamptz, error_s double precision, at_least boolean NOT NULL,
        age_s double precision NOT NULL,
        place geography(Point, 4326), altitude double precision,
        reading double precision, unit text, risk double precision,
        payload bytea NOT NULL,
        UNIQUE (mission, origin, epoch, sequence, crc)
    )""",
    "CREATE INDEX ON rass.datum (mission, number)",
    "CREATE INDEX ON rass.datum USING gist (place)",
    """CREATE TABLE rass.arrival (
        datum bigint NOT NULL REFERENCES rass.datum, base integer NOT NULL,
        utc double precision, arrived timestamptz,
        PRIMARY KEY (datum, base)
    )""",
    """CREATE TABLE rass.loss (
        mission text NOT NULL, origin bigint NOT NULL, epoch bigint NOT NULL, sequence bigint NOT NULL,
        fate text NOT NULL,
        PRIMARY KEY (mission, origin, epoch, sequence)
    )""",
    """CREATE TABLE rass.progress (
        mission text NOT NULL, base integer NOT NULL,
        life bigint NOT NULL, epoch bigint NOT NULL, arrival bigint NOT NULL, apart bigint NOT NULL,
        PRIMARY KEY (mission, base)
    )""",
    f"INSERT INTO rass.version VALUES ({VERSION})",
)


def connect(url: str) -> psycopg.Connection[tuple[Any, ...]]:
    """A connection to a database. Statements are transactions of their own. Raises `psycopg.Error`."""
    # What the URL says counts more.
    usual = {
        "connect_timeout": str(DEAD_S), "keepalives_idle": str(DEAD_S // 3), "keepalives_interval": str(DEAD_S // 3),
        "keepalives_count": "2", "tcp_user_timeout": str(1000 * DEAD_S), "application_name": "rass-mav",
    }  # fmt: skip
    given = psycopg.conninfo.conninfo_to_dict(url)
    more = {name: text for name, text in usual.items() if name not in given}
    return psycopg.connect(psycopg.conninfo.make_conninfo(url, **more), autocommit=True)


def prepare(connection: psycopg.Connection[tuple[Any, ...]]) -> None:
    """Create the tables if there are none. Raises `StoreError` if they are of another version, and `psycopg.Error`."""
    connection.execute(f"SET statement_timeout = '{STATEMENT_S}s'")
    with connection.transaction():
        connection.execute("SELECT pg_advisory_xact_lock(%s)", (WRITERS_LOCK,))
        if version_of(connection) is None:
            for statement in _TABLES:
                connection.execute(statement)
    check_version(connection)


def version_of(connection: psycopg.Connection[tuple[Any, ...]]) -> int | None:
    """The version of the tables; None: there are none. Raises `psycopg.Error`."""
    found = connection.execute("SELECT to_regclass('rass.version') IS NOT NULL").fetchone()
    if found is None or not found[0]:
        return None
    row = connection.execute("SELECT version FROM rass.version").fetchone()
    return 0 if row is None else int(row[0])


def check_version(connection: psycopg.Connection[tuple[Any, ...]]) -> None:
    """Raise `StoreError` if these are not our tables, and `psycopg.Error`."""
    version = version_of(connection)
    if version is None:
        raise StoreError("this database contains no rass-mav data")
    if version != VERSION:
        raise StoreError(f"its tables are of version {version}, and this program knows version {VERSION}")


def split_url(url: str) -> tuple[str, str | None]:
    """The URL for libpq, and the mission that `?mission=` names (None: none)."""
    parts = urlsplit(url)
    options = parse_qsl(parts.query, keep_blank_values=True)
    mission = next((text for name, text in options if name == "mission"), None)
    # Not `geturl`, which drops the slashes in front of an empty host.
    rest = urlencode([option for option in options if option[0] != "mission"], quote_via=quote)
    return f"{parts.scheme}://{parts.netloc}{parts.path}" + (f"?{rest}" if rest else ""), mission


def shown(url: str) -> str:
    """The URL for messages: without user, password and options."""
    parts = urlsplit(url)
    return f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}{parts.path}"


@contextmanager
def explained(url: str) -> Iterator[None]:
    """Errors of the database at this URL are `StoreError`s, and they and ours about its state name it."""
    name = shown(url)
    try:
        yield
    except psycopg.Error as error:
        raise StoreError(f"{name}: {' '.join(str(error).split())}") from None
    except StoreError as error:
        raise StoreError(str(error) if name in str(error) else f"{name}: {error}") from None

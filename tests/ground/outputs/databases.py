"""A PostgreSQL server of the tests' own: in a temporary folder, on a unix socket only, as an ordinary user."""

from __future__ import annotations

import os
import pwd
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from glob import glob
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import quote

import pytest

from tests.patience import PATIENCE_S

psycopg = pytest.importorskip("psycopg", reason="psycopg is not installed")


def program(name: str) -> str:
    """A program of the server, which Debian does not put on the path."""
    found = shutil.which(name) or next(iter(sorted(glob(f"/usr/lib/postgresql/*/bin/{name}"), reverse=True)), None)
    if found is None:
        pytest.skip("PostgreSQL is not installed")
    return found


class Server:
    """A server, which can be stopped, killed and started again."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        # PostgreSQL refuses to run as root.
        self._user = pwd.getpwnam("nobody").pw_uid if os.geteuid() == 0 else os.geteuid()
        if os.geteuid() == 0:
            os.chown(folder, self._user, -1)
        self._data = folder / "data"
        self.run("initdb", "-U", "rass", "--auth=trust", "--encoding=UTF8", "--locale=C", "--no-sync")

    def run(self, name: str, *arguments: str) -> int:
        """Run a program of the server to its end. Returns the exit code."""
        user: dict[str, Any] = {"user": self._user, "extra_groups": []} if os.geteuid() == 0 else {}
        with (self.folder / "log").open("ab") as log:
            return subprocess.run(
                [program(name), "-D", str(self._data), *arguments],
                cwd="/", stdin=subprocess.DEVNULL, stdout=log, stderr=log, timeout=PATIENCE_S, check=False, **user,
            ).returncode  # fmt: skip

    def start(self) -> None:
        """Returns when it runs. After a kill that takes until the last of the old processes has ended."""
        deadline = time.monotonic() + PATIENCE_S
        options = f"-k {self.folder} -c listen_addresses='' -c fsync=off"
        while self.run("pg_ctl", "-w", "-o", options, "start") != 0:
            assert time.monotonic() < deadline, (self.folder / "log").read_text()

    def stop(self) -> None:
        """Returns when it has ended."""
        self.run("pg_ctl", "-w", "-m", "fast", "stop")

    def kill(self) -> None:
        """As if the computer had stopped, for all that the clients see."""
        pid = int((self._data / "postmaster.pid").read_text().split()[0])
        os.kill(pid, signal.SIGKILL)

    def url(self, name: str, user: str = "rass", **options: str) -> str:
        more = "".join(f"&{key}={quote(text)}" for key, text in options.items())
        return f"postgresql://{user}@/{name}?host={quote(str(self.folder), safe='')}{more}"

    def create(self, name: str) -> str:
        """An empty database; returns its URL."""
        with psycopg.connect(self.url("postgres"), autocommit=True) as connection:
            connection.execute(f'CREATE DATABASE "{name}"')
            if not connection.execute("SELECT FROM pg_available_extensions WHERE name = 'postgis'").fetchall():
                pytest.skip("PostGIS is not installed")
        return self.url(name)


@contextmanager
def server() -> Iterator[Server]:
    """A server that runs."""
    # Not pytest's own folder: the path of a unix socket must be short.
    with TemporaryDirectory(prefix="rass-pg-") as folder:
        made = Server(Path(folder))
        made.start()
        try:
            yield made
        finally:
            made.run("pg_ctl", "-w", "-m", "immediate", "stop")


def rows(url: str, query: str) -> list[tuple[Any, ...]]:
    with psycopg.connect(url) as connection:
        found: list[tuple[Any, ...]] = connection.execute(query).fetchall()
        return found

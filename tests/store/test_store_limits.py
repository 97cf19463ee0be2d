"""A disk that fails, a store that is in use, a path that cannot be."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from rass_mav.errors import StoreError
from rass_mav.store.disk import HostDisk
from rass_mav.store.reader import SqliteReader
from rass_mav.store.repairs import OpenReport
from tests.some import some
from tests.users import ordinary_user

from .store_helpers import ROOT, commit, datum, open_store

HOLDER = """
import sys
from pathlib import Path
from tests.store.store_helpers import open_store
store = open_store(Path(sys.argv[1]))
print("open", flush=True)
sys.stdin.read()
"""


def test_when_the_disk_fails_nothing_is_lost(path: Path, tmp_path: Path) -> None:
    with open_store(path) as store:
        store.put(datum(1))
        commit(store)
        store.put(datum(2, 20_000))
        batch = store.take()
        # From here on, no file of this process grows: the operating system fails the write half-way.
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, ((tmp_path / "node.db-wal").stat().st_size + 6000, hard))
        try:
            with pytest.raises(StoreError, match=r"node\.db"):
                store.write(batch)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        store.put(datum(3))
        assert [store.get(datum(number).id) is not None for number in (1, 2, 3)] == [True, True, True]
        with SqliteReader(path) as reader:
            assert [id.sequence for id in reader.ids()] == [1]
        commit(store)
        with SqliteReader(path) as reader:
            assert [reader.get(id) for id in reader.ids()] == [datum(1), datum(2, 20_000), datum(3)]


def test_two_stores_cannot_have_one_file(path: Path) -> None:
    with open_store(path) as store:
        store.put(datum(1))
        with pytest.raises(StoreError, match=rf"node\.db: in use by another node \(process {os.getpid()}\)"):
            open_store(path)
        commit(store)
    with open_store(path) as store:
        assert store.get(datum(1).id) == datum(1)


def test_the_lock_ends_with_the_process_that_holds_it(path: Path) -> None:
    child = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert some(child.stdout).readline() == "open\n"
    with pytest.raises(StoreError, match=f"process {child.pid}"):
        open_store(path)
    child.kill()
    child.communicate()
    with open_store(path) as store:
        assert not store.report.created


def test_the_lock_is_given_back_when_opening_fails(tmp_path: Path) -> None:
    path = tmp_path / "node.db"
    with pytest.raises(ValueError, match="32 bits"):
        open_store(path, draw_epoch=lambda: 1 << 32)
    with open_store(path) as store:
        assert store.report.created


def test_a_store_cut_off_while_it_was_made_is_made_again(path: Path) -> None:
    path.with_name("node.db.new").write_bytes(b"half a database")
    path.with_name("node.db.new-wal").write_bytes(b"half a log")
    with open_store(path) as store:
        assert store.report == OpenReport(created=True)
    assert sorted(file.name for file in path.parent.iterdir()) == ["node.db", "node.db.lock", "node.db.mark"]


def test_paths_that_cannot_be(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "directory").mkdir()
    (tmp_path / "directory").chmod(0o755)
    for path, reason in {
        "missing/node.db": f"there is no folder {tmp_path}/missing",
        "file/node.db": "Not a directory",
        "directory": "not a file",
    }.items():
        with pytest.raises(StoreError, match=reason) as error:
            open_store(tmp_path / path)
        assert str(tmp_path / path) in str(error.value)
    assert (tmp_path / "directory").stat().st_mode & 0o777 == 0o755, "what is not a store of ours keeps its rights"


def test_without_permission_to_write(path: Path) -> None:
    with ordinary_user(path.parent):
        with open_store(path) as store:
            store.put(datum(1))
        path.chmod(0o400)
        with open_store(path) as store:
            assert store.report.unwritable == "permission denied"
            assert store.get(datum(1).id) == datum(1)
            assert not store.accepting
        path.parent.chmod(0o500)
        with SqliteReader(path) as reader:
            assert reader.get(datum(1).id) == datum(1)
        with open_store(path.with_name("other.db")) as store:
            assert store.report.unwritable == "permission denied"
            assert list(store.ids()) == []
        path.parent.chmod(0o700)


def test_where_there_is_no_write_ahead_mode_no_store_is_made(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="no write-ahead mode here"):
        open_store(tmp_path / "node.db", disk=HostDisk("unix-none"))
    assert not (tmp_path / "node.db").exists()

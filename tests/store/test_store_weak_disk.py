"""A disk that cannot be written: the node starts all the same, and its store tells what it holds."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from random import Random

import pytest

from rass_mav.agent.commits import CommitGate
from rass_mav.core.datum import Fate
from rass_mav.core.messages import Beacon, Committed, Data, Handover
from rass_mav.errors import StoreError, StoreFullError
from rass_mav.lab.disk import Disk
from rass_mav.station.node import build_node
from rass_mav.store.reader import SqliteReader
from rass_mav.store.sqlite import SqliteStore
from tests.agent.build import heard, make, said
from tests.some import some

from .store_helpers import ROOT, commit, datum, open_store


def filled(path: Path, **options: object) -> SqliteStore:
    store = open_store(path, **options)
    for _ in range(5):
        store.put(datum(store.next_sequence()))
    commit(store)
    return store


def assert_reads_only(store: SqliteStore, held: int) -> None:
    assert not store.accepting
    assert not store.room_for(1)
    assert [store.get(id) for id in store.ids()] == [datum(number) for number in range(held)]
    with pytest.raises(StoreFullError, match="cannot be written"):
        store.next_sequence()
    with pytest.raises(StoreFullError, match="cannot be written"):
        store.put(datum(9))
    assert not store.keep_apart(datum(9))
    store.remove(datum(0).id, Fate.PASSED_ON)
    store.set_meta("announcement", 4)
    store.count("refused")
    for number in range(5000):
        store.lose(datum(100 + number).id, Fate.EXPIRED)
    assert len(list(store.ids())) == max(held - 1, 0)
    assert store.get_meta("announcement") == 4
    assert len(list(store.losses())) < 5000
    # Nothing waits for a commit that never comes.
    assert store.take(force=True) is None
    assert not store.unwritten
    assert CommitGate(store).is_idle()


def on_a_disk(disk: Disk) -> SqliteStore:
    return open_store(disk.directory / "node.db", disk=disk)


def test_a_read_only_disk() -> None:
    with Disk(Random(1)) as disk:
        store = filled(disk.directory / "node.db", disk=disk)
        life = store.life
        store.close()
        disk.read_only = True
        with on_a_disk(disk) as store:
            assert store.report.unwritable
            assert "relaying only, no data accepted" in store.report.remarks[0]
            assert store.life == life
            assert_reads_only(store, 5)
        disk.read_only = False
        with on_a_disk(disk) as store:
            assert store.report.remarks == []
            assert len(list(store.ids())) == 5


def test_where_there_is_no_store_and_none_can_be_made() -> None:
    with Disk(Random(1)) as disk:
        disk.read_only = True
        with on_a_disk(disk) as store:
            assert store.report.unwritable
            assert store.life != store.epoch
            assert_reads_only(store, 0)
        assert not (disk.directory / "node.db").exists()


def test_a_node_on_it_refuses_at_once_and_hands_on_what_it_has() -> None:
    with Disk(Random(1)) as disk:
        filled(disk.directory / "node.db", disk=disk).close()
        disk.read_only = True
        with on_a_disk(disk) as store:
            agent = build_node(make(1).settings, store, Random(1), now=0.0)
            gate = CommitGate(store)
            offered = Data(2, 1, (Handover(6, datum(6, origin=2)),))
            for _ in range(3):
                answers = heard(agent, offered, 0.0)
                assert said(answers) == [Committed(1, 2, (), (6,))]
                assert gate.say(answers) == answers
            beacons = [m for m in said(agent.step(0.0)) if isinstance(m, Beacon)]
            assert [beacon.free for beacon in beacons] == [0]
            assert agent.measure(1.0) is None
            assert len(agent.node.holdings) == 5
            assert agent.node.store is store


def test_a_disk_that_is_full_when_a_store_is_to_be_made() -> None:
    with Disk(Random(1)) as disk:
        disk.full = True
        with on_a_disk(disk) as store:
            assert store.report.unwritable == "disk full"
            assert_reads_only(store, 0)


MOUNTED = """
import subprocess, sys
from pathlib import Path
from tests.store.store_helpers import commit, datum, open_store
how, disk = sys.argv[1], sys.argv[2]
path = Path(disk) / "node.db"

def mount(*options):
    subprocess.run(["mount", *options], check=True, capture_output=True)

try:
    mount("-t", "tmpfs", "-o", "size=512k", "tmpfs", disk)
except (subprocess.CalledProcessError, FileNotFoundError):
    sys.exit(77)
if "empty" not in how:
    store = open_store(path)
    for _ in range(5):
        store.put(datum(store.next_sequence()))
    commit(store)
    if "killed" in how:
        files = {file: file.read_bytes() for file in Path(disk).iterdir()}
        store.close()
        for file, content in files.items():
            if not file.name.endswith("-shm"):
                file.write_bytes(content)
    else:
        store.close()
if "full" in how:
    with (Path(disk) / "fill").open("wb", buffering=0) as fill:
        try:
            while True:
                fill.write(bytes(4096))
        except OSError:
            pass
else:
    mount("-t", "tmpfs", "-o", "remount,ro,size=512k", "tmpfs", disk)
with open_store(path) as store:
    print(store.report.unwritable, store.accepting, len(list(store.ids())))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="mounts a file system of its own")
@pytest.mark.parametrize(
    ("how", "said"),
    [
        ("read-only", "read-only file system False 5"),
        ("read-only killed", "read-only file system False 5"),
        ("read-only empty", "read-only file system False 0"),
        ("full", "disk full False 5"),
        ("full killed", "disk full False 5"),
        ("full empty", "disk full False 0"),
    ],
)
def test_on_a_real_file_system(tmp_path: Path, how: str, said: str) -> None:
    command = ["unshare", "--user", "--map-root-user", "--mount"] if os.geteuid() else ["unshare", "--mount"]
    ran = subprocess.run(
        [*command, sys.executable, "-c", MOUNTED, how, str(tmp_path)],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    if ran.returncode in (1, 77) and "Traceback" not in ran.stderr:
        pytest.skip("may not mount here")
    assert ran.stdout.strip() == said, ran.stderr


def test_a_store_whose_disk_fills_up_goes_on_when_there_is_room() -> None:
    with Disk(Random(1)) as disk, filled(disk.directory / "node.db", disk=disk) as store:
        disk.full = True
        store.put(datum(9, 20_000))
        with pytest.raises(StoreFullError):
            commit(store)
        assert not store.accepting
        assert store.durable(datum(0).id)
        disk.full = False
        commit(store)
        assert store.accepting


@pytest.mark.parametrize("umask", [0, 0o777, 0o022])
def test_the_files_are_the_nodes_own_whatever_the_umask(tmp_path: Path, umask: int) -> None:
    path = tmp_path / "node.db"
    before = os.umask(umask)
    try:
        for _ in range(2):
            with open_store(path) as store:
                store.put(datum(store.next_sequence()))
                commit(store)
                modes = {file.name: file.stat().st_mode & 0o777 for file in tmp_path.iterdir()}
            assert modes.keys() >= {"node.db", "node.db-wal", "node.db-shm", "node.db.lock", "node.db.mark"}
            assert all(mode & ~0o640 == 0 and mode & 0o600 == 0o600 for mode in modes.values()), modes
        path.write_bytes(b"x")
        path.chmod(0o666)
        with open_store(path) as store:
            assert some(store.report.set_aside).stat().st_mode & 0o777 == 0o640
    finally:
        os.umask(before)


@pytest.mark.parametrize("name", ["a\0b", "\ud800.db", "", ".", "x" * 300])
@pytest.mark.parametrize("kind", [open_store, SqliteReader])
def test_a_path_that_cannot_be(tmp_path: Path, name: str, kind: Callable[[Path], object]) -> None:
    with pytest.raises(StoreError):
        kind(tmp_path / name if name not in ("", ".") else Path(name))

"""Damaged files: nothing wrong is ever taken for right, nothing is overwritten, and the node goes on."""

from __future__ import annotations

import os
import shutil
import sqlite3
import tempfile
from contextlib import closing
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from rass_mav.core.datum import Fate
from rass_mav.errors import StoreDamagedError, StoreError
from rass_mav.store import SqliteReader

from .store_helpers import EPOCH, commit, datum, epochs, open_store, payload

NEW_EPOCH = 77
COUNT = 40


def sizes(number: int) -> int:
    """Small and large: some payloads overflow into pages of their own."""
    return 50 if number % 4 else 9000


def build(path: Path) -> None:
    """A store with `COUNT` data, closed in good order."""
    with open_store(path) as store:
        for _ in range(COUNT):
            number = store.next_sequence()
            store.put(datum(number, sizes(number)))
        store.lose(datum(900).id, Fate.OVERFLOW)
        store.count("delivered", 5)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    build(tmp_path / "node.db")
    return tmp_path / "node.db"


def change(path: Path, statement: str) -> None:
    """Change a store behind its back."""
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("PRAGMA ignore_check_constraints = ON")
        assert connection.execute(statement).rowcount > 0
        connection.commit()


def assert_set_aside(path: Path, reason: str, **options: object) -> Path:
    """Opening sets the file aside and goes on with a new store. Returns where it lies."""
    with open_store(path, draw_epoch=epochs(NEW_EPOCH), **options) as store:
        report = store.report
        assert report.created
        assert report.set_aside is not None
        assert reason in report.reason
        assert (store.report.created, store.epoch, list(store.ids())) == (True, NEW_EPOCH, [])
        store.put(datum(store.next_sequence()))
    with open_store(path) as store:
        assert (store.report.created, store.epoch, len(list(store.ids()))) == (False, NEW_EPOCH, 1)
    return report.set_aside


@pytest.mark.parametrize("content", [b"", b"x", b"hello, world" * 1000, bytes(50_000)])
def test_a_file_that_is_no_database_is_set_aside(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "node.db"
    path.write_bytes(content)
    aside = assert_set_aside(path, "not a database")
    assert aside == tmp_path / "node.db.damaged-1"
    assert aside.read_bytes() == content


def test_another_programs_database_is_set_aside_untouched(tmp_path: Path) -> None:
    path = tmp_path / "node.db"
    with closing(sqlite3.connect(path)) as other:
        other.execute("CREATE TABLE bookmark (url TEXT)")
    before = path.read_bytes()
    assert assert_set_aside(path, "another program's database").read_bytes() == before


def test_what_was_set_aside_is_never_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "node.db"
    for number in (1, 2, 3):
        path.write_bytes(b"%d" % number)
        assert_set_aside(path, "not a database")
    for number in (1, 2, 3):
        assert (tmp_path / f"node.db.damaged-{number}").read_bytes() == b"%d" % number


def test_the_log_of_a_lost_database_is_not_played_into_the_new_one(path: Path, tmp_path: Path) -> None:
    with open_store(path) as store:
        store.put(datum(500))
        commit(store)
        log = (tmp_path / "node.db-wal").read_bytes()
    path.unlink()
    (tmp_path / "node.db-wal").write_bytes(log)
    aside = assert_set_aside(path, "without its database")
    assert aside.with_name(aside.name + "-wal").read_bytes() == log


@pytest.mark.parametrize("part", [0.3, 0.6, 0.99])
def test_a_truncated_database(path: Path, part: float) -> None:
    length = int(path.stat().st_size * part)
    os.truncate(path, length)
    assert assert_set_aside(path, "").stat().st_size == length


@pytest.mark.parametrize("check_limit", [0, 1 << 30])
@pytest.mark.parametrize(
    ("statement", "reason"),
    [
        ("UPDATE meta SET value = value - 1 WHERE name = 'store.next_sequence'", "complement"),
        ("UPDATE meta SET inverse = 7 WHERE name = 'store.epoch'", "complement"),
        ("DELETE FROM meta WHERE name = 'store.epoch'", "missing"),
        ("UPDATE counter SET value = 6", "complement"),
        ("UPDATE meta SET value = 1 << 32, inverse = ~(1 << 32) WHERE name = 'store.epoch'", "out of range"),
        ("UPDATE meta SET name = CAST(x'ff41' AS TEXT) WHERE name = 'store.epoch'", "UTF-8"),
    ],
)
def test_changed_numbers_are_found_in_files_of_any_size(
    path: Path, statement: str, reason: str, check_limit: int
) -> None:
    change(path, statement)
    assert_set_aside(path, reason, check_limit=check_limit)


@pytest.mark.parametrize(
    ("assignment", "found_at_opening"),
    [
        ("kind = 'x'", True),
        ("created = x'00'", True),
        ("crc = 1.5", True),
        ("size = 'large'", True),
        ("payload = 'text'", False),
    ],
)
def test_values_of_a_wrong_type_are_found(path: Path, assignment: str, found_at_opening: bool) -> None:
    change(path, f"UPDATE datum SET {assignment} WHERE sequence = 3")
    shutil.copy(path, path.with_name("large.db"))
    assert_set_aside(path, "row 4")
    # In a file too large to be checked, it is found by what reads it.
    if found_at_opening:
        assert_set_aside(path.with_name("large.db"), "wrong type", check_limit=0)
    else:
        with (
            open_store(path.with_name("large.db"), check_limit=0) as store,
            pytest.raises(StoreDamagedError, match="wrong type"),
        ):
            store.get(datum(3).id)


def test_an_id_that_changed_is_found_by_the_index(path: Path) -> None:
    content = bytearray(path.read_bytes())
    # The id lies in the row, shortly before its payload, and once more in the index.
    row = content.index(payload(21, sizes(21)))
    id = b"\x07\x00\x00\xfe\xdc\x00\x01\x15"
    assert (EPOCH, content.count(id)) == (0xFEDC0001, 2)
    at = content.rindex(id, row - 40, row) + len(id) - 1
    content[at] ^= 64
    path.write_bytes(content)
    assert assert_set_aside(path, "index").read_bytes() == content


def test_a_database_without_our_tables(path: Path) -> None:
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("DROP TABLE loss")
    assert_set_aside(path, "tables are not ours")


def test_a_database_out_of_write_ahead_mode(path: Path) -> None:
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("PRAGMA journal_mode = DELETE")
    assert_set_aside(path, "write-ahead")


def test_an_index_of_somebody_elses_does_no_harm(path: Path) -> None:
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("CREATE INDEX datum_created ON datum (created)")
    with open_store(path) as store:
        assert not store.report.created
        assert len(list(store.ids())) == COUNT


def test_a_newer_versions_store_is_neither_used_nor_set_aside(path: Path) -> None:
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("PRAGMA user_version = 2")
    with pytest.raises(StoreError, match="newer version"):
        open_store(path)
    with pytest.raises(StoreError, match="newer version"):
        SqliteReader(path)
    assert not list(path.parent.glob("*damaged*"))


def break_overflow_chain(path: Path, number: int) -> None:
    """Damage a large payload such that it cannot be read, though nothing else is amiss."""
    content = bytearray(path.read_bytes())
    # The second page that the payload overflows into starts with four bytes that point to the third.
    start = content.index(payload(number, sizes(number))[-2000:-1900]) // 4096 * 4096
    page = start // 4096 + 1
    pointer = content.index(page.to_bytes(4, "big"))
    assert pointer % 4096 == 0
    content[pointer : pointer + 4] = b"\xff\xff\xff\xff"
    path.write_bytes(content)


def test_damage_that_shows_late_is_told_and_the_store_opened_anew(path: Path) -> None:
    break_overflow_chain(path, 8)
    damaged = path.read_bytes()
    store = open_store(path, check_limit=0)
    assert not store.report.created
    assert store.get(datum(7).id) == datum(7)
    with pytest.raises(StoreDamagedError, match=r"node\.db: .* malformed \(while reading a datum\)"):
        store.get(datum(8).id)
    store.abandon()
    aside = assert_set_aside(path, "", check_limit=0, suspect=True)
    assert aside.read_bytes() == damaged


def test_damage_that_shows_in_a_write(path: Path) -> None:
    break_overflow_chain(path, 8)
    store = open_store(path, check_limit=0)
    store.remove(datum(8).id, Fate.PASSED_ON)
    store.put(datum(700))
    with pytest.raises(StoreDamagedError):
        commit(store)
    assert store.get(datum(700).id) == datum(700)
    with pytest.raises(StoreDamagedError):
        store.close()
    assert_set_aside(path, "", check_limit=0, suspect=True)


def test_a_row_that_vanished_from_a_running_store_is_damage(path: Path) -> None:
    with open_store(path) as store:
        change(path, "DELETE FROM datum WHERE sequence = 5")
        with pytest.raises(StoreDamagedError, match="not found"):
            store.get(datum(5).id)


def test_a_loss_that_cannot_be_understood(path: Path) -> None:
    change(path, "UPDATE loss SET fate = 'eaten'")
    with open_store(path, check_limit=0) as store, pytest.raises(StoreDamagedError, match="eaten"):
        list(store.losses())
    assert_set_aside(path, "eaten")


def test_a_suspect_that_is_sound_keeps_its_data(path: Path) -> None:
    with open_store(path, suspect=True, check_limit=0) as store:
        assert store.report == (False, None, "")
        assert [store.get(id) for id in store.ids()] == [datum(number, sizes(number)) for number in range(COUNT)]


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("sound") / "node.db"
    build(path)
    return path


@settings(max_examples=150, deadline=None)
@given(
    header=st.booleans(),
    flips=st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(1, 255)), min_size=1, max_size=4),
)
@example(header=False, flips=[(0.02734375, 128)])  # a table's definition that is not UTF-8 any more
def test_flipped_bytes_are_never_taken_for_data(sound: Path, header: bool, flips: list[tuple[float, int]]) -> None:
    content = bytearray(sound.read_bytes())
    for place, bits in flips:
        # The first page holds the file's header and the tables' definitions.
        content[int(place * (100 if header else len(content)))] ^= bits
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "node.db"
        path.write_bytes(content)
        try:
            store = open_store(path, draw_epoch=epochs(NEW_EPOCH))
        except StoreError:
            # The one reason not to go on: bytes 60..63, the schema's version, have grown.
            assert int.from_bytes(content[60:64], "big", signed=True) > 1
            assert path.read_bytes() == content
            return
        with store:
            if store.report.set_aside is not None:
                assert store.report.set_aside.read_bytes() == content
                assert (store.report.created, store.epoch, list(store.ids())) == (True, NEW_EPOCH, [])
                return
            assert not store.report.created
            assert store.epoch == EPOCH
            assert store.next_sequence() == COUNT
            assert store.counters() == {"delivered": 5}
            assert [info.id.sequence for info in store.held()] == list(range(COUNT))
            for id in store.ids():
                found = store.get(id)
                assert found is not None
                original = datum(id.sequence, sizes(id.sequence))
                if found.intact:
                    assert (found.kind, found.payload) == (original.kind, original.payload)


@settings(max_examples=60, deadline=None)
@given(place=st.floats(0, 1, exclude_max=True), bits=st.integers(1, 255), truncate=st.booleans())
def test_a_damaged_log_after_a_power_cut_gives_an_earlier_commit_whole(place: float, bits: int, truncate: bool) -> None:
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "node.db"
        with open_store(path) as store:
            for _ in range(8):
                for _ in range(3):
                    store.put(datum(store.next_sequence()))
                store.count("made", 3)
                commit(store)
            # What the disk holds at a power cut.
            image = path.read_bytes(), bytearray((path.parent / "node.db-wal").read_bytes())
        content, log = image
        at = int(place * len(log))
        if truncate:
            del log[at:]
        else:
            log[at] ^= bits
        copy = Path(directory) / "copy.db"
        copy.write_bytes(content)
        (Path(directory) / "copy.db-wal").write_bytes(log)
        with open_store(copy) as store:
            made = store.next_sequence()
            assert not store.report.created
            assert made % 3 == 0
            assert store.counters().get("made", 0) == made
            assert [store.get(id) for id in store.ids()] == [datum(number) for number in range(made)]

"""Damaged files: nothing wrong is ever taken for right, nothing is overwritten, and the node goes on."""

from __future__ import annotations

import errno
import os
import shutil
import sqlite3
import struct
import tempfile
from contextlib import closing
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rass_mav.core.datum import DatumId, Fate
from rass_mav.core.messages import Beacon, Data
from rass_mav.errors import StoreDamagedError, StoreError
from rass_mav.store import drafts
from rass_mav.store.reader import SqliteReader
from rass_mav.store.repairs import OpenReport
from rass_mav.store.schema import PAGE_BYTES
from tests.core.build import make_node, of
from tests.extent import examples
from tests.some import some

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
        store.lose(datum(900).id, Fate.OVERFLOW, b"proof")
        store.count("delivered", 5)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    build(tmp_path / "node.db")
    return tmp_path / "node.db"


def life_of(path: Path) -> int:
    with SqliteReader(path) as reader:
        return reader.life


def change(path: Path, statement: str) -> None:
    """Change a store behind its back."""
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("PRAGMA ignore_check_constraints = ON")
        assert connection.execute(statement).rowcount > 0
        connection.commit()


def assert_set_aside(path: Path, reason: str, *, kept: int = COUNT, **options: object) -> Path:
    """Opening sets the file aside and goes on with a new store, of what can be salvaged. Returns where it lies."""
    with open_store(path, draw_epoch=epochs(NEW_EPOCH), **options) as store:
        report = store.report
        assert report.created
        assert report.set_aside is not None
        assert reason in report.reason
        assert store.epoch != store.life
        assert EPOCH not in (store.epoch, store.life)
        assert len(list(store.ids())) == report.salvaged == kept
        for id in store.ids():
            assert store.get(id) == datum(id.sequence, sizes(id.sequence))
        missing = COUNT - kept
        if report.closed:
            assert dict(store.losses())[DatumId(7, EPOCH, COUNT)] is Fate.UNKNOWN
            assert report.lost >= missing
        if report.lost:
            assert dict(store.losses())[DatumId(7, store.life, report.lost)] is Fate.DAMAGED
        new = store.epoch
        store.put(datum(store.next_sequence(), epoch=new))
    with open_store(path) as store:
        assert (store.report, store.epoch, len(list(store.ids()))) == (OpenReport(), new, kept + 1)
    return report.set_aside


@pytest.mark.parametrize("content", [b"", b"x", b"hello, world" * 1000, bytes(50_000)])
def test_a_file_that_is_no_database_is_set_aside(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "node.db"
    path.write_bytes(content)
    aside = assert_set_aside(path, "not a database", kept=0)
    assert aside == tmp_path / "node.db.damaged-1"
    assert aside.read_bytes() == content


def test_another_programs_database_is_set_aside_untouched(tmp_path: Path) -> None:
    path = tmp_path / "node.db"
    with closing(sqlite3.connect(path)) as other:
        other.execute("CREATE TABLE bookmark (url TEXT)")
    before = path.read_bytes()
    assert assert_set_aside(path, "another program's database", kept=0).read_bytes() == before


def test_what_was_set_aside_is_never_overwritten(path: Path, tmp_path: Path) -> None:
    for number in (1, 2, 3):
        path.write_bytes(b"%d" % number)
        with open_store(path) as store:
            assert store.report.set_aside == tmp_path / f"node.db.damaged-{number}"
    for number in (1, 2, 3):
        assert (tmp_path / f"node.db.damaged-{number}").read_bytes() == b"%d" % number


def test_the_log_of_a_lost_database_is_not_played_into_the_new_one(path: Path, tmp_path: Path) -> None:
    with open_store(path) as store:
        store.put(datum(500))
        commit(store)
        log = (tmp_path / "node.db-wal").read_bytes()
    path.unlink()
    (tmp_path / "node.db-wal").write_bytes(log)
    with open_store(path) as store:
        report = store.report
        assert "without its database" in report.reason
        # What the log has can be salvaged, and the mark knows how much is missing.
        assert store.get(datum(500).id) == datum(500)
        assert report.lost >= COUNT + 1 - report.salvaged
    assert report.set_aside is not None
    assert report.set_aside.with_name(report.set_aside.name + "-wal").read_bytes() == log


def test_a_database_that_is_gone_is_missed(path: Path) -> None:
    path.unlink()
    with open_store(path) as store:
        assert store.report.created
        # The loss that was noted is lost too.
        assert store.report.lost == COUNT + 1
        assert dict(store.losses()) == {
            DatumId(7, EPOCH, COUNT): Fate.UNKNOWN,
            DatumId(7, store.life, COUNT + 1): Fate.DAMAGED,
        }


class Killed(BaseException):
    pass


def test_a_node_killed_while_it_replaces_a_damaged_store_leaves_the_old_or_the_new_one(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    damaged = bytes(16) + path.read_bytes()[16:]
    rename, reached = Path.rename, 0
    for point in range(20):
        folder = tmp_path / str(point)
        folder.mkdir()
        copy = folder / "node.db"
        for ending in (".mark", ".payloads"):
            shutil.copy(f"{path}{ending}", f"{copy}{ending}")
        copy.write_bytes(damaged)
        left = point

        def dying(self: Path, target: Path) -> Path:
            nonlocal left
            if left == 0:
                raise Killed
            left -= 1
            return rename(self, target)

        with monkeypatch.context() as patched:
            patched.setattr(Path, "rename", dying)
            patched.setattr(drafts, "_discard", lambda draft: None)
            try:
                open_store(copy).close()
            except Killed:
                reached += 1
        with open_store(copy) as store:
            assert {store.get(id) for id in store.ids()} == {datum(n, sizes(n)) for n in range(COUNT)}
        assert (folder / "node.db.damaged-1").read_bytes() == damaged
    assert 4 <= reached < 20


def test_without_room_for_the_new_one_a_damaged_store_stays_as_it_is(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    damaged = bytes(16) + path.read_bytes()[16:]
    path.write_bytes(damaged)

    def full(path: Path, mark: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patched:
        patched.setattr(drafts, "make_mark", full)
        with open_store(path) as store:
            assert store.report.unwritable == "disk full"
    assert path.read_bytes() == damaged
    assert_set_aside(path, "not a database")


@pytest.mark.parametrize("part", [0.3, 0.6, 0.99])
def test_a_truncated_database(path: Path, part: float) -> None:
    length = int(path.stat().st_size * part)
    os.truncate(path, length)
    with open_store(path) as store:
        report = store.report
        assert report.set_aside is not None
        assert len(list(store.ids())) + len(dict(store.losses())) - 2 + report.lost >= COUNT + 1
        assert dict(store.losses())[DatumId(7, EPOCH, COUNT)] is Fate.UNKNOWN
    assert report.set_aside.stat().st_size == length


@pytest.mark.parametrize("check_limit", [0, 1 << 30])
@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE meta SET value = value - 1 WHERE name = 'store.next_sequence'",
        "UPDATE meta SET inverse = 7 WHERE name = 'store.epoch'",
        "DELETE FROM meta WHERE name = 'store.epoch'",
        "UPDATE meta SET value = 1 << 32, inverse = ~(1 << 32) WHERE name = 'store.epoch'",
        "UPDATE meta SET name = CAST(x'ff41' AS TEXT) WHERE name = 'store.epoch'",
        "UPDATE meta SET value = 9 WHERE name = 'store.life'",
        "UPDATE meta SET value = 'x' WHERE name = 'store.written'",
    ],
)
def test_a_damaged_number_of_the_stores_own_means_a_new_epoch(path: Path, statement: str, check_limit: int) -> None:
    life = life_of(path)
    change(path, statement)
    with open_store(path, check_limit=check_limit, draw_epoch=epochs(NEW_EPOCH)) as store:
        assert not store.report.created
        assert "number in table meta" in store.report.reason
        assert (store.life, store.epoch, store.assigned) == (life, NEW_EPOCH, 0)
        assert len(list(store.ids())) == COUNT
        assert dict(store.losses()) == {datum(900).id: Fate.OVERFLOW, DatumId(7, EPOCH, COUNT): Fate.UNKNOWN}
        assert store.proofs() == {datum(900).id: b"proof"}
        assert store.report.lost == 0
    with open_store(path) as store:
        assert (store.report, store.epoch) == (OpenReport(), NEW_EPOCH)


@pytest.mark.parametrize("check_limit", [0, 1 << 30])
@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE counter SET value = 6 WHERE name = 'delivered'",
        "UPDATE counter SET name = CAST(x'ff41' AS TEXT), inverse = 0",
        "UPDATE counter SET value = x'00'",
    ],
)
def test_any_other_damaged_number_is_left_out_and_said(path: Path, statement: str, check_limit: int) -> None:
    change(path, statement)
    with open_store(path, check_limit=check_limit) as store:
        assert not store.report.created
        assert len(store.report.dropped) == 1
        assert "number" in store.report.remarks[0]
        assert (store.counters(), store.epoch, store.assigned) == ({}, EPOCH, COUNT)
    with open_store(path) as store:
        assert store.report == OpenReport()


@pytest.mark.parametrize("check_limit", [0, 1 << 30])
def test_a_number_without_a_name_is_damage(path: Path, check_limit: int) -> None:
    content = bytearray(path.read_bytes())
    # The first byte is the size of the row's header. Without a header all columns are NULL.
    content[content.index(b"\x04\x1f\x01\x01delivered\x05\xfa")] ^= 4
    path.write_bytes(content)
    assert_set_aside(path, "counter", check_limit=check_limit)


@pytest.mark.no_cover
@pytest.mark.parametrize("check_limit", [0, 1 << 30])
@pytest.mark.parametrize(
    ("assignment", "found_at_opening"),
    [
        ("kind = 'x'", True),
        ("created = x'00'", True),
        ("crc = 1.5", True),
        ("size = 'large'", True),
        ("at_least = 'maybe'", True),
        ("at_least = 7", False),
        ("payload = 'text'", False),
    ],
)
def test_one_damaged_row_is_one_row(path: Path, assignment: str, found_at_opening: bool, check_limit: int) -> None:
    change(path, f"UPDATE datum SET {assignment} WHERE sequence = 3")
    # In a file too large to be checked, it is found by what reads it.
    if check_limit or found_at_opening:
        with open_store(path, check_limit=check_limit) as store:
            assert not store.report.created
            assert store.report.dropped == ("row 4 of table datum",)
            assert (store.epoch, store.assigned) == (EPOCH, COUNT)
            assert {id.sequence for id in store.ids()} == {*range(COUNT)} - {3}
            assert dict(store.losses())[datum(3).id] is Fate.CORRUPTED


def test_a_row_that_is_found_damaged_when_it_is_read(path: Path) -> None:
    change(path, "UPDATE datum SET payload = 'text' WHERE sequence = 3")
    with open_store(path, check_limit=0) as store, pytest.raises(StoreDamagedError, match="wrong type"):
        store.get(datum(3).id)
    with open_store(path, check_limit=0, suspect=True) as store:
        assert store.report.dropped == ("row 4 of table datum",)


def test_an_id_that_changed_is_found_by_the_index(path: Path) -> None:
    content = bytearray(path.read_bytes())
    # The id lies in the row, shortly before its payload, and once more in the index.
    row = content.index(payload(21, sizes(21)))
    id = b"\x07\x00\x00\xfe\xdc\x00\x01\x15"
    assert (EPOCH, content.count(id)) == (0xFEDC0001, 2)
    at = content.rindex(id, row - 40, row) + len(id) - 1
    content[at] ^= 64
    path.write_bytes(content)
    assert assert_set_aside(path, "index", kept=COUNT - 1).read_bytes() == content


def test_a_time_that_became_no_number_costs_one_row(path: Path) -> None:
    content = bytearray(path.read_bytes())
    row = content.index(payload(9, sizes(9)))
    at = content.rindex(struct.pack(">d", 1.5), row - 40, row)
    # One bit makes 1.5 no number.
    content[at] ^= 64
    path.write_bytes(bytes(16) + content[16:])
    assert_set_aside(path, "not a database", kept=COUNT - 1)


def test_a_database_without_our_tables(path: Path) -> None:
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("DROP TABLE loss")
        connection.commit()
    assert_set_aside(path, "tables are not those of rass-mav")


def test_a_tables_definition_that_is_not_utf_8_any_more(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[content.index(b"= 'integer'") + 4] ^= 128
    path.write_bytes(content)
    assert_set_aside(path, "UTF-8")


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


def break_overflow_chain(path: Path, number: int) -> None:
    """Damage a large payload such that it cannot be read, though nothing else is amiss. It is in its row, as
    salvaged ones are."""
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("UPDATE datum SET payload = ? WHERE sequence = ?", (payload(number, sizes(number)), number))
        connection.commit()
    content = bytearray(path.read_bytes())
    # A page that the payload overflows into starts with four bytes that point to the next.
    start = content.index(payload(number, sizes(number))[-2000:-1900]) // PAGE_BYTES * PAGE_BYTES
    page = start // PAGE_BYTES + 1
    pages = range(0, len(content), PAGE_BYTES)
    pointer = next(at for at in pages if content[at : at + 4] == page.to_bytes(4, "big"))
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
    aside = assert_set_aside(path, "", check_limit=0, suspect=True, kept=COUNT - 1)
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
    assert_set_aside(path, "", check_limit=0, suspect=True, kept=COUNT - 1)


def test_a_row_that_vanished_from_a_running_store_is_damage(path: Path) -> None:
    with open_store(path) as store:
        change(path, "DELETE FROM datum WHERE sequence = 5")
        with pytest.raises(StoreDamagedError, match="not in the database"):
            store.get(datum(5).id)


def test_a_loss_that_cannot_be_understood_is_left_out_and_counted(path: Path) -> None:
    change(path, "UPDATE loss SET fate = 'eaten'")
    with open_store(path, check_limit=0) as store:
        assert store.report.dropped == ("a loss",)
        assert dict(store.losses()) == {DatumId(7, store.life, 1): Fate.DAMAGED}


def test_a_suspect_that_is_sound_keeps_its_data(path: Path) -> None:
    with open_store(path, suspect=True, check_limit=0) as store:
        assert store.report == OpenReport()
        assert [store.get(id) for id in store.ids()] == [datum(number, sizes(number)) for number in range(COUNT)]


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("sound") / "node.db"
    build(path)
    return path


@pytest.mark.no_cover
@settings(max_examples=examples(150), deadline=None)
@given(
    header=st.booleans(),
    flips=st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(1, 255)), min_size=1, max_size=4),
)
def test_flipped_bytes_are_never_taken_for_data(sound: Path, header: bool, flips: list[tuple[float, int]]) -> None:
    content = bytearray(sound.read_bytes())
    for position, bits in flips:
        # The first page holds the file's header and the tables' definitions.
        content[int(position * (100 if header else len(content)))] ^= bits
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "node.db"
        path.write_bytes(content)
        shutil.copy(sound.with_name("node.db.mark"), path.with_name("node.db.mark"))
        try:
            store = open_store(path, draw_epoch=epochs(NEW_EPOCH))
        except StoreError:
            # The one reason not to go on: bytes 60..63, the schema's version, are another one.
            assert int.from_bytes(content[60:64], "big", signed=True) not in range(-(1 << 31), 1)
            assert content[60:64] != sound.read_bytes()[60:64]
            assert path.read_bytes() == content
            return
        with store:
            report = store.report
            if report.set_aside is not None:
                assert report.set_aside.read_bytes() == content
                assert EPOCH not in (store.epoch, store.life)
            elif store.epoch == EPOCH:
                assert store.next_sequence() == COUNT
            held = {info.id.sequence: store.get(info.id) for info in store.held()}
            for number in range(COUNT):
                found = held.pop(number, None)
                original = datum(number, sizes(number))
                if found is not None and found.intact:
                    assert (found.kind, found.payload) == (original.kind, original.payload)
            assert not held


@pytest.mark.no_cover
@settings(max_examples=examples(60), deadline=None)
@given(
    position=st.floats(0, 1, exclude_max=True), bits=st.integers(1, 255), truncate=st.booleans(), known=st.booleans()
)
def test_what_a_damaged_log_takes_with_it_is_salvaged_or_told(
    position: float, bits: int, truncate: bool, known: bool
) -> None:
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "node.db"
        with open_store(path) as store:
            for _ in range(8):
                for _ in range(3):
                    store.put(datum(store.next_sequence()))
                commit(store)
            # What the disk holds after kill -9; after a power cut the mark may be older, or not there.
            image = path.read_bytes(), bytearray((path.parent / "node.db-wal").read_bytes())
            mark = (path.parent / "node.db.mark").read_bytes()
        content, log = image
        at = int(position * len(log))
        if truncate:
            del log[at:]
        else:
            log[at] ^= bits
        copy = Path(directory) / "copy.db"
        copy.write_bytes(content)
        (Path(directory) / "copy.db-wal").write_bytes(log)
        if known:
            (Path(directory) / "copy.db.mark").write_bytes(mark)
        with open_store(copy, draw_epoch=epochs(NEW_EPOCH)) as store:
            report = store.report
            assert not report.created
            held = {id.sequence for id in store.ids()}
            for id in store.ids():
                found = store.get(id)
                # No checksum of ours covers the rest of a row.
                assert found is not None
                assert (found.kind, found.payload) == (1, payload(id.sequence, 50))
            if store.epoch == EPOCH:
                assert held == {*range(24)}
                assert store.assigned == 24
            elif known:
                assert dict(store.losses())[DatumId(7, EPOCH, 24)] is Fate.UNKNOWN
                assert 24 - len(held) <= report.lost <= 24
            else:
                assert report.closed


def test_what_is_made_after_a_bit_flipped_in_the_log_arrives_beside_what_was_made_before(tmp_path: Path) -> None:
    base = make_node(0, base=True)

    def life(path: Path, count: int, start: float) -> list[DatumId]:
        """A drone of its own makes data, and hands all over to the base."""
        with open_store(path, draw_epoch=draw) as store:
            node = make_node(7, store=store, now=start, newborn=start == 0.0, capacity_items=100)  # type: ignore[arg-type]
            made = [node.put(b"%d, made at %d" % (n, start), start) for n in range(count)]
            for turn in range(40):
                commit(store)
                for beacon in of(Beacon, base.step(start + turn)):
                    node.receive(beacon, start + turn)
                for message in of(Data, node.step(start + turn)):
                    for answer in base.receive(message, start + turn):
                        node.receive(answer, start + turn)
            commit(store)
            assert not node.holdings.custody
            copy = tmp_path / "copy.db"
            if path != copy:
                copy.write_bytes(path.read_bytes())
                log = bytearray((tmp_path / "node.db-wal").read_bytes())
                log[40] ^= 1
                (tmp_path / "copy.db-wal").write_bytes(log)
                (tmp_path / "copy.db.mark").write_bytes((tmp_path / "node.db.mark").read_bytes())
            return made

    draw = epochs()
    before = life(tmp_path / "node.db", 8, 0.0)
    after = life(tmp_path / "copy.db", 30, 100.0)
    assert not set(before) & set(after)
    for ids, start in ((before, 0), (after, 100)):
        for n, id in enumerate(ids):
            arrived = some(base.store.get(id))
            assert arrived.payload == b"%d, made at %d" % (n, start)


def test_a_store_of_which_there_is_a_copy_keeps_its_data_and_begins_a_new_epoch(path: Path) -> None:
    life = life_of(path)
    with open_store(path, draw_epoch=epochs(NEW_EPOCH), doubt="there is a copy of it") as store:
        assert (store.life, store.epoch, store.assigned) == (life, NEW_EPOCH, 0)
        assert len(list(store.ids())) == COUNT
        assert (store.report.reason, store.report.lost) == ("there is a copy of it", 0)
        assert store.report.closed == ((EPOCH, COUNT),)
        assert (DatumId(7, EPOCH, COUNT), Fate.UNKNOWN) in store.losses(), "the copy may assign more numbers"
    with open_store(path, draw_epoch=epochs(99)) as store:
        assert (store.epoch, store.report) == (NEW_EPOCH, OpenReport())

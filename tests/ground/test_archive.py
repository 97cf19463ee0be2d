"""Stores read without their node: while it writes, after it has stopped, and as a damaged card."""

from __future__ import annotations

import json
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rass_mav.core.datum import DatumId, Fate, Kind, make_datum
from rass_mav.errors import ConfigError, StoreError
from rass_mav.ground.archive import DATE_ERROR_S, Archive
from rass_mav.ground.attention.watch import Watch
from rass_mav.ground.commands.data import datum_line
from rass_mav.ground.commands.report import report_lines
from rass_mav.ground.entry import Filter
from rass_mav.store.schema import PAGE_BYTES
from tests.extent import examples
from tests.some import some
from tests.store.store_helpers import commit
from tests.users import ordinary_user

from .missions import HERE, WALL_S, Base


def test_what_arrives_while_the_node_runs_is_seen_at_the_next_look(base: Base) -> None:
    base.arrive(base.measurement(7, 0, HERE, age_s=20.0, hops=3))
    with Archive(base.path, now=lambda: base.wall + 30.0) as archive:
        [first] = archive.entries()
        assert (first.name, first.kind_name, first.hops) == ("7-abc00001-0", "measurement", 3)
        assert first.utc == pytest.approx(WALL_S - 20.0, abs=0.01)
        assert first.arrived == pytest.approx(WALL_S, abs=0.01)
        assert first.age_s == pytest.approx(50.0, abs=0.01)
        assert some(first.measurement).unit == "usvh"
        assert first.place == (47.3769, 8.5417)
        base.wall += 60.0
        base.arrive(base.file(8, 0, "photo.jpg", b"\xff\xd8"), base.datum(8, 1, Kind.BYTES, b"hello"))
        assert [e.name for e in archive.entries()] == ["7-abc00001-0"], "all of one look are of one moment"
        archive.renew()
        photo, hello = archive.arrivals(first.arrival)
        assert photo.file == "photo.jpg"
        assert photo.arrived == pytest.approx(WALL_S + 60.0, abs=0.01)
        assert archive.datum(hello.name).payload == b"hello"
        assert list(archive.arrivals(hello.arrival)) == []


def test_the_bound_of_the_error_grows_with_hops_and_age_and_there_is_none_without_a_date(tmp_path: Path) -> None:
    def errors(*, trusted: bool) -> list[float | None]:
        base = Base(tmp_path / f"{trusted}.db", trusted=trusted)
        base.arrive(
            base.measurement(7, 0, HERE),
            base.measurement(7, 1, HERE, hops=5),
            base.measurement(7, 2, HERE, age_s=86_400.0),
            base.measurement(7, 3, HERE)._replace(at_least=True),
        )
        base.close()
        with Archive(base.path, now=lambda: base.wall) as archive:
            return [entry.error_s for entry in archive.entries()]

    near, far, old, unsure = errors(trusted=True)
    assert near is not None
    assert DATE_ERROR_S <= near < some(far)
    assert some(old) > near + 5.0
    assert unsure is None
    assert errors(trusted=False) == [None] * 4


def test_a_datum_before_its_time_has_no_negative_age(base: Base) -> None:
    base.arrive(base.measurement(7, 0, HERE, age_s=-1000.0))
    with Archive(base.path, now=lambda: base.wall) as archive:
        assert [entry.age_s for entry in archive.entries()] == [0.0]


@pytest.mark.parametrize("created", [float("inf"), float("-inf"), 1e308, -1e18])
def test_a_time_that_cannot_be_is_a_flipped_bit(base: Base, created: float) -> None:
    base.arrive(base.measurement(7, 0, HERE)._replace(created=created))
    with Archive(base.path, now=lambda: base.wall) as archive:
        [entry] = archive.entries()
        assert entry.utc == pytest.approx(WALL_S, abs=0.01), "it was created when it arrived, or earlier"
        assert (entry.at_least, entry.error_s) == (True, None)


def test_a_corrupt_measurement_is_none(base: Base) -> None:
    base.arrive(base.measurement(7, 0, HERE))
    base.close()
    with closing(sqlite3.connect(base.path)) as connection:
        connection.execute(
            "UPDATE datum SET payload = CAST(substr(payload, 1, 2) || 'x' || substr(payload, 4) AS BLOB)"
        )
        connection.commit()
    with Archive(base.path) as archive:
        [entry] = archive.entries()
        assert (entry.measurement, entry.malformed) == (None, "corrupt, its checksum does not match")


@given(
    payload=st.binary(min_size=1, max_size=120), kind=st.sampled_from([*Kind, 77]), created=st.floats(allow_nan=False),
    origin=st.integers(0, 65535), sequence=st.integers(0, 2**32 - 1),
)  # fmt: skip
@settings(max_examples=examples(50))
def test_whatever_drones_send_is_listed_and_reported(
    payload: bytes, kind: int, created: float, origin: int, sequence: int
) -> None:  # fmt: skip
    with TemporaryDirectory() as folder:
        base = Base(Path(folder) / "base.db")
        base.arrive(make_datum(DatumId(origin, 5, sequence), kind, created, payload))
        with Archive(base.path, now=lambda: base.wall) as archive:
            [entry] = archive.entries()
            assert "\n" not in datum_line(entry)
            json.dumps(entry.plain(), allow_nan=False)
            watch = Watch.of(archive)
        report = watch.plain(base.wall)
        json.dumps(report, allow_nan=False)
        assert all(line.isprintable() or not line for line in report_lines(report, watch.rows(base.wall)))
        base.close()


def test_both_contents_of_an_id_are_there(base: Base) -> None:
    base.arrive(base.datum(7, 0, Kind.BYTES, b"one"))
    base.store.keep_apart(base.datum(7, 0, Kind.BYTES, b"another"))
    commit(base.store)
    with Archive(base.path) as archive:
        one, another = archive.entries()
        assert (one.apart, another.apart) == (False, True)
        assert [archive.datum(e.name).payload for e in (one, another)] == [b"one", b"another"]
        assert archive.entry(another.name).name == another.name


def test_what_is_not_there_or_corrupt_is_an_error_that_names_it(base: Base) -> None:
    base.arrive(base.datum(7, 0, Kind.BYTES, b"one"))
    base.close()
    with closing(sqlite3.connect(base.path)) as connection:
        connection.execute("UPDATE datum SET payload = x'6f6e66'")
        connection.commit()
    with Archive(base.path) as archive:
        with pytest.raises(StoreError, match="7-abc00001-1: not in "):
            archive.datum("7-abc00001-1")
        with pytest.raises(StoreError, match="7-abc00001-0: corrupt"):
            archive.datum("7-abc00001-0")


def test_a_measurement_and_a_file_that_cannot_be_read_say_so(base: Base) -> None:
    base.arrive(base.datum(7, 0, Kind.MEASUREMENT, b"\x09short"), base.datum(7, 1, Kind.FILE, b"\xffshort"))
    base.arrive(base.datum(7, 2, 57, b"of a later version"))
    with Archive(base.path) as archive:
        short, cut, later = archive.entries()
        assert "truncated" in short.malformed
        assert "truncated" in cut.malformed
        assert (later.malformed, later.kind_name) == ("", "57")


def fill(base: Base, count: int) -> None:
    for number in range(count):
        base.wall += 1.0
        base.arrive(base.measurement(7, number, HERE._replace(reading=float(number))))
    base.close()


@pytest.mark.parametrize("page", [0, 1, 5, -1], ids=["header", "second", "inside", "last"])
def test_a_damaged_card_is_read_as_far_as_it_goes_and_stays_as_it_is(base: Base, page: int) -> None:
    fill(base, 400)
    content = bytearray(base.path.read_bytes())
    pages = len(content) // PAGE_BYTES
    at = page % pages * PAGE_BYTES
    content[at : at + PAGE_BYTES] = bytes(PAGE_BYTES)
    base.path.write_bytes(content)
    with Archive(base.path, now=lambda: base.wall) as archive:
        read = [entry.id.sequence for entry in archive.entries()]
        assert len(read) == len(set(read)) >= 400 - PAGE_BYTES // 60
        assert archive.remarks or len(read) == 400
        # The second page has the notes of the clock. Without them no date is known.
        assert all(entry.dated is (page != 1) for entry in archive.entries())
        assert page == 1 or all(entry.utc <= base.wall for entry in archive.entries())
    assert base.path.read_bytes() == content


def test_one_row_of_a_wrong_type_is_one_row(base: Base) -> None:
    fill(base, 10)
    with closing(sqlite3.connect(base.path)) as connection:
        connection.execute("PRAGMA ignore_check_constraints = ON")
        connection.execute("UPDATE datum SET hops = 'many' WHERE sequence = 4")
        connection.commit()
    with Archive(base.path) as archive:
        assert [entry.id.sequence for entry in archive.entries()] == [0, 1, 2, 3, 5, 6, 7, 8, 9]
        assert archive.remarks == [f"{base.path}: 1 damaged rows skipped"]


def test_a_damaged_row_at_the_end_is_told_once_to_who_follows(base: Base) -> None:
    fill(base, 3)
    with closing(sqlite3.connect(base.path)) as connection:
        connection.execute("PRAGMA ignore_check_constraints = ON")
        connection.execute("UPDATE datum SET hops = 'many' WHERE sequence = 2")
        connection.commit()
    with Archive(base.path) as archive:
        _, last = archive.entries()
        for _ in range(3):
            archive.renew()
            assert list(archive.arrivals(last.arrival)) == []
        assert archive.remarks == [f"{base.path}: 1 damaged rows skipped"]


def test_a_card_that_cannot_be_written_is_read_with_its_log(base: Base, tmp_path: Path) -> None:
    card = tmp_path / "card"
    card.mkdir()
    base.arrive(base.datum(7, 0, Kind.BYTES, b"one"))
    for ending in ("", "-wal"):
        shutil.copy(f"{base.path}{ending}", card / f"base.db{ending}")
        (card / f"base.db{ending}").chmod(0o444)
    card.chmod(0o555)
    with ordinary_user(tmp_path), Archive(card / "base.db") as archive:
        assert [archive.datum(e.name).payload for e in archive.entries()] == [b"one"]
    card.chmod(0o755)
    assert sorted(file.name for file in card.iterdir()) == ["base.db", "base.db-wal"]


@pytest.mark.parametrize("content", [b"", b"rubbish" * 1000], ids=["empty", "rubbish"])
def test_what_is_no_store_is_an_error(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "notes.txt").write_bytes(content)
    with pytest.raises(StoreError, match=r"notes\.txt"):
        Archive.of(str(tmp_path / "notes.txt"))
    with pytest.raises(ConfigError, match="no such store"):
        Archive.of(str(tmp_path / "nothing.db"))
    assert (tmp_path / "notes.txt").read_bytes() == content


@pytest.mark.parametrize("folder", ["", ".", "/", "store"])
def test_a_folder_is_no_store(folder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An empty name is the present folder: a shell's variable was not set."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "store").mkdir()
    with pytest.raises(ConfigError, match="is a folder, not a store"):
        Archive.of(folder)


def test_a_configuration_names_its_store(base: Base, tmp_path: Path) -> None:
    base.arrive(base.datum(7, 0, Kind.BYTES, b"one"))
    (tmp_path / "base.yaml").write_text(f"node: {{id: 1, role: base}}\nstore: {{path: {base.path}}}\n")
    with Archive.of(str(tmp_path / "base.yaml")) as archive:
        assert len(list(archive.entries())) == 1


def test_losses_are_told(base: Base) -> None:
    lost = base.datum(7, 3, Kind.BYTES, b"x").id
    base.store.lose(lost, Fate.OVERFLOW)
    base.arrive(base.datum(7, 0, Kind.BYTES, b"one"))
    with Archive(base.path) as archive:
        assert archive.losses() == [(lost, Fate.OVERFLOW)]


@pytest.mark.parametrize(
    ("filter", "expected"),
    [
        (Filter(), [0, 1, 2, 3, 4]),
        (Filter(drones={8}), [3, 4]),
        (Filter(kinds={"file"}), [4]),
        (Filter(since=WALL_S - 25.0), [2, 3, 4]),
        (Filter(until=WALL_S - 25.0), [0, 1]),
        (Filter(since=WALL_S - 35.0, until=WALL_S - 25.0), [1]),
        (Filter(above=1.0), [2]),
        (Filter(box=(47.0, 8.0, 48.0, 9.0)), [0, 2]),
        (Filter(box=(-20.0, 170.0, -10.0, -170.0)), [1]),
        (Filter(drones={7}, above=0.0, box=(47.0, 8.0, 48.0, 9.0)), [0, 2]),
    ],
)
def test_a_filter_admits_what_was_asked_for(base: Base, filter: Filter, expected: list[int]) -> None:
    fiji = HERE._replace(latitude=-17.0, longitude=179.9)
    base.arrive(
        base.measurement(7, 0, HERE, age_s=40.0),
        base.measurement(7, 1, fiji, age_s=30.0),
        base.measurement(7, 2, HERE._replace(reading=9.0), age_s=20.0),
        base.measurement(8, 3, HERE._replace(latitude=None, longitude=None, reading=None)),
        base.file(8, 4, "a", b"b"),
    )
    with Archive(base.path, now=lambda: base.wall) as archive:
        assert [entry.id.sequence for entry in archive.entries(filter)] == expected

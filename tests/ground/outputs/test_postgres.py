"""Several bases and one database."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from itertools import count
from pathlib import Path

import pytest

from rass_mav.app.outlets import PostgresSection
from rass_mav.app.payloads import pack_file
from rass_mav.core.datum import Datum, DatumId, Fate, Kind
from rass_mav.errors import ConfigError, StoreError
from rass_mav.ground.archive import Archive
from rass_mav.ground.entry import Entry, Filter, Opens
from rass_mav.ground.page.model import Mission
from rass_mav.ground.report import Report
from rass_mav.store.sqlite import SqliteStore
from tests.app.app_nodes import RunningNode, Tidy, command
from tests.ground.mission_stores import NOW, measured, mission, put, stored
from tests.ground.sealed_data import OPENS, PHOTO, sealed
from tests.patience import PATIENCE_S
from tests.store.store_helpers import commit

from .beside import Until, report
from .databases import Server, psycopg, rows, server

# After `databases`, which skips the file where the package is missing.
from rass_mav.ground.outputs.database_writer import DatabaseWriter  # isort: skip
from rass_mav.ground.database import Database  # isort: skip
from rass_mav.ground.tables import shown, split_url  # isort: skip

NAMES = count()


@pytest.fixture(scope="module")
def shared() -> Iterator[Server]:
    with server() as made:
        yield made


@pytest.fixture
def url(shared: Server) -> str:
    """An empty database."""
    return shared.create(f"rass{next(NAMES)}")


def post(url: str, path: Path, base: int = 1, mission: str = "m", opens: Opens | None = None) -> DatabaseWriter:
    """Write all that a store holds."""
    poster = DatabaseWriter(PostgresSection(dsn=url, mission=mission), path, base, opens)
    # Once told to end, it writes what is left.
    poster.run(Until(lambda: poster.report()["connected"] or bool(poster.report()["trouble"])))
    return poster


def alike(entry: Entry) -> Entry:
    """Without what a database cannot know."""
    return entry._replace(arrival=0, age_s=0.0, arrived=None)


# -- real bases --------------------------------------------------------------------------------------------------------


def ids_in(url: str) -> list[str]:
    with Database(url) as database:
        return [entry.name for entry in database.entries()]


@pytest.mark.no_cover
def test_nothing_is_lost_or_written_twice_whoever_is_killed(tmp_path: Path, tidy: Tidy) -> None:
    with server() as postgres:
        url = postgres.create("rass")
        section = {"dsn": url, "mission": "2026-11-22"}
        bases = [tidy(RunningNode(tmp_path, id, node={"role": "base"}, postgres=section)).start() for id in (1, 2)]
        sent: set[str] = set()

        def put(datums: int) -> None:
            for base in bases:
                sent.update(str(base.ask("put", payload=b"%d" % number)["id"]) for number in range(datums))

        def everything() -> bool:
            try:
                return set(ids_in(url)) == sent
            except StoreError:
                return False

        put(20)
        bases[0].until(everything)
        # The database is away for a while, and a base is killed meanwhile.
        postgres.stop()
        put(10)
        for base in bases:
            base.until(lambda base=base: report(base, "postgres").get("behind") == 10)  # type: ignore[misc]
        said = command(tmp_path, "status", "n1.yaml").stdout.decode()
        assert "postgres: not connected, 20 data written, 10 pending" in said
        assert "WARNING: postgres: postgresql:///rass: " in said
        steps = bases[1].status()["steps"]
        bases[1].until(lambda: bases[1].status()["steps"] > steps + 5)
        bases[0].signal(signal.SIGKILL)
        bases[0].start()
        postgres.start()
        put(10)
        bases[0].until(everything)
        # Each is killed while there is something to write.
        put(10)
        postgres.kill()
        put(10)
        bases[1].signal(signal.SIGKILL)
        postgres.start()
        bases[1].start()
        put(10)
        bases[0].until(everything)
        bases[1].until(lambda: [report(base, "postgres").get("behind") for base in bases] == [0, 0])
        assert "working again" in bases[0].log()
        found = ids_in(url)
        assert len(found) == len(set(found)) == len(sent) == 2 * 70
        per_base = "SELECT base, count(*), count(DISTINCT datum) FROM rass.arrival GROUP BY base ORDER BY base"
        assert rows(url, per_base) == [(1, 70, 70), (2, 70, 70)]
        assert all(number == 70 for _, number in rows(url, "SELECT origin, count(*) FROM rass.datum GROUP BY origin"))
        # What is put just before a stop is written before the end.
        put(1)
        for base in bases:
            assert base.signal(signal.SIGTERM) == 0
        assert set(ids_in(url)) == sent


# -- without nodes -----------------------------------------------------------------------------------------------------


def test_a_database_reads_like_the_store(tmp_path: Path, url: str) -> None:
    path = stored(tmp_path / "base.db", mission())
    poster = post(url, path)
    assert poster.report() == {"connected": False, "posted": len(mission()) - 1, "behind": 0, "trouble": None}
    with Archive(path, lambda: NOW) as archive, Database(url, lambda: NOW) as database:
        # A damaged copy is not written: a sound one may still come.
        sound = [entry for entry in archive.entries() if "corrupt" not in entry.malformed]
        found = list(database.entries())
        assert [alike(entry) for entry in found] == [alike(entry) for entry in sound]
        assert [entry.age_s for entry in found] == pytest.approx([entry.age_s for entry in sound], abs=1e-3)
        assert database.count() == len(sound)
        for entry in sound:
            assert database.datum(entry.name).payload == archive.datum(entry.name).payload
            assert alike(database.entry(entry.name)) == alike(entry)
        hot = Filter(above=3.0)
        assert [e.name for e in database.entries(hot)] == [e.name for e in sound if hot.admits(e)]
        assert list(database.arrivals(found[-1].arrival)) == []
        with pytest.raises(StoreError, match="99-0123abcd-1: not in postgresql://"):
            database.datum("99-0123abcd-1")
    # Twice the same: nothing changes.
    post(url, path)
    assert rows(url, "SELECT count(*) FROM rass.datum") == [(len(sound),)]


def test_of_sealed_data_a_database_has_what_its_columns_say_and_the_contents_stay_sealed(
    tmp_path: Path, url: str
) -> None:
    data = [sealed(measured(0)), sealed(put(1, Kind.FILE, pack_file("photo.jpg", PHOTO)))]
    path = stored(tmp_path / "base.db", data)
    post(url, path, opens=OPENS)
    found = rows(url, "SELECT sequence, kind, payload, reading, unit, ST_Y(place::geometry) FROM rass.datum")
    assert [row[:3] for row in found] == [(datum.id.sequence, datum.kind, datum.payload) for datum in data]
    assert [row[3:] for row in found] == [(0.75, "usvh", 47.5), (None, None, None)]
    photo = str(data[1].id)
    with Database(url, lambda: NOW, opens=OPENS) as database, Archive(path, lambda: NOW, opens=OPENS) as archive:
        assert [alike(entry) for entry in database.entries()] == [alike(entry) for entry in archive.entries()]
        assert database.entry(photo).file == "photo.jpg"
        assert database.payload(photo) == archive.payload(photo) == pack_file("photo.jpg", PHOTO)
    with Database(url, lambda: NOW) as database:
        assert [entry.kind_name for entry in database.entries()] == ["sealed", "sealed"]
        with pytest.raises(StoreError, match="sealed; give the ground's keys"):
            database.payload(photo)


def test_the_commands_take_a_database(tmp_path: Path, url: str) -> None:
    path = stored(tmp_path / "base.db", [measured(n) for n in range(5)])
    post(url, path, mission="2026-11-22")
    listed = json.loads(command(tmp_path, "ls", url, "--json").stdout)["data"]
    assert [found["id"] for found in listed] == [f"7-0123abcd-{n}" for n in range(5)]
    report = json.loads(command(tmp_path, "report", url, "--json").stdout)
    assert (report["created"], report["arrived"], report["missing"]) == (5, 5, 0)
    done = command(tmp_path, "export", url, "--format", "geojson", "--json")
    assert json.loads(done.stdout)["out"] == "2026-11-22.geojson"
    assert len(json.loads((tmp_path / "2026-11-22.geojson").read_text())["features"]) == 5
    assert command(tmp_path, "get", "-c", url, "7-0123abcd-3").stdout == measured(3).payload


def test_measurements_are_points_on_earth(tmp_path: Path, url: str) -> None:
    here, nowhere = measured(0), measured(1, latitude=120.0, longitude=8.0)
    post(url, stored(tmp_path / "base.db", [here, nowhere, put(2, Kind.BYTES, b"text")]))
    near = "ST_DWithin(place, 'POINT(8.25 47.5)'::geography, 1)"
    assert rows(url, f"SELECT sequence, reading, unit FROM rass.datum WHERE {near}") == [(0, 0.75, "usvh")]
    assert rows(url, "SELECT count(place) FROM rass.datum") == [(1,)]


def arrived(path: Path, node: int, data: list[Datum], losses: dict[DatumId, Fate]) -> Path:
    with SqliteStore.open(path, node_id=node, draw_epoch=iter((node, 0xAB)).__next__) as store:
        for datum in data:
            store.put(datum) if store.get(datum.id) is None else store.keep_apart(datum)
        for id, fate in losses.items():
            store.lose(id, fate)
        assert commit(store)
    return path


def test_what_came_to_two_bases_is_one_datum_and_two_contents_stay_two(tmp_path: Path, url: str) -> None:
    first, second, other = put(0, Kind.BYTES, b"a"), put(1, Kind.BYTES, b"b"), put(1, Kind.BYTES, b"another")
    lost = DatumId(7, first.id.epoch, 5)
    post(url, arrived(tmp_path / "1.db", 1, [first, second], {lost: Fate.CORRUPTED}), 1)
    post(url, arrived(tmp_path / "2.db", 2, [other, first, second], {lost: Fate.CORRUPTED}), 2)
    who_has_it = (
        "SELECT sequence, apart, array_agg(base ORDER BY base) FROM rass.datum JOIN rass.arrival ON datum = number "
        "GROUP BY sequence, apart ORDER BY sequence, apart"
    )
    assert rows(url, who_has_it) == [(0, False, [1, 2]), (1, False, [1, 2]), (1, True, [2])]
    with Database(url) as database:
        assert [entry.name for entry in database.entries()] == [
            str(first.id), str(second.id), f"{other.id}#{other.crc:08x}",
        ]  # fmt: skip
        [apart] = database.arrivals(0, apart=True)
        assert apart.name == f"{other.id}#{other.crc:08x}"
        assert list(database.arrivals(apart.arrival, apart=True)) == []
        assert database.datum(f"{other.id}#{other.crc:08x}").payload == b"another"
        assert database.losses() == [(lost, Fate.CORRUPTED)]
        report = Report.of(database).plain(NOW)
        assert (report["arrived"], report["lost"], report["apart"], report["missing"]) == (2, 1, 1, 3)


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "1e308"])
def test_times_that_are_none_are_unknown(number: str, tmp_path: Path, url: str) -> None:
    post(url, stored(tmp_path / "one.db", [measured(0), measured(1)]))
    with psycopg.connect(url) as connection:
        # As somebody may have written them who can write to the database.
        connection.execute(f"UPDATE rass.datum SET utc = '{number}', age_s = '{number}'")
        connection.execute("UPDATE rass.datum SET error_s = -utc")
        connection.execute(f"UPDATE rass.arrival SET utc = '{number}'")
    seen = Mission()
    with Database(url) as database:
        assert seen.take(database.entries()) == 2
        database.renew()
        report = Report.of(database).plain(NOW)
    for plain in (seen.snapshot(), seen.changes(), seen.at(NOW), seen.drone(7), report):
        json.dumps(plain, allow_nan=False)


_READER = """
import sys
from rass_mav.ground.database import Database

def peak():
    return next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmHWM:"))

with Database(sys.argv[1]) as database:
    few = sum(1 for _ in database.arrivals(19000))
    before = peak()
    database.renew()
    print(few, sum(1 for _ in database.entries()), peak() - before)
"""


def test_the_memory_to_read_it_does_not_grow_with_the_data(tmp_path: Path, url: str) -> None:
    post(url, stored(tmp_path / "one.db", [put(0, Kind.BYTES, bytes(256))]))
    with psycopg.connect(url) as connection:
        columns = "mission, origin, epoch, crc, apart, kind, hops, utc, at_least, age_s, payload"
        copies = f"SELECT n, {columns} FROM rass.datum, generate_series(1, 20000) n"
        connection.execute(f"INSERT INTO rass.datum (sequence, {columns}) {copies}")
    # In a process of its own, as it is the memory of libpq too.
    read = subprocess.run(
        [sys.executable, "-c", _READER, url], check=True, capture_output=True, text=True, timeout=PATIENCE_S,
    )  # fmt: skip
    few, many, more_kib = map(int, read.stdout.split())
    assert 900 < few < 1100
    assert many == 20_001
    # In one answer of the server they would be 19 MiB.
    assert more_kib < 2048


def test_the_page_follows_a_database(tmp_path: Path, url: str) -> None:
    pytest.importorskip("aiohttp", reason="aiohttp is not installed (extra ground)")
    from rass_mav.ground.page.follow import Follower

    post(url, stored(tmp_path / "1.db", [measured(0), measured(1)]), 1)
    follower = Follower(lambda: Database(url), keep=True)
    assert follower.look()
    assert (follower.name, follower.mission.taken) == ("m", 2)
    assert not follower.look()
    post(url, stored(tmp_path / "2.db", [measured(1), measured(2)]), 2)
    assert follower.look()
    assert (follower.mission.taken, follower.mission.report.drones[7].arrived) == (3, 3)
    # The server ends the connection, and another one is made.
    rows(url, "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE pid <> pg_backend_pid()")
    assert follower.look()
    assert follower.trouble
    assert follower.look()
    assert (follower.trouble, follower.mission.taken) == ("", 3)
    follower.close()


def test_missions_do_not_mix_and_one_has_to_be_chosen(tmp_path: Path, url: str) -> None:
    path = stored(tmp_path / "base.db", [measured(0)])
    post(url, path, mission="one")
    post(url, path, mission="two/2")
    with pytest.raises(ConfigError, match=r"expected \?mission= and one of one, two/2"):
        Database(url)
    with Database(f"{url}&mission=two/2") as database:
        assert database.path == Path("two_2")
        assert database.count() == 1


def test_a_role_that_may_only_read_is_enough(tmp_path: Path, url: str, shared: Server) -> None:
    post(url, stored(tmp_path / "base.db", [measured(0)]))
    name = url.partition("?")[0].rpartition("/")[2]
    import psycopg

    with psycopg.connect(url) as connection:
        connection.execute(
            "CREATE ROLE rass_reader LOGIN; GRANT USAGE ON SCHEMA rass TO rass_reader; "
            "GRANT SELECT ON ALL TABLES IN SCHEMA rass TO rass_reader"
        )
    with Database(shared.url(name, user="rass_reader")) as database:
        assert database.count() == 1


def test_what_is_no_database_of_ours_is_said_in_one_line(url: str, tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="this database contains no rass-mav data"):
        Database(url)
    path = stored(tmp_path / "base.db", [measured(0)])
    post(url, path)
    rows(url, "SELECT 1")
    import psycopg

    with psycopg.connect(url) as connection:
        connection.execute("UPDATE rass.version SET version = 99")
    assert "version 99, and this program knows version 1" in post(url, path).report()["trouble"]
    done = command(tmp_path, "ls", url)
    assert (done.returncode, len(done.stderr.splitlines())) == (1, 1)
    done = command(tmp_path, "ls", "postgresql://someone:secret@/rass?host=/nowhere")
    assert (done.returncode, len(done.stderr.splitlines()), b"secret" in done.stderr) == (1, 1, False)


def test_urls() -> None:
    assert split_url("postgresql:///rass?host=/a%20b&mission=2026-11-22") == (
        "postgresql:///rass?host=%2Fa%20b", "2026-11-22",
    )  # fmt: skip
    assert split_url("postgresql://u:p@h:5/rass") == ("postgresql://u:p@h:5/rass", None)
    assert shown("postgresql://u:p@h:5/rass?password=x") == "postgresql://h:5/rass"


def test_a_missing_package_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rass_mav.ground.database", None)
    done = command(tmp_path, "ls", "postgresql:///rass")
    assert b"needs the Python package psycopg: pip install -e '.[postgres]'" in done.stderr

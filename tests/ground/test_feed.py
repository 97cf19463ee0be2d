"""Following what arrives: nothing is missed, whatever becomes of the store meanwhile."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from rass_mav.core.datum import Kind
from rass_mav.ground.archive import Archive
from rass_mav.ground.feed import Cursor, Feed
from rass_mav.ground.page.follow import Follower
from tests.app.app_nodes import RunningNode, Tidy, said_by

from .missions import HERE, Base


@pytest.fixture
def base(tmp_path: Path) -> Iterator[Base]:
    base = Base(tmp_path / "rass-1.db")
    base.arrive(base.measurement(7, 0, HERE), base.measurement(7, 1, HERE))
    yield base
    base.close()


def names(feed: Feed, cursor: Cursor | None) -> tuple[list[str], Cursor, bool]:
    """What has arrived behind a cursor, the cursor behind that, and whether it begins again."""
    with feed.look(cursor) as look:
        found = list(look.arrivals())
        return [entry.name for entry, _ in found], found[-1][1] if found else look.start, look.restarted


def test_reading_goes_on_behind_a_cursor_that_was_kept(base: Base) -> None:
    first, cursor, _ = names(Feed(lambda: Archive(base.path)), None)
    assert len(first) == 2
    other = base.measurement(7, 0, HERE._replace(reading=9.0))
    assert base.store.keep_apart(other)
    new = base.datum(8, 0, Kind.BYTES, bytes(5000))
    base.arrive(new)
    # In another process, as far as the feed knows.
    feed = Feed(lambda: Archive(base.path))
    with feed.look(cursor) as look:
        (datum, behind_it), (second, end) = look.arrivals()
        assert (look.behind(cursor), look.behind(behind_it), look.restarted) == (1, 0, False)
        assert look.data.payload(datum.name) == bytes(5000)
    assert (datum.name, second.name) == (str(new.id), f"{other.id}#{other.crc:08x}")
    assert names(feed, behind_it)[0] == [second.name]
    assert names(feed, end) == ([], end, False)


@pytest.mark.parametrize("keep", [False, True])
@pytest.mark.parametrize("end", [Base.damage, Base.lose_mark])
def test_it_begins_again_where_a_store_was_replaced_or_has_a_new_epoch(
    base: Base, keep: bool, end: Callable[[Base], None]
) -> None:
    feed = Feed(lambda: Archive(base.path), keep=keep)
    before, cursor, _ = names(feed, None)
    end(base)
    salvaged, cursor, _ = names(feed, cursor)
    assert salvaged in ([], before)
    base.start()
    new = base.datum(8, 0, Kind.BYTES, bytes(5000))
    base.arrive(new)
    again, cursor, restarted = names(feed, cursor)
    assert restarted
    assert set(again) == {*before, str(new.id)}
    assert names(feed, cursor) == ([], cursor, False)
    feed.close()


@pytest.mark.no_cover
def test_ls_shows_each_datum_once_also_if_the_base_is_killed(tmp_path: Path, tidy: Tidy) -> None:
    node = tidy(RunningNode(tmp_path, 1, node={"role": "base"})).start()
    put = [str(node.ask("put", payload=b"%d" % number)["id"]) for number in range(5)]
    with said_by(tmp_path, "ls", "n1.yaml", "--follow", "--json", "--kind", "bytes") as lines:
        shown = [json.loads(next(lines))["id"] for _ in range(5)]
        put += [str(node.ask("put", payload=b"more %d" % number)["id"]) for number in range(5)]
        node.signal(signal.SIGKILL)
        node.start()
        put.append(str(node.ask("put", payload=b"after that")["id"]))
        shown += [json.loads(next(lines))["id"] for _ in range(6)]
    assert shown == put


def test_ls_follows_a_store_that_was_damaged_and_replaced(base: Base) -> None:
    with said_by(base.path.parent, "ls", "rass-1.db", "--follow", "--json") as lines:
        before = [json.loads(next(lines))["id"] for _ in range(2)]
        base.damage()
        base.start()
        new = base.datum(8, 0, Kind.BYTES, b"after the damage")
        base.arrive(new)
        again = [json.loads(next(lines))["id"] for _ in range(3)]
    assert set(again) == {*before, str(new.id)}


def test_the_page_follows_a_store_that_was_damaged_and_replaced(base: Base) -> None:
    follower = Follower(lambda: Archive(base.path))
    follower.look()
    base.damage()
    base.start()
    base.arrive(base.measurement(8, 0, HERE))
    while follower.look():
        pass
    assert 8 in follower.mission.report.drones
    assert follower.mission.report.drones[7].kinds == {"measurement": 2}
    follower.close()


def test_ls_shows_second_contents_whenever_they_come(base: Base) -> None:
    with said_by(base.path.parent, "ls", "rass-1.db", "--follow", "--json") as lines:
        for _ in range(2):
            next(lines)
        other = base.measurement(7, 0, HERE._replace(reading=9.0))
        assert base.store.keep_apart(other)
        base.arrive()
        base.wall += 5.0
        base.arrive(base.measurement(9, 0, HERE))
        shown = [json.loads(next(lines)) for _ in range(2)]
    assert {found["id"] for found in shown} == {f"{other.id}#{other.crc:08x}", f"9-{other.id.epoch:08x}-0"}

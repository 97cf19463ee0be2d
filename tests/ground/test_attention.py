"""What needs attention: the conditions that data show, since when, and what of them stands first."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.app.clock import DateNote
from rass_mav.core.alarms import Alarm
from rass_mav.core.datum import DatumId, Fate, Kind
from rass_mav.ground import hotspots
from rass_mav.ground.archive import Archive
from rass_mav.ground.attention import watch as watches
from rass_mav.ground.attention.conditions import KINDS, MOST_ROWS, Condition, Level, marks, rows
from rass_mav.ground.attention.node import of_node
from rass_mav.ground.attention.rules import RuleBook
from rass_mav.ground.attention.watch import MOST_EVENTS, NEW_SPOT_S, Rules, Watch
from rass_mav.ground.entry import Entry
from rass_mav.ground.follow import Follower
from rass_mav.trust.keys.files import ground_text, write_new, write_over
from rass_mav.wire.measurement import Measurement
from rass_mav.wire.nodestatus import NodeStatus, encode_status
from tests.app.app_nodes import said_by
from tests.commands import json_output, output

from .missions import EPOCH, HERE, WALL_S, Base
from .sealed_data import GROUND, sealed

Capture = pytest.CaptureFixture[str]

T0 = WALL_S
QUIET = NodeStatus(0, 0, 0, None, 0.0, 1, None, (47.0, 8.0), {}, {})


class Flight:
    """Data that arrive, one after the other."""

    def __init__(self, rules: Rules | None = None) -> None:
        self.watch = Watch()
        self.watch.rules = Rules() if rules is None else rules
        self.entries: list[Entry] = []
        self._numbers: dict[int, int] = {}

    def entry(self, drone: int, at: float, *, late_s: float = 1.0, **more: Any) -> Entry:
        """One that was created `at` seconds after the start, and arrives `late_s` after that."""
        number = self._numbers.get(drone, -1) + 1
        self._numbers[drone] = number
        kind = Kind.STATUS if "status" in more else Kind.MEASUREMENT if "measurement" in more else Kind.BYTES
        more = {"at_least": False, **more}
        entry = Entry(
            len(self.entries), DatumId(drone, 1, number), 0, kind, 24, 1, T0 + at, 1.0, age_s=0.0,
            arrived=T0 + at + late_s, **more,
        )  # fmt: skip
        self.entries.append(entry)
        self.watch.take((entry,))
        return entry

    def status(self, drone: int, at: float, **fields: Any) -> None:
        self.entry(drone, at, status=QUIET._replace(**fields))

    def measure(self, drone: int, at: float, **fields: Any) -> None:
        self.entry(drone, at, measurement=HERE._replace(**fields))

    def hear(self, drone: int, times: range) -> None:
        for at in times:
            self.entry(drone, float(at))

    def skip(self, drone: int, count: int) -> None:
        """Data that it creates and that do not arrive."""
        self._numbers[drone] = self._numbers.get(drone, -1) + count

    def now(self, at: float) -> list[Condition]:
        return self.watch.conditions(T0 + at)

    def kinds(self, at: float, drone: int = 7) -> set[str]:
        return {one.kind for one in self.now(at) if one.drone == drone}

    def one(self, at: float, kind: str, drone: int = 7) -> Condition:
        [found] = [one for one in self.now(at) if (one.kind, one.drone) == (kind, drone)]
        return found


# -- the tired operator ------------------------------------------------------------------------------------------------


def mission_with_keys(folder: Path) -> Base:
    """A base and four drones with keys. Drone 3 has died; drone 5 is revoked, its store is full, and it is silent."""
    ground = replace(GROUND, number=2, serials=dict.fromkeys((2, 3, 4, 5), 1), revoked=frozenset((5,)))
    write_new(folder / "ground.keys", ground_text(ground))
    (folder / "base.yaml").write_text(
        "node: {id: 1, role: base}\nstore: {path: rass-1.db}\nkeys: {file: ground.keys}\n"
        "links: [{listen: '127.0.0.1:0', peers: [{address: '127.0.0.1:9'}]}]\n"
    )
    base = Base(folder / "rass-1.db")
    numbers = dict.fromkeys((1, 2, 3, 4, 5), 0)

    def arrive(origin: int, kind: int, payload: bytes) -> None:
        datum = base.datum(origin, numbers[origin], kind, payload)
        numbers[origin] += 1
        base.arrive(datum if origin == 1 else sealed(datum))

    measured = base.measurement(2, 0, HERE).payload
    for second in range(0, 2700, 20):
        alive = [id for id in (2, 3, 4, 5) if not (id == 3 and second > 300) and not (id == 5 and second > 760)]
        for id in alive:
            arrive(id, Kind.MEASUREMENT, measured)
            if second % 60 == 0:
                free = max(0, 180 - second // 4) if id == 5 else 5000
                said = QUIET._replace(free=free, link_key=2, held=3, alone=6 if id == 5 else 0, alone_by_origin={})
                arrive(id, Kind.STATUS, encode_status(said))
        if second % 60 == 0:
            arrive(1, Kind.STATUS, encode_status(QUIET._replace(base=True, link_key=2, place=None)))
        base.wall += 20.0
    return base


def test_the_first_screen_names_who_is_dead_and_who_is_revoked_and_full(
    tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    base = mission_with_keys(tmp_path)
    monkeypatch.setattr("time.time", lambda: base.wall)
    first = output(capsys, "report", "base.yaml").out.splitlines()[:10]
    assert [line.partition(". ")[0].partition("; ")[0] for line in first[:4]] == [
        "ALARM: drone 3: silent for 40 min",
        "ALARM: drone 5: silent for 32 min",
        "ALARM: drone 5: store full for 33 min",
        "WARNING: drone 5: revoked",
    ]
    assert "6 older data have no copy elsewhere" in first[1]
    assert "Other nodes refuse data from there" in first[3]
    sums = next(line for line in first if " created" in line)
    assert re.match(r"at least \d+ created, \d+ arrived, 0 missing, 0 lost", sums), sums

    plain = json_output(capsys, "report", "base.yaml")
    assert plain["created_at_least"] is True
    said = {(one["drone"], one["kind"], one["level"]) for one in plain["attention"]}
    assert said >= {(3, "silent", "alarm"), (5, "silent", "alarm"), (5, "full", "alarm"), (5, "revoked", "warning")}
    assert {drone["drone"]: drone["attention"] for drone in plain["drones"]} == {
        1: None, 2: None, 3: "alarm", 4: None, 5: "alarm",
    }  # fmt: skip
    html = tmp_path / "report.html"
    output(capsys, "report", "base.yaml", "--html", str(html))
    text = html.read_text(encoding="utf-8")
    assert 0 < text.find("drone 3: silent") < text.find("drone 5: revoked") < text.find("created at least")
    shown = output(capsys, "report", "base.yaml").out
    assert "if it fails now: 6 or more data lost, of those older than 33 min" in shown
    base.close()


def test_the_log_says_when_it_began(tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    base = mission_with_keys(tmp_path)
    monkeypatch.setattr("time.time", lambda: base.wall)
    lines = output(capsys, "report", "base.yaml", "--events").out.splitlines()
    assert lines == [
        "at an unknown time  WARNING: drone 5: revoked",
        "2026-11-22 10:02:00  WARNING: drone 5: store fills up",
        "2026-11-22 10:06:40  ALARM: drone 3: silent",
        "2026-11-22 10:12:00  over: drone 5: store fills up",
        "2026-11-22 10:12:00  ALARM: drone 5: store full",
        "2026-11-22 10:14:20  ALARM: drone 5: silent",
    ]  # fmt: skip
    events = json_output(capsys, "report", "base.yaml", "--events")["events"]
    assert events[-1]["kind"] == "silent"
    with said_by(tmp_path, "report", "base.yaml", "--events", "--follow", "--json") as followed:
        assert [json.loads(next(followed))["kind"] for _ in events] == [event["kind"] for event in events]
    base.close()


# -- each kind ---------------------------------------------------------------------------------------------------------


class TestSilent:
    def test_longer_than_what_is_usual_for_this_drone(self) -> None:
        flight = Flight()
        flight.hear(7, range(0, 100))
        assert "silent" not in flight.kinds(99 + 59)
        assert flight.one(99 + 61, "silent").since == T0 + 99
        flight.hear(8, range(0, 6000, 300))
        last = 5700.0
        assert "silent" not in flight.kinds(last + 4 * 301, 8)
        assert "silent" in flight.kinds(last + 5 * 301 + 1, 8)

    def test_before_anything_is_usual_it_takes_three_minutes(self) -> None:
        flight = Flight()
        flight.entry(7, 0.0)
        assert flight.kinds(179) == set()
        assert flight.kinds(181) == {"silent"}

    def test_it_is_over_when_something_newer_comes_and_not_before(self) -> None:
        flight = Flight()
        flight.hear(7, range(0, 50))
        assert "silent" in flight.kinds(500)
        flight.entry(7, 20.0, late_s=490.0)
        assert "silent" in flight.kinds(511), "old data that others bring say nothing of it"
        flight.entry(7, 512.0)
        assert flight.kinds(514) == set()
        assert [(event.begins, event.kind) for event in flight.watch.events()] == [(True, "silent"), (False, "silent")]

    def test_bases_are_not_drones(self) -> None:
        flight = Flight()
        flight.status(1, 0.0, base=True)
        flight.entry(7, 0.0)
        assert [one.drone for one in flight.now(400)] == [7]

    def test_nothing_is_known_of_drones_that_only_others_hear(self) -> None:
        flight = Flight()
        flight.status(7, 0.0, neighbours={9: 0.5})
        found = flight.one(5, "unheard", 9)
        assert (found.level, found.detail) == (Level.WARNING, "last drone 7")

    def test_a_drone_without_a_route_names_the_base_that_it_hears(self) -> None:
        """Its base has just been started again, and has said nothing of itself yet."""
        flight = Flight(Rules(base=(1, None)))
        flight.status(7, 0.0, neighbours={1: 0.5}, hops=None)
        assert not flight.kinds(5, 1)


class TestStore:
    def test_it_fills_up_at_the_present_rate_and_is_full(self) -> None:
        flight = Flight()
        for minute in range(5):
            flight.status(7, 60.0 * minute, free=100 - 4 * minute)
        assert flight.one(241, "filling").detail == "84 more data fit, full in about 21 min"
        assert flight.one(241, "filling").level is Level.WARNING
        assert flight.one(241 + 22 * 60, "filling").detail.endswith("by now it is probably full")
        flight.status(7, 300.0, free=0)
        assert flight.kinds(301) == {"full"}
        assert (flight.one(301, "full").level, flight.one(400, "full").since) == (Level.ALARM, T0 + 300)
        flight.status(7, 360.0, free=50)
        assert "full" not in flight.kinds(361)

    @pytest.mark.parametrize("free", [[100] * 5, [100, 101, 102, 103], [5000, 4999, 4998], [None] * 4])
    def test_one_that_does_not_fill_up_soon_is_no_condition(self, free: list[int | None]) -> None:
        flight = Flight()
        for minute, count in enumerate(free):
            flight.status(7, 60.0 * minute, free=count)
        assert flight.kinds(60.0 * len(free)) == set()


class TestSenses:
    def test_a_position_that_is_lost_and_found(self) -> None:
        flight = Flight()
        flight.measure(7, 0.0)
        flight.measure(7, 10.0, latitude=None, longitude=None)
        flight.measure(7, 20.0, latitude=None, longitude=None)
        assert flight.one(21, "position").since == T0 + 10
        flight.measure(7, 30.0, latitude=None, longitude=None, local=(1.0, 2.0, 3.0))
        assert flight.kinds(31) == set()

    def test_a_place_that_a_program_stated_is_no_position_of_the_vehicle(self) -> None:
        flight = Flight()
        flight.measure(7, 0.0, error_m=None)
        flight.measure(7, 10.0, latitude=None, longitude=None)
        assert flight.kinds(11) == set()
        flight.status(7, 20.0)
        flight.measure(7, 30.0, latitude=None, longitude=None)
        flight.measure(7, 40.0, error_m=None)
        assert flight.one(41, "position").since == T0 + 30

    def test_one_that_never_had_any_has_lost_none(self) -> None:
        flight = Flight()
        flight.measure(7, 0.0, latitude=None, longitude=None)
        flight.measure(7, 5.0, reading=None, latitude=None, longitude=None)
        assert flight.kinds(6) == {"sensor"}
        assert Flight().now(0)[0].kind == "nothing"

    def test_readings_that_stop(self) -> None:
        flight = Flight()
        flight.measure(7, 0.0)
        flight.measure(7, 10.0, reading=None)
        assert flight.one(11, "sensor").since == T0 + 10
        flight.measure(7, 20.0)
        assert flight.kinds(21) == set()

    def test_measurements_that_stop_while_statuses_go_on(self) -> None:
        flight = Flight()
        for at in range(0, 100, 10):
            flight.measure(7, float(at))
        for at in range(100, 200, 60):
            flight.status(7, float(at))
        assert flight.one(161, "sensor").since == T0 + 90

    def test_measurements_on_their_way_have_not_stopped(self) -> None:
        flight = Flight()
        for at in range(0, 100, 10):
            flight.measure(7, float(at))
        flight.skip(7, 6)
        flight.status(7, 160.0)
        assert flight.kinds(161) == set()


class TestReadings:
    def test_above_the_threshold(self) -> None:
        flight = Flight(Rules(above=100.0))
        flight.measure(7, 0.0, reading=99.0, risk=1.0)
        assert flight.kinds(1) == set()
        flight.measure(7, 5.0, reading=120.0)
        found = flight.one(6, "reading")
        assert (found.detail, found.since) == ("120 uSv/h at 47.376900, 8.541700", T0 + 5)
        flight.measure(7, 10.0, reading=20.0)
        assert flight.kinds(11) == {"hot spot"}

    def test_without_one_the_drones_own_scale_counts_and_an_unknown_reading_does_not(self) -> None:
        flight = Flight()
        flight.measure(7, 0.0, reading=3.0, risk=1.0)
        flight.measure(8, 0.0, reading=None, risk=1.0)
        assert (flight.kinds(1), flight.kinds(1, 8)) == ({"reading", "hot spot"}, set())

    def test_a_hot_spot_is_new_where_no_other_is_near_and_for_a_while(self) -> None:
        flight = Flight(Rules(above=1.0))
        step = 50.0 / 111_320.0
        for number in range(8):
            flight.measure(7, float(number), reading=5.0, latitude=47.0 + number * step)
        spots = [event for event in flight.watch.events() if event.kind == "hot spot"]
        assert [event.text for event in spots] == ["new hot spot: 47.000000, 8.541700, 5 uSv/h"], "it is one region"
        flight.measure(8, 20.0, reading=5.0, latitude=47.05)
        assert flight.one(21, "hot spot", 8).since == T0 + 21
        flight.hear(8, range(25, 700, 5))
        assert "hot spot" not in flight.kinds(22 + NEW_SPOT_S, 8)

    def test_one_drone_cannot_fill_the_map_of_hot_spots(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(hotspots, "MOST_CELLS", 3)
        flight = Flight(Rules(above=1.0))
        for number in range(10):
            flight.measure(7, float(number), reading=5.0, latitude=40.0 + number)
        flight.measure(8, 20.0, reading=5.0, latitude=10.0)
        assert "hot spot" in flight.kinds(21, 8)


class TestKeysAndWays:
    def test_no_route(self) -> None:
        flight = Flight()
        flight.status(7, 0.0, hops=None)
        flight.status(7, 60.0, hops=None)
        assert flight.one(61, "no route").since == T0
        flight.status(7, 120.0, hops=2)
        assert flight.kinds(121) == set()

    def test_what_it_created_since_has_found_one(self) -> None:
        """Of what waited for a route, the status that tells of none may be the newest for a while, or arrive late."""
        flight = Flight()
        flight.measure(7, 0.0)
        flight.entry(7, 60.0, late_s=40.0, status=QUIET._replace(hops=None))
        flight.entry(7, 50.0, late_s=51.0)
        assert flight.kinds(102) == {"no route"}, "nothing newer has arrived"
        flight.entry(7, 100.0, late_s=3.0)
        assert flight.kinds(104) == set()
        flight.entry(7, 90.0, late_s=15.0, status=QUIET._replace(hops=None))
        assert flight.kinds(106) == set(), "older than what has arrived"
        events = [(event.begins, event.utc) for event in flight.watch.events() if event.kind == "no route"]
        assert events == [(True, T0 + 100), (False, T0 + 103)]

    def test_a_link_key_that_is_behind_after_some_time(self) -> None:
        flight = Flight()
        flight.status(1, 0.0, base=True, link_key=1)
        flight.status(7, 10.0, link_key=1)
        flight.status(1, 60.0, base=True, link_key=2)
        flight.status(7, 70.0, link_key=1)
        assert flight.kinds(80) == set(), "it may still come"
        flight.status(7, 190.0, link_key=1)
        assert flight.one(191, "link key").detail == "1, the base has 2"
        flight.watch.rules = Rules(revoked=frozenset((7,)))
        flight.status(7, 250.0, link_key=1)
        assert flight.kinds(251) == {"revoked"}, "it gets none"

    def test_a_revoked_drone_until_it_is_replaced(self, tmp_path: Path) -> None:
        keys = tmp_path / "ground.keys"
        ground = replace(GROUND, revoked=frozenset((7,)))
        write_new(keys, ground_text(ground))
        rules = RuleBook(keys=str(keys))
        flight = Flight(rules.renewed())
        flight.entry(7, 0.0)
        assert flight.kinds(1) == {"revoked"}
        write_over(keys, ground_text(replace(ground, revoked=frozenset(), serials={7: 2, 8: 1})))
        flight.watch.rules = rules.renewed()
        assert flight.kinds(2) == set()
        keys.unlink()
        assert rules.renewed() == flight.watch.rules, "what was known stays known"

    def test_a_forwarder_with_which_data_vanish(self) -> None:
        flight = Flight()
        for minute in range(8):
            for drone in (7, 8):
                flight.skip(drone, 10 if drone == 7 else 0)
                flight.status(
                    drone, 60.0 * minute, held=2, neighbours={8: 1.0, 1: 1.0}, next_hop=8 if drone == 7 else 1
                )
        found = flight.one(430, "forwarder", 8)
        assert re.fullmatch(r"\d+ of drone 7", found.detail)
        assert flight.kinds(430) == set()
        flight.status(7, 480.0, neighbours={9: 1.0}, next_hop=9)
        assert flight.kinds(481, 8) == set()

    def test_one_that_says_that_it_has_them_is_not_suspected(self) -> None:
        flight = Flight()
        for minute in range(8):
            for drone in (7, 8):
                flight.skip(drone, 10 if drone == 7 else 0)
                held = 2 if drone == 7 else 10 * minute + 10
                flight.status(drone, 60.0 * minute, held=held, neighbours={8: 1.0}, next_hop=8 if drone == 7 else 1)
        assert "forwarder" not in flight.kinds(430, 8)


class TestData:
    def test_lower_bounds_of_ages(self) -> None:
        flight = Flight()
        flight.entry(7, 0.0, at_least=True)
        assert flight.one(1, "ages").level is Level.NOTE
        flight.entry(7, 5.0)
        assert flight.kinds(6) == set()

    def test_losses_with_their_reasons_until_the_data_arrive(self) -> None:
        flight = Flight()
        flight.entry(7, 0.0)
        lost = [
            (DatumId(7, 1, 1), Fate.CORRUPTED),
            (DatumId(7, 1, 2), Fate.CORRUPTED),
            (DatumId(7, 1, 9), Fate.EXPIRED),
        ]
        assert flight.watch.hear(lost, T0 + 30)
        assert not flight.watch.hear(lost, T0 + 31)
        found = flight.one(31, "lost")
        assert (found.detail, found.since) == ("2 corrupted, 1 expired", None)
        assert [event.utc for event in flight.watch.events()] == [T0 + 30]
        flight.entry(7, 40.0)
        assert flight.one(41, "lost").detail == "1 corrupted, 1 expired"

    def test_what_happened_to_its_store(self) -> None:
        flight = Flight()
        flight.watch.hear([(DatumId(7, 1, 1), Fate.UNKNOWN), (DatumId(7, 1, 2), Fate.DAMAGED)])
        assert flight.kinds(0) == {"unknown", "damaged", "unheard"}

    def test_two_contents(self) -> None:
        flight = Flight()
        flight.entry(7, 0.0)
        for number in range(2):
            flight.watch.take([flight.entries[0]._replace(apart=True, arrived=None, crc=number)])
        assert flight.one(1, "two contents").detail == "2 of them"

    def test_an_empty_store(self, base: Base, capsys: Capture) -> None:
        base.arrive()
        lines = output(capsys, "report", str(base.path)).out.splitlines()
        assert any(line.startswith("WARNING: no drone has been heard. ") for line in lines)
        assert "0 created, 0 arrived, 0 missing, 0 lost" in lines
        assert json_output(capsys, "report", str(base.path), "--events") == {"events": []}


# -- time --------------------------------------------------------------------------------------------------------------


class TestTime:
    def test_a_base_that_has_stopped_is_judged_as_of_then(self, base: Base) -> None:
        base.arrive(base.measurement(7, 0, HERE, age_s=10.0))
        with Archive(base.path, now=lambda: base.wall + 9e5) as archive:
            found = Watch.of(archive).conditions(base.wall + 9e5, archive.date)
        assert [(one.kind, one.detail) for one in found] == [("stopped", "last written 10 d ago")]

    def test_a_drone_not_heard_since_the_base_started_may_be_of_an_earlier_mission(self, base: Base) -> None:
        base.arrive(base.measurement(3, 0, HERE), base.measurement(7, 0, HERE))
        base.close()
        base.wall += 3 * 86400.0
        base.start()
        base.wall += 1200.0
        base.arrive(base.measurement(7, 1, HERE))
        with Archive(base.path, now=lambda: base.wall) as archive:
            [row] = Watch.of(archive).rows(base.wall, archive.date)
        assert row.text == (
            "drone 3: silent for 3 d; not heard since this base started 20 min ago (an earlier mission?)"
        )
        base.arrive(base.measurement(3, 1, HERE))
        base.wall += 3600.0
        base.arrive(base.measurement(7, 2, HERE))
        with Archive(base.path, now=lambda: base.wall) as archive:
            [row] = Watch.of(archive).rows(base.wall, archive.date)
        assert row.text == "drone 3: silent for 60 min"

    @pytest.mark.parametrize("wrong_s", [-9e8, 9e8])
    def test_where_the_date_is_not_known_the_stores_own_clock_counts(self, tmp_path: Path, wrong_s: float) -> None:
        base = Base(tmp_path / "base.db", trusted=False, wall=1000.0)
        base.arrive(base.measurement(7, 0, HERE))
        base.wall += 300.0
        base.arrive(base.measurement(8, 0, HERE, age_s=2.0))
        now = base.wall + wrong_s
        with Archive(base.path, now=lambda: now) as archive:
            found = Watch.of(archive).conditions(now, archive.date)
        assert {(one.kind, one.drone) for one in found} == {("clock", None), ("stopped", None), ("silent", 7)}
        assert rows(found, base.wall)[0].text == "drone 7: silent for 5 min"
        base.close()

    def test_nobody_is_silent_for_decades_when_the_base_learns_the_date(self, tmp_path: Path) -> None:
        state = {"wall": 1000.0, "trusted": False}
        from rass_mav.app.clock import LivedClock, TimeSources

        base = Base(tmp_path / "base.db")
        base.clock = LivedClock(
            base.store,
            TimeSources(lambda: 5000.0, lambda: 1, lambda: float(state["wall"]), lambda: bool(state["trusted"])),
        )
        base.arrive(base.measurement(7, 0, HERE))
        follower = Follower(lambda: Archive(base.path, now=lambda: float(state["wall"])), Watch)
        follower.look()
        assert follower.mission.report.drones[7].heard is not None
        assert follower.mission.report.drones[7].heard.utc < 2e3
        state.update(wall=T0, trusted=True)
        base.arrive(base.measurement(8, 0, HERE))
        follower.look()
        assert follower.begins
        assert {one.kind for one in follower.mission.conditions(T0, follower.date)} == set()
        assert sorted(follower.mission.report.drones) == [7, 8]
        follower.close()
        base.close()

    def test_a_clock_that_jumps_back_makes_no_negative_span(self) -> None:
        flight = Flight()
        flight.hear(7, range(0, 50))
        flight.now(500)
        [row] = rows(flight.now(-1e6), T0 - 1e6)
        assert row.text == "drone 7: silent for 0.0 s"

    def test_a_base_that_was_restarted_comes_to_the_same(self, base: Base) -> None:
        said = QUIET._replace(free=90)
        base.arrive(base.measurement(7, 0, HERE), base.datum(7, 1, Kind.STATUS, encode_status(said)))
        base.wall += 60.0
        base.arrive(base.datum(7, 2, Kind.STATUS, encode_status(said._replace(free=0))))
        base.store.lose(DatumId(7, EPOCH, 9), Fate.OVERFLOW)
        base.wall += 500.0
        base.arrive(base.measurement(8, 0, HERE))
        before = state(base)
        base.close()
        base.start()
        assert state(base) == before
        assert {one.kind for one in before[0]} == {"silent", "full", "lost"}
        follower = Follower(lambda: Archive(base.path, now=lambda: base.wall), Watch)
        while follower.behind:
            follower.look()
        assert follower.mission.conditions(base.wall, follower.date) == before[0]
        follower.close()


def state(base: Base) -> tuple[list[Condition], list[str]]:
    with Archive(base.path, now=lambda: base.wall) as archive:
        watch = Watch.of(archive)
        return watch.conditions(base.wall, archive.date), [event.line for event in watch.events()]


# -- the adversary -----------------------------------------------------------------------------------------------------

ids = st.sampled_from((0, 7, 8, 65535))
times = st.sampled_from((0.0, T0, T0 + 1, 1e300, -1e300)) | st.floats(-1e300, 1e300)
statuses = st.builds(
    NodeStatus, st.integers(0, 65535), st.integers(0, 65535), st.integers(0, 65535), st.none() | st.integers(0, 65534),
    st.floats(0, 1), st.none() | st.integers(0, 254), st.none() | st.integers(0, 100),
    st.none() | st.tuples(st.floats(-90, 90), st.floats(-180, 180)), st.dictionaries(ids, st.floats(0, 1)),
    st.dictionaries(ids, st.integers(0, 65535)), st.booleans(), st.none() | ids, st.none() | st.integers(0, 2**32 - 1),
)  # fmt: skip
measurements = st.builds(
    Measurement, st.none() | st.floats(), st.none() | st.floats(), st.just(0.0), st.none() | st.floats(),
    st.floats(0, 1), unit=st.none() | st.sampled_from(("usvh", "cpm")),
)  # fmt: skip
forged = st.builds(
    lambda origin, epoch, number, utc, late, content, apart, lower: Entry(
        0, DatumId(origin, epoch, number), 0, 0, 24, 1, utc, None, lower, 0.0,
        arrived=None if late is None else utc + late, apart=apart,
        status=content if isinstance(content, NodeStatus) else None,
        measurement=content if isinstance(content, Measurement) else None,
    ),
    ids, st.integers(0, 1), st.sampled_from((0, 1, 2, 2**32 - 1)), times,
    st.none() | st.sampled_from((0.0, 60.0, 1e300)), st.none() | statuses | measurements, st.booleans(), st.booleans(),
)  # fmt: skip


@given(st.lists(forged, max_size=12), times)
def test_whatever_drones_say_the_list_can_be_shown(come: list[Entry], now: float) -> None:
    watch = Watch()
    watch.take(come)
    plain = watch.plain(now)
    json.dumps(plain, allow_nan=False)
    json.dumps([event.plain() for event in watch.events()], allow_nan=False)
    for row in watch.rows(now):
        assert row.line.isascii()
        assert row.line.isprintable()
        assert not re.search(r"\b(nan|inf)\b", row.line)
    assert watch.conditions(now) == watch.conditions(now)


def test_however_many_drones_are_invented_the_list_is_short() -> None:
    flight = Flight()
    for drone in range(2000):
        flight.entry(drone, 0.0)
    found = flight.now(1000)
    assert len(found) == 2000
    [row] = rows(found, T0 + 1000)
    assert row.text.startswith("2000 drones: silent: 0 (17 min), 1 (17 min), ")
    assert len(row.line) < 300
    plain = flight.watch.plain(T0 + 1000)
    assert (len(plain["attention"]), plain["attention_more"]) == (500, 1500)


def test_a_few_drones_have_a_row_each() -> None:
    flight = Flight()
    for drone in range(MOST_ROWS):
        flight.entry(drone, float(drone))
    assert [row.text for row in flight.watch.rows(T0 + 1000)] == [f"drone {n}: silent for 17 min" for n in range(3)]
    flight.entry(9, 10.0)
    [row] = flight.watch.rows(T0 + 1000)
    assert len(row.keys) == 4


def test_one_drone_that_flaps_does_not_drive_out_the_events_of_others() -> None:
    flight = Flight()
    flight.status(8, 0.0, hops=None)
    for number in range(500):
        flight.status(7, float(number), hops=None if number % 2 else 1)
    events = flight.watch.events()
    assert [event.kind for event in events if event.drone == 8] == ["no route", "silent"]
    assert len(events) == MOST_EVENTS + 2


# -- what a node says of itself ----------------------------------------------------------------------------------------

STATUS: dict[str, Any] = {
    "role": "drone", "key_updates": None, "links": [], "vehicle": None, "ground": None, "watch": None, "outputs": None,
    "commits": {"failed": 0}, "faults": None, "other_versions": [], "shared_system_ids": [], "streams": None,
    "rivals": [], "alarms": {}, "hop_count": 1, "autopilot": None, "sensor": None, "position": None, "risk_known": True,
    "store": {"capacity_items": None, "items": 5, "replicas": 0}, "clock": {"trusted": True}, "neighbours": [],
}  # fmt: skip


@pytest.mark.parametrize(
    ("said", "text"),
    [
        ({"links": [{"name": "udp", "trouble": "network is down"}]}, "link udp: network is down"),
        ({"commits": {"failed": 2}}, "2 commits failed"),
        ({"hop_count": None}, "no route to a base"),
        ({"autopilot": {}, "risk_known": False}, "position lost"),
        ({"sensor": {"trouble": "not open"}, "risk_known": False}, "readings lost"),
        ({"store": {"capacity_items": 4, "items": 5, "replicas": 1}}, "store full"),
        ({"clock": {"trusted": False}}, "this node does not know the date"),
        ({"neighbours": [{"node_id": 9, "suspected": True}]}, "node 9 accepts data that do not arrive"),
        ({"alarms": {"two_contents": 3}}, f"{Alarm.TWO_CONTENTS.value}, 3 times since the start"),
        ({"key_updates": {"revoked": True, "revoked_elsewhere": []}}, "the keys of this drone are revoked"),
        ({"outputs": {"pid": None, "ends": 0}}, "the output process is not running"),
        (
            {"outputs": {"pid": 5, "ends": 0, "on_arrival": {"last_failure": "exit code 1", "trouble": None}}},
            "on_arrival: the last failure: exit code 1",
        ),
    ],
)
def test_what_a_node_lacks(said: dict[str, Any], text: str) -> None:
    assert of_node(STATUS) == []
    found = [one.title for one in of_node({**STATUS, **said})]
    assert any(title.startswith(text) for title in found)


def test_what_the_base_knows_by_drone_it_does_not_say_twice() -> None:
    assert of_node({**STATUS, "role": "base", "hop_count": None, "alarms": {"two_contents": 3}}) == []


def test_levels_of_drones_and_the_order_of_the_list() -> None:
    flight = Flight()
    flight.entry(7, 0.0)
    flight.status(7, 1.0, hops=None)
    flight.entry(8, 5.0, at_least=True)
    found = flight.now(500)
    assert [one.level for one in found] == sorted(one.level for one in found)
    assert marks(found) == {7: Level.ALARM, 8: Level.ALARM}
    assert {one.kind for one in found} <= set(KINDS)


def test_a_note_of_the_node_is_not_needed() -> None:
    assert watches.as_of(5.0, DateNote(float("inf"), 0.0, False)) == (5.0, False)


def test_named_things_are_what_the_page_and_scripts_rely_on() -> None:
    flight = Flight()
    flight.status(7, 0.0, hops=None)
    [found] = flight.now(10)
    assert found.plain(T0 + 10) == {
        "level": "warning", "kind": "no route", "drone": 7, "text": "no route to a base",
        "since": "2026-11-22T10:00:00.000Z", "for_s": 10.0, "do": KINDS["no route"].do,
    }  # fmt: skip
    event: Callable[[], Any] = flight.watch.events()[0].plain
    assert event() == {
        "utc": "2026-11-22T10:00:01.000Z", "begins": True, "level": "warning", "kind": "no route", "drone": 7,
        "text": "no route to a base",
    }  # fmt: skip

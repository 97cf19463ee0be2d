"""What the page shows, from the data one after the other."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.core.datum import DatumId, Fate, Kind
from rass_mav.ground import history
from rass_mav.ground.archive import Archive
from rass_mav.ground.attention.watch import Rules
from rass_mav.ground.entry import Entry
from rass_mav.ground.feed import Feed
from rass_mav.ground.history import Arrivals, Reading, Readings
from rass_mav.ground.page.model import MOST_DRONES, MOST_PLACES, Mission
from rass_mav.ground.report import Report
from rass_mav.wire.measurement import Measurement
from rass_mav.wire.nodestatus import NodeStatus
from tests.some import some

from .flights import Flight

NOW = 1_795_341_600.0
STATUS = NodeStatus(9, 4, 2, 100, 0.5, 2, 80, (47.37, 8.54), {8: 0.5}, {7: 4}, next_hop=8)


def entry(number: int, *, drone: int = 7, utc: float = NOW, delay_s: float | None = 1.0, **more: Any) -> Entry:
    arrived = None if delay_s is None else utc + delay_s
    kind = Kind.STATUS if "status" in more else Kind.MEASUREMENT
    return Entry(number, DatumId(drone, 1, number), 0, kind, 24, 1, utc, 1.0, False, 0.0, arrived=arrived, **more)


def measured(
    number: int, *, place: tuple[float, float] = (47.37, 8.54), reading: float | None = 1.0, **more: Any
) -> Entry:
    return entry(number, measurement=Measurement(*place, 400.0, reading, 0.25, unit="usvh"), **more)


class Browser:
    """What a browser makes of what it gets (static/js/state.js)."""

    def __init__(self, snapshot: dict[str, Any]) -> None:
        self.frame: dict[str, Any] = {}
        self.drones: dict[int, Any] = {}
        self.tracks: dict[str, tuple[float, dict[int, list[float]]]] = {}
        self.squares: dict[str, dict[tuple[int, int], Any]] = {}
        self.take(snapshot)

    def take(self, news: dict[str, Any]) -> None:
        news = json.loads(json.dumps(news, allow_nan=False))
        self.frame = {name: news[name] for name in ("totals", "lost", "begin", "end", "arrivals", "unheard")}
        self.drones.update({figures["drone"]: figures for figures in news["drones"]})
        for id, track in news["tracks"].items():
            span = track["span_s"]
            if track["whole"] or self.tracks.get(id, (None,))[0] != span:
                self.tracks[id] = span, {}
            for point in track["points"]:
                self.tracks[id][1][math.floor(point[0] / span)] = point
        for unit, field in news["fields"].items():
            if field["whole"]:
                self.squares[unit] = {}
            self.squares.setdefault(unit, {}).update({(s[0], s[1]): s for s in field["squares"]})

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Browser) and vars(self) == vars(other)

    __hash__ = None  # type: ignore[assignment]


@pytest.fixture
def flight(tmp_path: Path) -> Iterator[Flight]:
    flight = Flight(tmp_path / "rass-1.db", drones=4)
    yield flight
    flight.close()


def test_a_browser_that_follows_knows_what_one_that_comes_later_gets(flight: Flight) -> None:
    mission = Mission()
    browser = Browser(mission.snapshot())
    feed = Feed(lambda: Archive(flight.base.path))
    cursor = None
    for minutes in (1, 1, 0, 3, 2):
        flight.fly(60 * minutes)
        with feed.look(cursor) as look:
            for entry, cursor in look.arrivals():  # noqa: B007 (it is kept)
                mission.take([entry])
            mission.hear(look.data.losses())
        browser.take(mission.changes())
        assert browser == Browser(mission.snapshot())
    assert mission.changes()["drones"] == []


def test_its_figures_are_those_of_the_report(flight: Flight) -> None:
    flight.fly(600)
    mission = Mission()
    with Archive(flight.base.path, now=lambda: NOW) as archive:
        report = Report.of(archive).plain(NOW)
        mission.take(archive.entries())
        mission.hear(archive.losses())
    shown = mission.snapshot()
    assert shown["totals"] == {name: report[name] for name in ("created", "arrived", "missing", "lost")}
    assert shown["delay_s"] == report["delay_s"]
    assert shown["off_map"] == report["off_map"]
    for figures, drone in zip(shown["drones"], report["drones"], strict=True):
        for name in ("drone", "created", "arrived", "missing", "lost", "at_risk"):
            assert figures[name] == drone[name]
        assert figures["at_most"] == (drone["at_most"] and list(drone["at_most"].values()))
        detail = some(mission.drone(figures["drone"]))
        assert detail["missing_numbers"] == drone["missing_numbers"]
    assert mission.drone(4711) is None


@pytest.mark.no_cover
def test_earlier_times(flight: Flight) -> None:
    flight.fly(600)
    mission = Mission()
    with Archive(flight.base.path) as archive:
        mission.take(archive.entries())
    last = mission.snapshot()
    end = mission.at(mission.end)
    assert end["totals"]["arrived"] == last["totals"]["arrived"]
    assert end["fields"]["usvh"]["squares"] == last["fields"]["usvh"]["squares"]
    for then, now in zip(end["drones"], last["drones"], strict=True):
        assert {name: then[name] for name in ("place", "status_utc", "held", "battery", "highest")} == {
            name: now[name] for name in ("place", "status_utc", "held", "battery", "highest")
        }
    arrived = [mission.at(mission.begin + seconds)["totals"]["arrived"] for seconds in range(0, 700, 20)]
    assert arrived == sorted(arrived)
    assert arrived[0] < arrived[10] < arrived[-1]
    before = mission.at(mission.begin - 1000)
    assert (before["drones"], before["fields"]) == ([], {})


def test_the_latest_status_counts_whatever_the_order() -> None:
    mission = Mission()
    mission.take(
        [
            entry(0, utc=NOW, status=STATUS._replace(held=5)),
            entry(1, utc=NOW - 60, status=STATUS._replace(held=70, place=(47.0, 8.0))),
            measured(2, utc=NOW + 10, place=(47.38, 8.54)),
        ]
    )
    (figures,) = mission.snapshot()["drones"]
    (unheard,) = mission.snapshot()["unheard"]
    assert (unheard["drone"], unheard["heard"], unheard["heard_by"]) == (8, None, [7, NOW])
    assert (figures["held"], figures["place"], figures["risk"]) == (5, [47.38, 8.54], 0.25)
    assert (figures["neighbours"], figures["next_hop"]) == ([[8, 0.5]], 8)
    (earlier,) = mission.at(NOW - 30)["drones"]
    assert (earlier["held"], earlier["place"], earlier["risk"], earlier["at_risk"]) == (70, [47.0, 8.0], 0.5, 4)


def test_the_base_is_on_the_map_whatever_has_arrived() -> None:
    mission = Mission()
    mission.rules = Rules(base=(1, (47.38, 8.55)))
    [shown] = mission.snapshot()["unheard"]
    assert (shown["drone"], shown["base"], shown["place"], shown["how"]) == (1, True, [47.38, 8.55], "set")
    mission.take([entry(n, drone=100 + n) for n in range(MOST_DRONES + 5)])
    assert [figures["drone"] for figures in mission.snapshot()["unheard"]] == [1], "forged drones do not push it out"
    [before] = mission.at(NOW - 9.0)["drones"]
    assert (before["drone"], before["place"], before["how"]) == (1, [47.38, 8.55], "set")


def test_a_base_that_nothing_places_is_where_the_first_hop_was() -> None:
    mission = Mission()
    base = STATUS._replace(base=True, place=None, hops=0, next_hop=None, neighbours={7: 0.5})
    mission.take([measured(0), entry(1, drone=1, status=base)])
    shown = {figures["drone"]: figures for figures in mission.snapshot()["drones"]}
    assert (shown[1]["place"], shown[1]["how"], shown[1]["placed"]) == ([47.37, 8.54], "guess", None)
    assert "how" not in shown[7]
    mission.take([entry(2, drone=1, status=base._replace(place=(47.4, 8.6)))])
    shown = {figures["drone"]: figures for figures in mission.snapshot()["drones"]}
    assert (shown[1]["place"], shown[1]["how"], shown[1]["placed"]) == ([47.4, 8.6], "heard", NOW)


def test_contours_and_hot_spots_are_those_of_the_rules(flight: Flight) -> None:
    flight.fly(600)
    mission = Mission()
    mission.rules = Rules(above=4.0, contours=(2.0,))
    with Archive(flight.base.path, now=lambda: NOW) as archive:
        mission.take(archive.entries())
    found = json.loads(json.dumps(mission.contours(), allow_nan=False))
    assert found.keys() == {"usvh"}
    assert found["usvh"]["levels"] == [2.0, 4.0]
    assert {line["level"] for line in found["usvh"]["lines"]} == {2.0, 4.0}
    spots = mission.snapshot()["hot_spots"]
    assert spots
    assert all(spot["reading"] > 4.0 for spot in spots)
    assert mission.at(NOW + 300.0)["contours"].keys() == {"usvh"}


def test_a_drone_without_a_place_has_the_risk_of_its_status() -> None:
    mission = Mission()
    mission.take([entry(0, status=STATUS._replace(place=None))])
    (figures,) = mission.snapshot()["drones"]
    assert (figures["place"], figures["risk"]) == (None, 0.5)


def test_forged_drones_are_counted_and_not_shown() -> None:
    mission = Mission()
    mission.take(measured(0, drone=id) for id in range(MOST_DRONES + 20))
    mission.hear([(DatumId(60_000, 1, 0), Fate.OVERFLOW), (DatumId(3, 1, 7), Fate.OVERFLOW)])
    shown = mission.snapshot()
    assert len(shown["drones"]) == MOST_DRONES
    assert shown["unlisted"] == 20
    assert shown["totals"]["lost"] == 1


def test_losses_are_heard_once() -> None:
    mission = Mission()
    fault = (DatumId(7, 1, 3), Fate.UNKNOWN)
    assert mission.hear([fault])
    assert not mission.hear([fault])
    assert mission.report.drones[7].store_faults == [Fate.UNKNOWN]


@pytest.mark.parametrize("place", [(120.0, 8.0), (47.0, 190.0), (-91.0, 0.0)])
def test_places_that_are_not_on_earth_are_left_out(place: tuple[float, float]) -> None:
    mission = Mission()
    mission.take([measured(0, place=place), entry(1, status=STATUS._replace(place=place))])
    shown = mission.snapshot()
    assert shown["drones"][0]["place"] is None
    assert shown["fields"] == {}
    assert shown["tracks"]["7"]["points"] == []


def test_a_datum_that_is_said_to_be_very_old_does_not_stretch_the_time() -> None:
    mission = Mission()
    mission.take([measured(0), measured(1, utc=NOW - 1e8, delay_s=1e8)])
    assert mission.end - mission.begin <= 3601


def test_tracks_are_thinned() -> None:
    mission = Mission()
    mission.take(measured(n, utc=NOW + n, place=(47 + n * 1e-5, 8.0)) for n in range(5 * MOST_PLACES))
    points = mission.snapshot()["tracks"]["7"]["points"]
    assert MOST_PLACES / 3 < len(points) <= MOST_PLACES
    assert points[-1] == [NOW + 5 * MOST_PLACES - 1, round(47 + (5 * MOST_PLACES - 1) * 1e-5, 6), 8.0]


class TestReadings:
    def test_they_come_back_as_they_were(self) -> None:
        readings = Readings(10)
        rows = [Reading(float(n), n % 3, 47.5, 8.25, n / 2, "cpm" if n % 2 else "") for n in range(10)]
        for row in rows:
            readings.take(row)
        assert list(readings.until(6.0)) == rows[:7]
        assert list(readings.of({1})) == [row for row in rows if row.drone == 1]

    @pytest.mark.parametrize("many", [11, 25, 1000])
    def test_of_many_every_so_many_is_kept(self, many: int) -> None:
        readings = Readings(10)
        for n in range(many):
            readings.take(Reading(float(n), n, 47.5, -n, n / 2, "cpm"))
        kept = list(readings.until(math.inf))
        assert len(kept) <= 10
        assert all(row == Reading(row.utc, int(row.utc), 47.5, -row.utc, row.utc / 2, "cpm") for row in kept)
        assert readings.every >= many / 10


class TestArrivals:
    @given(st.lists(st.tuples(st.floats(0, 1e10), st.floats(0, 1e6)), max_size=60))
    def test_none_is_forgotten(self, rows: list[tuple[float, float]]) -> None:
        arrivals = Arrivals()
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(history, "MOST_SPANS", 7)
            for arrived, delay in rows:
                arrivals.take(arrived, delay)
        plain = arrivals.plain()
        assert sum(plain["count"]) == len(rows)
        assert len(plain["start"]) <= 7
        assert plain["start"] == sorted(plain["start"])

    def test_delays_are_close(self) -> None:
        arrivals = Arrivals()
        for delay in range(1, 101):
            arrivals.take(5.0, float(delay))
        arrivals.take(95.0, None)
        plain = arrivals.plain()
        assert plain["p50"] == [pytest.approx(50.0, rel=0.05), None]
        assert plain["p95"] == [pytest.approx(95.0, rel=0.05), None]

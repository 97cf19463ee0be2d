"""What has become of the data, as a base can know it."""

from __future__ import annotations

import json
import time
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.core.datum import STORE_FAULTS, Datum, DatumId, Fate, Kind
from rass_mav.ground.archive import Archive
from rass_mav.ground.attention.watch import Watch
from rass_mav.ground.entry import Entry
from rass_mav.ground.follow import Follower
from rass_mav.ground.report import MOST_UNHEARD, AtMost, Numbers, Report
from rass_mav.wire.nodestatus import NodeStatus, encode_status
from tests.commands import output
from tests.some import some

from .missions import EPOCH, HERE, Base

QUIET = NodeStatus(0, 0, 0, None, 0.0, 1, None, None, {}, {})


def report(base: Base) -> Report:
    with Archive(base.path, now=lambda: base.wall) as archive:
        return Report.of(archive)


def status(base: Base, origin: int, sequence: int, said: NodeStatus, *, age_s: float = 0.0) -> Datum:
    return base.datum(origin, sequence, Kind.STATUS, encode_status(said), age_s=age_s)


def test_by_drone_what_arrived_what_is_missing_and_what_is_lost(base: Base) -> None:
    hot = HERE._replace(reading=9.5, latitude=47.5)
    base.arrive(
        base.measurement(7, 0, HERE, age_s=50.0),
        base.measurement(7, 1, hot, age_s=40.0),
        base.measurement(7, 5, HERE._replace(longitude=8.6), age_s=10.0),
        base.file(8, 2, "photo.jpg", b"x"),
    )
    base.store.lose(DatumId(7, EPOCH, 3), Fate.CORRUPTED)
    base.store.lose(DatumId(7, EPOCH, 8), Fate.OVERFLOW)
    base.store.lose(DatumId(9, EPOCH, 4), Fate.UNKNOWN)
    base.arrive(base.measurement(8, 0, HERE))
    found = report(base)
    seven, eight, nine = (found.drones[id] for id in (7, 8, 9))
    assert (seven.created, seven.arrived, seven.missing) == (9, 3, 4)
    assert list(seven.epochs[EPOCH].missing()) == [(2, 2), (4, 4), (6, 7)]
    assert seven.lost == {Fate.CORRUPTED: 1, Fate.OVERFLOW: 1}
    assert some(seven.placed)[1] == (47.3769, 8.6)
    assert seven.highest is not None
    assert (seven.highest.reading, seven.highest.place) == (9.5, (47.5, 8.5417))
    assert (eight.created, eight.arrived, eight.missing) == (3, 2, 1)
    assert eight.kinds == {"file": 1, "measurement": 1}
    assert nine.store_faults == [Fate.UNKNOWN]
    assert nine.missing == 0
    plain = found.plain(base.wall)
    assert (plain["created"], plain["arrived"], plain["missing"], plain["lost"]) == (12, 5, 5, 2)
    assert plain["drones"][0]["missing_numbers"][0] == {"epoch": f"{EPOCH:08x}", "first": 2, "last": 2}
    assert json.loads(json.dumps(plain)) is not None


def test_a_datum_that_was_said_to_be_lost_and_arrived_is_not_lost(base: Base) -> None:
    base.store.lose(DatumId(7, EPOCH, 0), Fate.CORRUPTED)
    base.arrive(base.measurement(7, 0, HERE))
    assert report(base).drones[7].lost == {}


@given(st.sets(st.integers(0, 60)), st.sets(st.integers(0, 60)))
def test_every_number_below_the_highest_is_arrived_lost_or_missing(arrived: set[int], lost: set[int]) -> None:
    numbers = Numbers()
    for number in arrived:
        numbers.arrived.add(number, number + 1)
    numbers.lost = dict.fromkeys(lost - arrived, Fate.DIED)
    numbers.known = max(arrived | lost, default=-1) + 1
    missing = {number for first, last in numbers.missing() for number in range(first, last + 1)}
    assert missing == set(range(numbers.known)) - arrived - lost
    for below in range(0, 62, 5):
        assert numbers.missing_below(below) == len({number for number in missing if number < below})


@given(
    st.lists(st.tuples(st.integers(0, 40), st.integers(0, 90)), max_size=20),
    st.sets(st.integers(0, 45)),
    st.integers(0, 95),
)
def test_what_is_missing_of_the_time_before(arrived: list[tuple[int, int]], lost: set[int], utc: int) -> None:
    numbers = Numbers()
    for number, at in arrived:
        numbers.note(Entry(0, DatumId(7, 0, number), 0, Kind.BYTES, 1, 1, float(at), 0.0, False, 0.0))
        numbers.arrived.add(number, number + 1)
    numbers.lost = dict.fromkeys(lost - {number for number, _ in arrived}, Fate.DIED)
    numbers.known = 46
    missing = sum(count for since, count in numbers.missing_since() if since < utc)
    below = numbers.created_before(utc)
    assert missing == numbers.missing_below(46 if below is None else below)
    # Whatever has arrived and was created at that time or later, all before have lower numbers: so it is a bound.
    first = min((number for number, at in arrived if at >= utc), default=46)
    assert missing >= numbers.missing_below(first)


known = st.builds(DatumId, st.just(7), st.integers(0, 2), st.integers(0, 12))


@given(st.lists(st.tuples(known, st.none() | st.sampled_from([fate for fate in Fate if fate not in STORE_FAULTS]))))
def test_the_figures_do_not_depend_on_whether_the_loss_or_the_datum_is_heard_first(
    news: list[tuple[DatumId, Fate | None]],
) -> None:
    found = Report()
    for id, fate in news:
        if fate is None:
            found.take([Entry(0, id, 0, Kind.BYTES, 1, 1, 1e9, None, False, 0.0)])
        else:
            found.hear([(id, fate)])
    drone = found.drone(7)
    arrived = {id for id, fate in news if fate is None}
    lost = {id: fate for id, fate in news if fate is not None and id not in arrived}
    created = {
        epoch: max(id.sequence for id, _ in news if id.epoch == epoch) + 1 for epoch in {id.epoch for id, _ in news}
    }
    assert (drone.arrived, drone.created) == (len(arrived), sum(created.values()))
    assert drone.lost == Counter(lost.values())
    ranges = [gap for numbers in drone.epochs.values() for gap in numbers.missing()]
    assert drone.missing == sum(last - first + 1 for first, last in ranges)


def test_delays_are_those_of_arrivals_whose_age_is_known(base: Base) -> None:
    for number in range(20):
        base.arrive(base.measurement(7, number, HERE, age_s=float(number)))
    base.arrive(base.measurement(7, 20, HERE, age_s=5000.0)._replace(at_least=True))
    found = report(base)
    assert found.delay(0.5) == pytest.approx(10.0, abs=0.1)
    assert found.delay(1.0) == pytest.approx(19.0, abs=0.1)
    assert Report().delay(0.5) is None


class TestAtRisk:
    """What is lost if a drone fails: at most what it alone had at its last word and has not arrived since."""

    def test_no_word_is_no_answer(self, base: Base) -> None:
        base.arrive(base.measurement(7, 0, HERE))
        assert report(base).at_risk(7) is None
        assert report(base).at_risk(12) is None

    def test_what_it_alone_had(self, base: Base) -> None:
        said = QUIET._replace(held=9, alone=6, alone_by_origin={7: 4, 8: 2})
        base.arrive(base.measurement(8, 0, HERE, age_s=500.0), status(base, 7, 10, said))
        assert report(base).at_risk(7) == 6, "of drone 8 nobody knows how many there are"

    def test_what_has_arrived_since_is_safe(self, base: Base) -> None:
        said = QUIET._replace(held=9, alone=6, alone_by_origin={7: 4, 8: 2})
        base.arrive(status(base, 7, 4, said, age_s=60.0))
        base.arrive(*(base.measurement(7, number, HERE, age_s=70.0) for number in (0, 1)))
        assert report(base).at_risk(7) == 2 + 2, "two of its own four are missing"
        base.arrive(*(base.measurement(8, number, HERE, age_s=70.0) for number in (0, 2)))
        assert report(base).at_risk(7) == 2 + 2, "drone 8 may have created more before"
        base.arrive(base.measurement(8, 3, HERE, age_s=0.0))
        assert report(base).at_risk(7) == 2 + 1, "of drone 8 only number 1 is missing"
        base.arrive(
            base.measurement(8, 1, HERE, age_s=70.0), base.measurement(7, 2, HERE), base.measurement(7, 3, HERE)
        )
        assert report(base).at_risk(7) == 0

    def test_a_newer_word_counts_and_an_older_one_that_comes_late_does_not(self, base: Base) -> None:
        base.arrive(status(base, 7, 3, QUIET, age_s=10.0))
        base.arrive(status(base, 7, 0, QUIET._replace(held=5, alone=5), age_s=100.0))
        assert report(base).at_risk(7) == 0

    def test_where_numbers_were_lost_nothing_is_called_safe(self, base: Base) -> None:
        base.store.lose(DatumId(7, EPOCH, 4), Fate.UNKNOWN)
        base.arrive(status(base, 7, 2, QUIET._replace(held=9, alone=9, alone_by_origin={7: 9})))
        assert report(base).at_risk(7) == 9


class TestAtMost:
    """A bound of what is lost if a drone fails, of the data that were created before its last word."""

    def test_all_that_are_missing_of_what_was_created_before_the_word(self, base: Base) -> None:
        base.arrive(status(base, 7, 4, QUIET, age_s=60.0), base.measurement(7, 1, HERE, age_s=65.0))
        base.arrive(*(base.measurement(8, number, HERE, age_s=70.0) for number in (0, 2)))
        assert report(base).at_most() == {7: AtMost(3 + 1, 1)}, "drone 8 may have created more before"
        base.arrive(base.measurement(8, 7, HERE, age_s=0.0), base.measurement(7, 9, HERE, age_s=0.0))
        assert report(base).at_most() == {7: AtMost(3 + 5, 0)}, "how many of these four are older is not known"
        base.arrive(base.measurement(8, 4, HERE, age_s=40.0))
        assert report(base).at_most() == {7: AtMost(3 + 2, 0)}, "those between this one and the last are newer"
        base.store.lose(DatumId(8, EPOCH, 3), Fate.CORRUPTED)
        base.arrive()
        assert report(base).at_most() == {7: AtMost(3 + 1, 0)}, "what is lost already is not lost with the drone"

    def test_it_is_not_less_than_what_the_drone_alone_had(self, base: Base) -> None:
        base.arrive(status(base, 8, 3, QUIET._replace(held=50, alone=50), age_s=90.0))
        base.arrive(status(base, 7, 0, QUIET, age_s=30.0), base.measurement(8, 9, HERE, age_s=1.0))
        assert report(base).at_most() == {7: AtMost(3 + 5, 0), 8: AtMost(50, 0)}

    def test_nothing_is_called_a_bound_where_numbers_were_lost_or_a_clock_was_wrong(self, base: Base) -> None:
        base.arrive(status(base, 7, 2, QUIET, age_s=60.0), base.measurement(8, 3, HERE, age_s=0.0))
        assert report(base).at_most() == {7: AtMost(2 + 3, 0)}
        base.arrive(base.measurement(9, 1, HERE, age_s=0.0)._replace(at_least=True))
        assert report(base).at_most() == {7: AtMost(2 + 3 + 1, 1)}, "drone 9 may have created it long ago"
        base.store.lose(DatumId(8, EPOCH, 2), Fate.UNKNOWN)
        base.arrive()
        assert report(base).at_most() == {7: AtMost(2 + 3 + 1, 2)}

    def test_drones_that_are_only_named_are_unknown_and_bases_are_not(self, base: Base) -> None:
        said = QUIET._replace(hops=1, neighbours={1: 1.0, 9: 0.5}, next_hop=1)
        base.arrive(status(base, 7, 0, said), status(base, 2, 3, QUIET._replace(base=True), age_s=50.0))
        assert report(base).at_most() == {7: AtMost(0, 1)}


class TestNamed:
    """Drones of which nothing has arrived, but which others hear."""

    def test_they_are_in_the_report_until_something_arrives(
        self, base: Base, capsys: pytest.CaptureFixture[str]
    ) -> None:
        said = QUIET._replace(hops=1, neighbours={1: 1.0, 9: 0.5}, next_hop=1)
        base.arrive(status(base, 7, 0, said, age_s=20.0))
        found = report(base).plain(base.wall)
        assert [drone["drone"] for drone in found["drones"]] == [1, 7, 9]
        one, seven, nine = (drone["heard_by"] for drone in found["drones"])
        assert seven is None
        assert (one["base"], nine["base"], nine["drone"], nine["age_s"]) == (True, False, 7, 20.0)
        assert "heard by drone 7" in told(base, capsys)
        assert "; nothing has arrived" in told(base, capsys)
        base.arrive(base.measurement(9, 0, HERE), status(base, 7, 1, said))
        assert [drone["heard_by"] is None for drone in report(base).plain(base.wall)["drones"]] == [False, True, True]

    def test_forged_names_are_bounded(self) -> None:
        found = Report()
        for number in range(300):
            said = QUIET._replace(neighbours={1000 + number: 1.0})
            id = DatumId(7, EPOCH, number)
            found.take([Entry(0, id, 0, Kind.STATUS, 1, 1, 1e9 + number, 0.1, False, 0.0, status=said)])
        assert len(found.listed) == 1 + MOST_UNHEARD
        assert 1299 in found.unheard


def told(base: Base, capsys: pytest.CaptureFixture[str], *words: str) -> Any:
    return output(capsys, "report", str(base.path), *words).out


class TestDronesStore:
    """On a drone's card, most of what counts as missing has been handed over: the report must not read as a base's."""

    def test_the_first_line_says_so_and_what_it_means(
        self, base: Base, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        base.store.count("passed_on", 5)
        base.arrive(base.measurement(7, 0, HERE), base.measurement(7, 6, HERE))
        first, *others = told(base, capsys).splitlines()
        assert first == (
            "This store is a drone's, not a base's: \"missing\" includes data that it has handed over, which may have "
            "arrived. Only the report of a base tells."
        )
        assert any("7 created, 2 arrived, 5 missing" in line for line in others)
        assert json.loads(told(base, capsys, "--json"))["drone_store"]
        told(base, capsys, "--html", str(tmp_path / "card.html"))
        assert "This store is a drone" in (tmp_path / "card.html").read_text(encoding="utf-8")
        with Archive(base.path) as archive:
            follower = Follower(lambda: Archive(base.path), Watch)
            assert follower.remarks == archive.notes != []
            follower.close()

    def test_a_base_s_does_not(self, base: Base, capsys: pytest.CaptureFixture[str]) -> None:
        base.arrive(base.measurement(7, 0, HERE))
        assert "This store is a drone" not in told(base, capsys)
        assert not json.loads(told(base, capsys, "--json"))["drone_store"]


class TestSilence:
    """Who is not heard stands first: all that arrived says nothing about what a silent drone created since."""

    @pytest.fixture
    def first(self, base: Base, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Any:
        monkeypatch.setattr(time, "time", lambda: base.wall)

        def first(*words: str) -> str:
            line: str = told(base, capsys, *words).splitlines()[0]
            return line

        return first

    def test_drones_that_are_silent_are_named_with_how_long(
        self, base: Base, first: Any, capsys: pytest.CaptureFixture[str]
    ) -> None:
        base.arrive(
            base.measurement(2, 0, HERE, age_s=20.0),
            base.measurement(3, 0, HERE, age_s=1920.0),
            base.measurement(5, 0, HERE, age_s=7300.0),
            status(base, 1, 0, QUIET._replace(base=True), age_s=5.0),
        )
        assert [line.partition(". ")[0] for line in told(base, capsys).splitlines()[:2]] == [
            "ALARM: drone 5: silent for 2 h", "ALARM: drone 3: silent for 32 min",
        ]  # fmt: skip
        assert "\nat least 4 created, 4 arrived, 0 missing, 0 lost" in told(base, capsys)
        plain = json.loads(first("--json"))
        assert plain["silent"] == [
            {"drone": 5, "age_s": 7300.0, "utc": "2026-11-22T07:58:20.000Z"},
            {"drone": 3, "age_s": 1920.0, "utc": "2026-11-22T09:28:00.000Z"},
        ]
        assert plain["silent_after_s"] == 180.0

    def test_when_all_are_heard_it_says_so(self, base: Base, first: Any) -> None:
        base.arrive(base.measurement(2, 0, HERE, age_s=20.0), base.measurement(3, 0, HERE, age_s=90.0))
        assert first() == "nothing needs attention: all 2 drones heard in the last 90 s"
        assert json.loads(first("--json"))["silent"] == []

    def test_a_drone_of_which_nothing_has_arrived(
        self, base: Base, first: Any, capsys: pytest.CaptureFixture[str]
    ) -> None:
        base.arrive(status(base, 2, 0, QUIET._replace(neighbours={9: 0.5}), age_s=10.0))
        base.store.lose(DatumId(4, EPOCH, 3), Fate.CORRUPTED)
        base.arrive()
        assert first().startswith("WARNING: drone 4: heard by other drones only. No data have arrived")
        assert "WARNING: drone 9: heard by other drones only; last drone 2. " in told(base, capsys)
        assert json.loads(first("--json"))["silent"] == [
            {"drone": 4, "age_s": None, "utc": None}, {"drone": 9, "age_s": None, "utc": None},
        ]  # fmt: skip

    def test_after_a_mission_those_that_fell_silent_before_the_others_stand_out(
        self, base: Base, first: Any, capsys: pytest.CaptureFixture[str]
    ) -> None:
        base.arrive(base.measurement(3, 0, HERE, age_s=1920.0), base.measurement(2, 0, HERE, age_s=200.0))
        base.arrive(status(base, 1, 0, QUIET._replace(base=True), age_s=10.0))
        base.wall += 50_000.0
        lines = [line.partition(". ")[0] for line in told(base, capsys).splitlines()]
        assert lines[:3] == [
            "ALARM: drone 3: silent for 32 min", "ALARM: drone 2: silent for 3 min",
            "WARNING: the base has stopped; last written 14 h ago",
        ]  # fmt: skip

    def test_no_drone_at_all(self, base: Base, first: Any) -> None:
        base.arrive(status(base, 1, 0, QUIET._replace(base=True), age_s=5.0))
        assert first().startswith("WARNING: no drone has been heard. ")

    def test_many_are_not_all_named(self, base: Base, first: Any) -> None:
        base.arrive(*(base.measurement(id, 0, HERE, age_s=600.0) for id in range(2, 40)), base.measurement(1, 0, HERE))
        line = first()
        assert line.startswith("ALARM: 38 drones: silent: 2 (10 min), 3 (10 min), ")
        assert line.count("min)") == 8
        assert " and 30 more. " in line

    def test_it_stands_before_the_totals_in_the_file_too(self, base: Base, tmp_path: Path, first: Any) -> None:
        base.arrive(base.measurement(2, 0, HERE, age_s=20.0), base.measurement(3, 0, HERE, age_s=1920.0))
        first("--html", str(tmp_path / "report.html"))
        text = (tmp_path / "report.html").read_text(encoding="utf-8")
        assert 0 < text.find("drone 3: silent for 32 min.") < text.find('class="totals"')


def test_the_command_tells_people_and_scripts(base: Base, capsys: pytest.CaptureFixture[str]) -> None:
    base.arrive(
        base.measurement(7, 0, HERE, age_s=5.0),
        status(base, 7, 4, QUIET._replace(held=3, alone=2, battery=61, place=(47.0, 8.0), link_key=2), age_s=1.0),
    )
    out = told(base, capsys)
    assert "\n5 created, 2 arrived, 3 missing, 0 lost; half arrived within " in out
    assert "47.0000000 8.0000000, 0.142 uSv/h at 47.3769000 8.5417000" in out
    assert f"missing: {EPOCH:08x}-1..3" in out
    assert (
        "3 in custody, 2 of them with no other copy, 1 hops, risk 0.00, battery 61 %, link key 2; newer data unknown"
        in out
    )
    plain = json.loads(told(base, capsys, "--json"))
    [seven] = plain["drones"]
    assert (seven["at_risk"], seven["status"]["battery"], seven["status"]["link_key"]) == (2, 61, 2)
    assert seven["heard"]["utc"] == "2026-11-22T09:59:59.000Z"


class TestOffMap:
    """What the map leaves out is told in words, and a base first of all: many have no autopilot, so no position."""

    BASE = "Base 1 is not on the map: no position is known (no autopilot reports one)."
    GUESS = "The position of base 1 is a guess, from the first hop to it: set base.place in its configuration."

    def test_a_base_without_a_position(self, base: Base, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        nowhere = HERE._replace(latitude=None, longitude=None)
        base.arrive(base.measurement(2, 0, nowhere), status(base, 1, 0, QUIET._replace(base=True)))
        assert self.BASE in told(base, capsys).splitlines()
        plain = json.loads(told(base, capsys, "--json"))
        assert plain["off_map"][0] == self.BASE
        assert plain["bases"] == [{"drone": 1, "place": None, "how": None}]
        told(base, capsys, "--html", str(tmp_path / "report.html"))
        text = (tmp_path / "report.html").read_text(encoding="utf-8")
        assert 0 < text.find("<h2>Map</h2>") < text.find(self.BASE) < text.find("<h2>Drones</h2>")

    def test_a_base_without_a_position_is_guessed_where_the_first_hop_was(
        self, base: Base, capsys: pytest.CaptureFixture[str]
    ) -> None:
        far = base.measurement(3, 0, HERE._replace(latitude=47.5), hops=4, age_s=90.0)
        base.arrive(far, status(base, 1, 0, QUIET._replace(base=True)))
        assert json.loads(told(base, capsys, "--json"))["bases"] == [
            {"drone": 1, "place": [47.5, 8.5417], "how": "guess"}
        ]
        base.arrive(base.measurement(2, 0, HERE, hops=2), base.measurement(3, 1, HERE, hops=2))
        assert json.loads(told(base, capsys, "--json"))["bases"][0]["place"] == [47.3769, 8.5417], (
            "fewer hops are nearer"
        )
        direct = QUIET._replace(place=(47.1, 8.1), next_hop=1, neighbours={1: 0.9})
        base.arrive(status(base, 2, 1, direct), status(base, 2, 2, direct._replace(place=(47.2, 8.2))))
        plain = json.loads(told(base, capsys, "--json"))
        assert plain["bases"] == [{"drone": 1, "place": [47.1, 8.1], "how": "guess"}], (
            "the first that came to it directly"
        )
        assert plain["off_map"] == [self.GUESS]
        assert self.GUESS in told(base, capsys)
        base.arrive(status(base, 1, 1, QUIET._replace(base=True, place=(47.0, 8.0))))
        plain = json.loads(told(base, capsys, "--json"))
        assert (plain["bases"], plain["off_map"]) == ([{"drone": 1, "place": [47.0, 8.0], "how": "heard"}], [])

    def test_the_place_in_the_configuration_counts_even_if_the_base_says_another_or_nothing(
        self, base: Base, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        config = tmp_path / "base.yaml"
        config.write_text(
            f"node: {{id: 1, role: base}}\nbase: {{place: [46.5, 7.25]}}\nstore: {{path: {base.path}}}\n"
            "links: [{listen: '127.0.0.1:0', peers: [{address: '127.0.0.1:9'}]}]\n"
        )
        set_there = [{"drone": 1, "place": [46.5, 7.25], "how": "set"}]
        base.arrive(base.measurement(2, 0, HERE))
        assert json.loads(output(capsys, "report", str(config), "--json").out)["bases"] == set_there, "not even heard"
        base.arrive(status(base, 1, 0, QUIET._replace(base=True, place=(47.0, 8.0))))
        assert json.loads(output(capsys, "report", str(config), "--json").out)["bases"] == set_there
        assert json.loads(told(base, capsys, "--json"))["bases"][0]["how"] == "heard", "the store alone does not say"

    def test_where_everybody_has_a_place_nothing_is_said(self, base: Base, capsys: pytest.CaptureFixture[str]) -> None:
        base.arrive(base.measurement(2, 0, HERE), status(base, 1, 0, QUIET._replace(base=True, place=(47.0, 8.0))))
        assert json.loads(told(base, capsys, "--json"))["off_map"] == []
        assert "not on the map" not in told(base, capsys)

    def test_a_place_that_was_known_once_is_on_the_map(self, base: Base, capsys: pytest.CaptureFixture[str]) -> None:
        at = QUIET._replace(base=True, place=(47.0, 8.0))
        base.arrive(status(base, 1, 0, at, age_s=90.0), status(base, 1, 1, at._replace(place=None)))
        assert json.loads(told(base, capsys, "--json"))["off_map"] == []

    def test_others_without_a_place(self, base: Base, capsys: pytest.CaptureFixture[str]) -> None:
        base.arrive(
            status(base, 2, 0, QUIET._replace(neighbours={99: 0.5}, hops=1, next_hop=99)),
            *(base.measurement(id, 0, HERE._replace(latitude=None, longitude=None)) for id in range(3, 33)),
        )
        assert json.loads(told(base, capsys, "--json"))["off_map"] == [
            "Base 99 is not on the map: no data have arrived.",
            "Drones 2, 3, 4, 5, 6, 7, 8, 9 and 23 more are not on the map: no position on Earth has arrived.",
        ]

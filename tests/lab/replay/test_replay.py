"""Recordings through the nodes: what arrives, who is in range, with the invariants checked after every step."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rass_mav.core.messages import NO_ROUTE
from rass_mav.errors import ConfigError, LogError
from rass_mav.lab.replay.arrivals import Arrival, arrivals, summary
from rass_mav.lab.replay.recording import read_logs
from rass_mav.lab.replay.settings import load_settings
from rass_mav.lab.replay.world import Projection, ReplaySwarm, links
from rass_mav.lab.swarm.invariants import check
from tests.extent import examples
from tests.some import some

from .logs import GROUND, START, Said, place, vehicle, write


def swarm_of(folder: Path, *vehicles: list[Said], keys: tuple[str, ...] = (), **options: Any) -> ReplaySwarm:
    """A swarm of logs, one vehicle each."""
    drain = options.pop("drain", 0)
    range_m = options.pop("range_m", None)
    recording = read_logs([write(folder / f"{n}.tlog", said) for n, said in enumerate(vehicles, start=1)])
    chosen, scale = load_settings(range_m, keys)
    if scale:
        chosen = chosen.with_highest(recording.highest)
    swarm = ReplaySwarm(recording, chosen, **options)
    swarm.run(swarm.span_steps, after=check)
    swarm.drain(drain, after=check)
    return swarm


def line(nodes: int, seconds: int = 60) -> list[list[Said]]:
    """Vehicles 10 m apart in a row that begins at home."""
    return [vehicle(n, seconds, x=10.0 * n, height=0.0, home=(0, 0) if n == 1 else None) for n in range(1, nodes + 1)]


def rows_of(swarm: ReplaySwarm, origin: int) -> list[Arrival]:
    return [row for row in arrivals(swarm) if row.origin == origin]


@pytest.mark.no_cover
def test_readings_reach_the_base_over_several_hops_with_their_positions(tmp_path: Path) -> None:
    swarm = swarm_of(tmp_path, *line(4), range_m=12.0, keys=("node.forward=step", "node.phases=lockstep"))
    result = summary(swarm, arrivals(swarm))
    assert result["topology"] == "replay"
    assert (result["nodes"], result["bases"], result["steps"]) == (5, 1, 61)
    assert result["created"] == 4 * 6
    assert result["delivered"] >= 20
    assert result["records"] == {"read": 4 * 180 + 1, "used": 4 * 180 + 1, "rejected": 0}
    assert result["routing"] == {"max_hop_count": 4, "loops": 0}
    for row in rows_of(swarm, 4):
        assert (row.latitude, row.longitude) == pytest.approx(place(40.0, 0.0), abs=2e-7)
        assert row.altitude_m == GROUND
        assert row.hops >= 4
        assert 4.0 <= row.delay_s <= 30.0
        # Made at step 4 + 10 k, of the reading that was recorded 0.8 s before: that of the second before.
        assert row.reading == 2.0 + (4 + 10 * row.sequence - 1)
        assert row.time.endswith(f":{(20 + 4 + 10 * row.sequence) % 60:02d}.000Z")
    assert len(rows_of(swarm, 4)) >= 4


def test_a_vehicle_without_a_reading_makes_data_all_the_same_at_the_worst_risk(tmp_path: Path) -> None:
    swarm = swarm_of(tmp_path, vehicle(1, 30, x=5, home=(0, 0), reading=lambda t: None))
    rows = arrivals(swarm)
    assert len(rows) == 3
    assert {(row.reading, row.risk) for row in rows} == {(None, 1.0)}
    assert all(row.latitude is not None for row in rows)
    result = summary(swarm, rows)
    assert (result["delivered_with_reading"], result["delivered_with_position"]) == (0, 3)
    assert result["readings"] is None


def test_a_reading_that_stops_is_unknown_after_a_while(tmp_path: Path) -> None:
    swarm = swarm_of(tmp_path, vehicle(1, 60, x=5, home=(0, 0), reading=lambda t: 3.0 if t < 15 else None))
    readings = [row.reading for row in arrivals(swarm)]
    # Steps 1, 11, 21, ...; at step 21 the last reading is 6.8 s old, at step 31 16.8 s.
    assert readings == [3.0, 3.0, 3.0, None, None, None]


def test_risk_is_scaled_to_the_largest_reading_unless_it_is_set(tmp_path: Path) -> None:
    flight = vehicle(1, 60, x=5, home=(0, 0), reading=lambda t: 4.0 if t < 30 else 8.0)
    at_once = ("risk.gain=1",)
    assert [row.risk for row in arrivals(swarm_of(tmp_path, flight, keys=at_once))] == pytest.approx(
        [0.5] * 3 + [1.0] * 3, abs=1e-4
    )
    keys = ("risk.low=2", "risk.high=22", *at_once)
    rows = arrivals(swarm_of(tmp_path, flight, keys=keys))
    assert [row.risk for row in rows] == pytest.approx([0.1] * 3 + [0.3] * 3, abs=1e-4)
    # A low above all readings: none of them is a risk.
    assert [row.risk for row in arrivals(swarm_of(tmp_path, flight, keys=("risk.low=50",)))] == [0.0] * 6


def test_before_its_first_fix_a_vehicle_is_out_of_range(tmp_path: Path) -> None:
    swarm = swarm_of(tmp_path, vehicle(1, 60, x=5, home=(0, 0), fix_after=35))
    rows = arrivals(swarm)
    assert [row.latitude is None for row in rows] == [True] * 4 + [False] * 2
    # What was made without a fix waited for the link.
    assert min(row.delay_s + 1 + 10 * row.sequence for row in rows) >= 35.0


def test_a_vehicle_whose_log_has_ended_is_out_of_range_and_lives_on(tmp_path: Path) -> None:
    stays = vehicle(1, 100, x=5, home=(0, 0))
    swarm = swarm_of(tmp_path, stays, vehicle(2, 30, x=6))
    rows = rows_of(swarm, 2)
    # The last record is of 29.2 s: until 39.2 s it is heard.
    assert [row.sequence for row in rows] == [0, 1, 2, 3]
    result = summary(swarm, arrivals(swarm))
    assert (result["created"], result["held"]) == (10 + 4, 0), "nothing is measured without position and reading"
    assert swarm.agents[2].node.routing.hops == NO_ROUTE


def test_a_vehicle_whose_heartbeats_are_lost_is_heard_all_the_same(tmp_path: Path) -> None:
    said = [s for s in vehicle(1, 30, x=5, home=(0, 0)) if s[1][7] != 0]
    rows = arrivals(swarm_of(tmp_path, said))
    assert [row.reading for row in rows] == [2.0, 12.0, 22.0]


def test_a_vehicle_that_comes_later_joins(tmp_path: Path) -> None:
    swarm = swarm_of(tmp_path, vehicle(1, 60, x=5, home=(0, 0)), vehicle(2, 60, x=6, begin=30))
    assert {row.sequence for row in rows_of(swarm, 2)} == {0, 1, 2}


def test_the_base_stands_where_it_is_told(tmp_path: Path) -> None:
    flight = vehicle(1, 40, x=5, home=(0, 0))
    far = swarm_of(tmp_path, flight, base=place(5000, 0))
    assert summary(far, arrivals(far))["delivered"] == 0
    assert some(far.base).altitude == GROUND
    near = swarm_of(tmp_path, flight, base=place(60, 0), range_m=60.0)
    assert summary(near, arrivals(near))["delivered"] >= 3


def test_without_any_position_nobody_is_in_range(tmp_path: Path) -> None:
    swarm = swarm_of(tmp_path, vehicle(1, 30, fix_after=99), vehicle(2, 30, fix_after=99))
    result = summary(swarm, arrivals(swarm))
    assert (result["created"], result["delivered"], result["held"]) == (6, 0, 6)
    assert result["base"] is None
    assert result["frames"]["received"] == 0


def test_height_counts_as_distance(tmp_path: Path) -> None:
    high = vehicle(1, 30, x=0, height=40.0, home=(0, 0))
    assert swarm_of(tmp_path, high, range_m=39.0).ledger.arrived == {}
    assert len(swarm_of(tmp_path, high, range_m=41.0).ledger.arrived) == 3


@pytest.mark.no_cover
def test_draining_brings_home_what_was_on_its_way(tmp_path: Path) -> None:
    flights = line(6, seconds=66)
    keys = ("node.forward=step",)
    left = swarm_of(tmp_path, *flights, range_m=12.0, keys=keys)
    assert left.ledger.held > 0
    created = left.ledger.created
    drained = swarm_of(tmp_path, *flights, range_m=12.0, keys=keys, drain=500)
    assert drained.ledger.held == 0
    assert drained.ledger.created == len(drained.ledger.arrived) == created
    assert drained.t < drained.span_steps + 500


def test_while_it_drains_a_swarm_stays_where_the_logs_left_it(tmp_path: Path) -> None:
    # In range for its last second only, with forty data of which it can send one a step.
    keys = ("data.interval_steps=1", "store.bandwidth_items=1")
    swarm = swarm_of(tmp_path, vehicle(1, 40, x=5, home=(0, 0), fix_after=39), keys=keys, drain=60)
    assert swarm.ledger.held == 0
    assert len(swarm.ledger.arrived) == swarm.span_steps - 1, "at the first step nothing has been heard"


def test_corruption_strikes_only_when_asked(tmp_path: Path) -> None:
    flights = [vehicle(1, 60, x=5000, home=(0, 0), reading=lambda t: 5.0)]
    for keys, corrupted in (((), False), (("radiation.corruption=true", "risk.high=10"), True)):
        lost = swarm_of(tmp_path, *flights, keys=keys).ledger.losses()
        assert bool(lost["corrupted"]) == corrupted
    silent = [vehicle(1, 60, x=5000, home=(0, 0), reading=lambda t: None)]
    unknown = swarm_of(tmp_path, *silent, keys=("radiation.corruption=true",))
    assert unknown.ledger.losses()["corrupted"] == 0


def test_each_node_speaks_with_the_system_id_of_its_vehicle(tmp_path: Path) -> None:
    said: list[bytes] = []
    swarm_of(
        tmp_path, vehicle(42, 20, x=5, home=(0, 0)), vehicle(42, 20, x=6), record=lambda frame, step: said.append(frame)
    )
    assert {frame[5] for frame in said} == {255, 42}


def test_logs_that_do_not_belong_together_are_refused(tmp_path: Path) -> None:
    later = [(at + 3e7, frame) for at, frame in vehicle(2, 5)]
    recording = read_logs([write(tmp_path / "a.tlog", vehicle(1, 5)), write(tmp_path / "b.tlog", later)])
    chosen, _ = load_settings()
    with pytest.raises(LogError, match=r"span 347\.2 days"):
        ReplaySwarm(recording, chosen)


@pytest.mark.parametrize(
    ("keys", "match"),
    [
        (("topology=grid",), "replay: topology: unknown key"),
        (("risk.high=0",), r"replay: risk\.high: expected a number above risk\.low"),
        (("risk=7",), "replay: risk: expected"),
        (("risk.low=ten",), r"replay: risk\.low: expected a number"),
        (("policy.name=best",), r"replay: policy\.name"),
    ],
)
def test_settings_that_make_no_sense(keys: tuple[str, ...], match: str) -> None:
    with pytest.raises(ConfigError, match=match):
        load_settings(None, keys)
    with pytest.raises(ConfigError, match=r"radio\.range_m"):
        load_settings(-1.0)


@pytest.mark.no_cover
@settings(max_examples=examples(15), deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_the_invariants_hold_on_any_flight(tmp_path: Path, data: Any) -> None:
    draw = data.draw
    flights = [
        vehicle(
            draw(st.integers(1, 3)),
            draw(st.integers(12, 40)),
            x=draw(st.integers(-60, 60)),
            y=draw(st.integers(-60, 60)),
            fix_after=draw(st.integers(0, 20)),
            begin=draw(st.integers(0, 10)),
            home=draw(st.sampled_from([None, (0, 0)])),
        )
        for _ in range(draw(st.integers(1, 5)))
    ]
    keys = (
        f"radio.loss={draw(st.sampled_from([0, 0.3]))}",
        f"radio.duplicate={draw(st.sampled_from([0, 0.2]))}",
        f"store.capacity_items={draw(st.integers(1, 5))}",
        f"data.interval_steps={draw(st.integers(1, 8))}",
        f"radiation.corruption={draw(st.booleans())}",
        f"seed={draw(st.integers(0, 99))}",
    )
    swarm = swarm_of(tmp_path, *flights, keys=keys, range_m=draw(st.sampled_from([20.0, 50.0])), drain=20)
    summary(swarm, arrivals(swarm))


@given(st.floats(-70, 70), st.floats(-180, 180), st.floats(-9000, 9000), st.floats(-9000, 9000))
def test_projected_distances_are_right_to_one_percent(lat: float, lon: float, north: float, east: float) -> None:
    there_lat = lat + math.degrees(north / 6_371_000)
    there_lon = lon + math.degrees(east / (6_371_000 * math.cos(math.radians(lat))))
    there_lon = (there_lon + 180) % 360 - 180  # across the date line too
    x, y, _ = Projection(lat, lon, 0.0).point(there_lat, there_lon, 0.0)
    p, q = math.radians(lat), math.radians(there_lat)
    half = math.radians(there_lon - lon) / 2
    haversine = math.sin((q - p) / 2) ** 2 + math.cos(p) * math.cos(q) * math.sin(half) ** 2
    true = 2 * 6_371_000 * math.asin(math.sqrt(haversine))
    assert math.hypot(x, y) == pytest.approx(true, rel=0.01, abs=0.01)


@given(st.lists(st.one_of(st.none(), st.tuples(*[st.integers(-50, 50)] * 3)), max_size=12), st.integers(1, 60))
def test_links_are_those_within_range(points: list[Any], range_m: int) -> None:
    def near(a: Any, b: Any) -> bool:
        return a is not None and b is not None and math.dist(a, b) <= range_m + 1e-9

    expected = [[j for j, there in enumerate(points) if j != i and near(here, there)] for i, here in enumerate(points)]
    assert links(points, range_m) == expected


def test_virtual_time_begins_with_the_first_record(tmp_path: Path) -> None:
    swarm = swarm_of(tmp_path, vehicle(1, 12, x=5, home=(0, 0), begin=0))
    assert swarm.recording.start_us == round(START * 1e6)
    assert next(row.time for row in arrivals(swarm)) == "2023-11-14T22:13:21.000Z"

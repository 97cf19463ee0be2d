"""Real autopilots' logs (simulated hardware), which lie beside the repository and are not part of it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import common

from rass_mav.lab.replay.arrivals import arrivals, summary
from rass_mav.lab.replay.recording import Recording, read_logs
from rass_mav.lab.replay.settings import load_settings
from rass_mav.lab.replay.world import ReplaySwarm
from rass_mav.lab.swarm.invariants import check

SITL = Path(__file__).parents[4] / "shared" / "data" / "sitl"
FLIGHT = [str(SITL / "flight-a" / f"vehicle-{n}.tlog") for n in range(1, 10)]
THREE = str(SITL / "copter-3-vehicles.tlog")

pytestmark = pytest.mark.skipif(
    not all(Path(path).exists() for path in [*FLIGHT, THREE]),
    reason="needs ../shared/data/sitl, which is not part of the repository",
)


def played(recording: Recording, range_m: float | None = None, keys: Sequence[str] = ()) -> ReplaySwarm:
    settings, scale = load_settings(range_m, keys)
    swarm = ReplaySwarm(recording, settings.with_highest(recording.highest) if scale else settings)
    swarm.run(swarm.span_steps, after=check)
    return swarm


def told(paths: Sequence[str]) -> list[dict[str, list[tuple[int, tuple[float, ...]]]]]:
    """What pymavlink finds: for each vehicle (time, values) of its positions with a fix and of its readings."""
    found: dict[tuple[str, int], dict[str, list[tuple[int, tuple[float, ...]]]]] = {}
    for path in paths:
        data = Path(path).read_bytes()
        parser = common.MAVLink(None)
        at = 0
        while at < len(data):
            time_us = int.from_bytes(data[at : at + 8], "big")
            end = at + 8 + 12 + data[at + 9]
            message = parser.decode(bytearray(data[at + 8 : end]))
            at = end
            about = found.setdefault((path, message.get_srcSystem()), {"place": [], "reading": []})
            if message.get_type() == "GLOBAL_POSITION_INT" and message.lat:
                about["place"].append((time_us, (message.lat / 1e7, message.lon / 1e7, message.alt / 1e3)))
            if message.get_type() == "NAMED_VALUE_FLOAT" and message.name == "RAD":
                about["reading"].append((time_us, (message.value,)))
    return [found[key] for key in sorted(found)]


def last_before(said: list[tuple[int, tuple[float, ...]]], time_us: int, no_older_than: float) -> tuple[float, ...]:
    known = [values for at, values in said if time_us - no_older_than * 1e6 <= at <= time_us]
    return known[-1] if known else (None,) * 3  # type: ignore[return-value]


@pytest.mark.no_cover
@pytest.mark.parametrize(("paths", "range_m"), [(FLIGHT, 33.0), ([THREE], None)], ids=["flight-a", "three"])
def test_readings_reach_the_base_with_the_positions_of_the_log(paths: list[str], range_m: float | None) -> None:
    swarm = played(read_logs(paths), range_m)
    rows = arrivals(swarm)
    result = summary(swarm, rows)
    assert result["records"]["rejected"] == 0
    assert result["nodes"] == {9: 10, 1: 4}[len(paths)]
    assert sum(result["lost"].values()) == result["altered"] == 0
    assert result["delivered"] >= 0.95 * result["created"]
    assert result["delivered_with_position"] == result["delivered_with_reading"] >= 0.85 * result["created"]
    logs = told(paths)
    start_us = swarm.recording.start_us
    for id in swarm.ledger.arrived:
        row = next(row for row in rows if (row.origin, row.sequence) == (id.origin, id.sequence))
        made_us = start_us + round(swarm.ledger.born[id] * swarm.step_s * 1e6)
        log = logs[id.origin - 1]
        # A place stays known for the whole flight, a reading for risk.stale_s.
        latitude, longitude, altitude = last_before(log["place"], made_us, 1e6)
        assert (row.latitude, row.longitude, row.altitude_m) == (latitude, longitude, altitude)
        (reading, *_) = last_before(log["reading"], made_us, 10.0)
        assert row.reading == (None if reading is None else pytest.approx(reading, rel=1e-6))


@pytest.mark.no_cover
def test_nine_vehicles_use_several_hops() -> None:
    swarm = played(read_logs(FLIGHT), 33.0)
    result = summary(swarm, arrivals(swarm))
    # facts.json: the farthest vehicle is 3 to 4 hops from home most of the time.
    assert result["routing"] == {"max_hop_count": 4, "loops": 0}
    assert result["base"]["lat"] == pytest.approx(-35.3632621, abs=1e-6)
    assert result["base"]["lon"] == pytest.approx(149.16523, abs=1e-6)


@pytest.mark.no_cover
def test_truncated_and_damaged_recordings(tmp_path: Path) -> None:
    paths = []
    for n, path in enumerate(FLIGHT):
        data = bytearray(Path(path).read_bytes())
        if n == 2:
            del data[len(data) // 2 + 3 :]
        if n == 4:
            data[50_000:50_400] = bytes(400)
        paths.append(str(tmp_path / f"{n}.tlog"))
        Path(paths[-1]).write_bytes(data)
    recording = read_logs(paths)
    assert [file.rejected for file in recording.files] == [0, 0, 1, 0, 1, 0, 0, 0, 0]
    swarm = played(recording, 33.0)
    assert len(swarm.ledger.arrived) > 150

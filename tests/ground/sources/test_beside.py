"""The process that locates sources, the page that asks it, and the commands."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from rass_mav.cli import main
from rass_mav.core.datum import Datum
from rass_mav.ground.sources import locator as module
from rass_mav.ground.sources.locator import Locator, SourcesError
from rass_mav.wire.measurement import Measurement, encode_measurement
from tests.ground.missions import Base

pytest.importorskip("numpy", reason="numpy is not installed (extra ground)")

from rass_mav.core.datum import Kind
from rass_mav.ground.sources.estimate import estimate

from .flown import earth, flown, inside

ONE = (-40.0, 30.0, 3000.0)


def arrivals(base: Base, *, until: int | None = None) -> list[Datum]:
    """The measurements of a flight over one source."""
    found = []
    for number, sample in enumerate(flown([ONE])[:until]):
        measured = Measurement(
            sample.latitude, sample.longitude, sample.altitude, sample.value, 0.0, unit="usvh", error_m=4.0
        )
        found.append(base.datum(sample.drone, number, Kind.MEASUREMENT, encode_measurement(measured)))
    return found


@pytest.fixture
def store(tmp_path: Path) -> Path:
    base = Base(tmp_path / "rass-1.db")
    base.arrive(*arrivals(base))
    base.close()
    return base.path


# -- the process -------------------------------------------------------------------------------------------------------


def test_the_process_answers_as_the_estimate_does_here() -> None:
    locator = Locator()
    samples = flown([ONE])
    try:
        assert locator.ask("usvh", samples)[0] == json.loads(json.dumps(estimate("usvh", samples).plain()))
        pid = locator.pid
        assert locator.ask("usvh", samples[:5])[0]["verdict"] == "too few readings"
        assert locator.pid == pid
    finally:
        locator.close()


def test_a_process_that_was_killed_is_started_again() -> None:
    locator = Locator()
    try:
        locator.ask("usvh", [])
        assert locator.pid is not None
        os.kill(locator.pid, signal.SIGKILL)
        with pytest.raises(SourcesError, match="has ended; it is started again"):
            locator.ask("usvh", flown([ONE]))
        assert locator.ask("usvh", [])[0]["verdict"] == "too few readings"
    finally:
        locator.close()
    with pytest.raises(SourcesError):
        locator.ask("usvh", [])


@pytest.mark.skipif(sys.platform != "linux", reason="counts the threads in /proc")
def test_the_process_has_one_thread() -> None:
    """More of them, as many as there are cores, would wait for each other at full speed on a busy computer."""
    locator = Locator()
    try:
        locator.ask("usvh", flown([ONE]))
        assert len(os.listdir(f"/proc/{locator.pid}/task")) == 1
    finally:
        locator.close()


def test_a_report_estimates_in_that_process(store: Path) -> None:
    program = "import sys; from rass_mav.cli import main; main(); sys.exit('numpy' in sys.modules)"
    for command in ("report", "sources"):
        subprocess.run([sys.executable, "-c", program, command, str(store)], check=True)


def test_without_numpy_it_says_what_is_missing(monkeypatch: pytest.MonkeyPatch, store: Path) -> None:
    monkeypatch.setattr(module, "find_spec", lambda name: None)
    with pytest.raises(SourcesError, match="needs the Python package numpy: pip install"):
        Locator().ask("usvh", [])
    assert main(["sources", str(store)]) == 1


def test_without_numpy_a_report_goes_without(
    monkeypatch: pytest.MonkeyPatch, store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(module, "find_spec", lambda name: None)
    assert main(["report", str(store), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["sources"] is None


# -- commands ----------------------------------------------------------------------------------------------------------


def test_sources_prints_places_and_writes_geojson(
    store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "sources.geojson"
    assert main(["sources", str(store), "--geojson", str(out)]) == 0
    text = capsys.readouterr().out
    assert text.startswith("sources: 1 located, from 480 readings of 4 drones")
    assert "with 95 % within" in text
    point, region = json.loads(out.read_text())["features"]
    assert (point["geometry"]["type"], region["geometry"]["type"]) == ("Point", "MultiPolygon")
    (polygon,) = region["geometry"]["coordinates"]
    (ring,) = polygon
    assert ring[0] == ring[-1]
    assert inside([(latitude, longitude) for longitude, latitude in ring], earth(*ONE[:2]))
    assert point["properties"]["unit"] == "usvh"
    # Nothing is overwritten.
    assert main(["sources", str(store), "--geojson", str(out)]) == 2


def test_sources_takes_the_filters_of_export(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sources", str(store), "--drone", "2", "3", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["drones"], found["readings"]) == (2, 240)


def test_an_empty_store_has_too_few_readings(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    base = Base(tmp_path / "rass-1.db")
    base.close()
    assert main(["sources", str(base.path)]) == 0
    assert capsys.readouterr().out.startswith("sources: too few readings: 0 readings with a place")


def test_the_report_has_the_sources(store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "mission.html"
    assert main(["report", str(store), "--html", str(out)]) == 0
    assert "sources: 1 located" in capsys.readouterr().out
    page = out.read_text()
    assert "<h2>Sources</h2>" in page
    assert "<polygon points=" in page


# -- the page ----------------------------------------------------------------------------------------------------------


async def test_the_page_estimates_again_when_readings_come_and_says_when_the_process_has_ended(tmp_path: Path) -> None:
    pytest.importorskip("aiohttp", reason="aiohttp is not installed (extra ground)")
    from tests.ground.page.serving import events, serving

    base = Base(tmp_path / "rass-1.db")
    all_data = arrivals(base)
    base.arrive(*all_data[:20])
    async with serving(base.path) as (page, client):
        news = events(client.session, str(client.make_url("/api/events")))

        async def sources() -> dict[str, object]:
            async for kind, data in news:
                if kind == "sources":
                    found: dict[str, object] = json.loads(data)["sources"]
                    return found
            raise AssertionError("the page has ended")

        first = await sources()
        assert isinstance(first["estimate"], dict)
        assert first["estimate"]["verdict"] == "too few readings"
        # The process ends while new readings come: the page says so, keeps the old estimate, and then has the new one.
        assert page.locator.pid is not None
        os.kill(page.locator.pid, signal.SIGKILL)
        base.arrive(*all_data[20:])
        lost = await sources()
        assert lost["trouble"] == "the process that locates sources has ended; it is started again"
        assert lost["estimate"] == first["estimate"]
        found = await sources()
        assert found["trouble"] == ""
        assert isinstance(found["estimate"], dict)
        assert len(found["estimate"]["sources"]) == 1
        async with client.get("/api/mission") as answer:
            assert (await answer.json())["sources"] == found
        await news.aclose()
    base.close()

"""The benchmark of the page runs, with few data."""

from __future__ import annotations

import json

import pytest

pytest.importorskip("aiohttp", reason="aiohttp is not installed (extra ground)")
pytest.importorskip("playwright.sync_api", reason="playwright is not installed (extra dev)")

from benchmarks.page import CHROMIUM, delays, main

pytestmark = [pytest.mark.no_cover, pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")]


def test_it_measures_each_aim(capsys: pytest.CaptureFixture[str]) -> None:
    main(["--drones", "20", "--data", "400", "--seconds", "1", "--json"])
    results = json.loads(capsys.readouterr().out)
    assert 400 <= results["archived"] < 420
    # In turn: without the page, while the browser warms up, and with it.
    assert results["received"] == 60
    assert 0 < results["drawn_ms"]["median"] <= results["drawn_ms"]["most"]
    assert 0 < results["to_page_s"]["median"] <= results["to_page_s"]["most"]
    assert results["browser_share"] > 0
    assert {"server_share", "late_steps", "late_steps_alone", "load"} <= set(results)


def test_each_datum_is_counted_from_its_arrival() -> None:
    assert delays([1.0, 2.0, 3.0, 3.5], [(0.5, 1), (3.25, 2), (4.0, 4)]) == [1.25, 1.0, 0.5]

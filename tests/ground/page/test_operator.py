"""What an operator does around the map, in a real browser: sorts, compares, measures, saves, prints."""

from __future__ import annotations

import csv
import io
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from rass_mav.ground.archive import Archive
from tests.environment import environment
from tests.ground.missions import HERE, Base
from tests.patience import PATIENCE_S
from tests.some import some

from . import test_browser as browsing
from .flights import Flight

from playwright.sync_api import Browser, Page, expect  # isort: skip

browser, flight = browsing.browser, browsing.flight
pytestmark = browsing.pytestmark


def ids(page: Page) -> list[int]:
    """The drones of the table, from above."""
    found: list[int] = page.evaluate(
        "[...document.querySelectorAll('#drones [data-drone]')].map((b) => +b.dataset.drone)"
    )
    return found


def sort(page: Page, name: str) -> None:
    page.locator("#drones thead button", has_text=re.compile(f"^{name} ")).click()


# -- the table ---------------------------------------------------------------------------------------------------------


def test_the_table_is_sorted_by_keyboard(browser: Browser, tmp_path: Path) -> None:
    with (
        browsing.mission(tmp_path) as base,
        browsing.served(base.path, now=lambda: base.wall) as url,
        browsing.opened(browser, url) as page,
    ):
        expect(page.locator("#drones tbody tr")).to_have_count(5)
        assert ids(page) == [1, 2, 3, 4, 5]
        heads = page.locator("#drones th")
        expect(heads.nth(0)).to_have_attribute("aria-sort", "ascending")
        # The level that needs attention most comes first, then that which needs none.
        heads.nth(0).locator("button").focus()
        page.keyboard.press("Tab")
        page.keyboard.press("Enter")
        expect(heads.nth(1)).to_have_attribute("aria-sort", "descending")
        assert page.locator("#drones [aria-sort]").count() == 1
        assert ids(page) == [3, 5, 1, 2, 4]
        page.keyboard.press("Space")
        expect(heads.nth(1)).to_have_attribute("aria-sort", "ascending")
        assert ids(page) == [1, 2, 4, 3, 5]
        # Heard: the one that is silent for longest; store: the fullest, and what is unknown last.
        sort(page, "Heard")
        assert ids(page) == [3, 5, 1, 2, 4]
        sort(page, "Store")
        assert ids(page)[0] == 5
        # Drone 3 had 9 data in custody and room for 5,000; drone 5 has none left.
        rows = page.locator("#drones tbody tr")
        expect(rows.nth(0)).to_contain_text("100 %9 data")
        expect(rows.nth(0)).to_contain_text("80 %")


def test_the_focus_stays_in_a_row_that_moves(browser: Browser, tmp_path: Path) -> None:
    base = Base(tmp_path / "rass-1.db")
    base.arrive(*(base.measurement(id, 0, HERE, age_s=100.0 - id) for id in (7, 8, 9)))
    with browsing.served(base.path, now=lambda: base.wall) as url, browsing.opened(browser, url) as page:
        expect(page.locator("#drones tbody tr")).to_have_count(3)
        sort(page, "Heard")
        assert ids(page) == [7, 8, 9]
        page.locator("#drones button[data-drone='7']").focus()
        base.arrive(base.measurement(7, 1, HERE))
        page.wait_for_function(
            "() => document.querySelector('#drones tbody tr:last-child [data-drone]').dataset.drone === '7'"
        )
        assert page.evaluate("document.activeElement.dataset.drone") == "7"
    base.close()


def test_the_table_is_filtered(browser: Browser, tmp_path: Path) -> None:
    with (
        browsing.mission(tmp_path) as base,
        browsing.served(base.path, now=lambda: base.wall) as url,
        browsing.opened(browser, url) as page,
    ):
        expect(page.locator("#drones-count")).to_have_text("5 shown")
        for text, shown in {
            "alarm": [3, 5],
            "4, 2": [2, 4],
            "base": [1],
            "ALA": [3, 5],
            "44": [],
            "<b>": [],
            "": [1, 2, 3, 4, 5],
        }.items():
            page.locator("#drones-filter").fill(text)
            assert ids(page) == shown
        page.locator("#drones-attention").check()
        expect(page.locator("#drones-count")).to_have_text("2 of 5 shown")
        assert ids(page) == [3, 5]
        # It is over: it leaves the list, and comes back with the next alarm.
        base.arrive(base.measurement(3, 900, HERE))
        expect(page.locator("#drones-count")).to_have_text("1 of 5 shown")
        assert ids(page) == [5]


def test_with_300_drones_a_second_changes_few_rows(browser: Browser, tmp_path: Path) -> None:
    base = Base(tmp_path / "many.db")
    base.arrive(*(base.measurement(id, 0, HERE, age_s=id / 10) for id in range(2, 302)))
    with browsing.served(base.path, now=lambda: base.wall) as url, browsing.opened(browser, url) as page:
        expect(page.locator("#drones tbody tr")).to_have_count(300)
        found = page.evaluate(
            """() => new Promise((done) => {
              const touched = new Set();
              let moved = 0;
              new MutationObserver((changes) => {
                for (const { type, target } of changes) {
                  if (target.tagName === "TBODY") moved += 1;
                  touched.add((target.nodeType === Node.TEXT_NODE ? target.parentNode : target).closest("tr"));
                }
                if (touched.size) setTimeout(() => done([touched.size, moved]), 1500);
              }).observe(document.querySelector("#drones tbody"),
                { subtree: true, childList: true, characterData: true });
            })"""
        )
        assert 0 < found[0] < 40, "only the rows that can be seen"
        assert found[1] == 0, "no row is made again, none is moved"
        # A row further down is right when somebody gets there.
        base.arrive(base.measurement(301, 1, HERE))
        expect(page.locator("#n-arrived")).to_have_text("301")
        last = page.locator("#drones tbody tr").last
        last.scroll_into_view_if_needed()
        expect(last).to_contain_text("2of 2")
        page.locator("#drones-filter").fill("299")
        expect(page.locator("#drones tbody tr")).to_have_count(1)
    base.close()


# -- the chart of several drones ---------------------------------------------------------------------------------------


def test_readings_of_several_drones_in_one_chart(browser: Browser, flight: Flight) -> None:
    counts = HERE._replace(unit="cpm", reading=0.0)
    flight.base.arrive(*(flight.base.measurement(2, 900 + n, counts, age_s=5.0 * n) for n in range(3)))
    with browsing.served(flight.base.path) as url, browsing.opened(browser, url) as page:
        chips = page.locator("#compare-drones button")
        expect(chips).to_have_count(4)
        labels = page.locator("#compare-chart .u-legend .u-label")
        expect(labels).to_have_text(
            ["Time", *[some(chip.text_content()).removesuffix("\u00d7") for chip in chips.all()]]
        )
        # Others come and go by keyboard.
        first = some(chips.nth(0).text_content())
        chips.nth(0).focus()
        page.keyboard.press("Enter")
        expect(chips).to_have_count(3)
        page.locator("#compare-add").select_option(re.sub("[^0-9]", "", first))
        expect(chips).to_have_count(4)
        expect(labels.last).to_have_text(first.removesuffix("\u00d7"))
        browsing.shoot(page, "operator-compare")
        # One unit at a time; zero has no place on a logarithmic scale, and on the other one it has.
        page.locator("#compare-unit").select_option("cpm")
        expect(page.locator("#compare-note")).to_contain_text("3 readings of 0 or less")
        expect(page.locator("#compare-chart")).to_have_text("No readings.")
        page.locator("#compare-log").uncheck()
        expect(page.locator("#compare-chart canvas")).to_have_count(1)
        expect(page.locator("#compare-note")).to_have_text("0 to 0 cpm.")


def test_a_chart_has_a_bound(browser: Browser, tmp_path: Path) -> None:
    base = Base(tmp_path / "rass-1.db")
    base.arrive(*(base.measurement(id, 0, HERE._replace(reading=10.0**id)) for id in range(2, 14)))
    with browsing.served(base.path) as url, browsing.opened(browser, url) as page:
        chips, add = page.locator("#compare-drones button"), page.locator("#compare-add")
        expect(chips).to_have_count(4)
        for count in range(5, 9):
            add.select_option(str(count - 3))
            expect(chips).to_have_count(count)
        expect(add).to_be_disabled()
        expect(add).to_contain_text("8 drones at most")
        expect(page.locator("#compare-chart .u-legend .u-label")).to_have_count(9)
    base.close()


@pytest.mark.no_cover
@pytest.mark.parametrize("size", [browsing.DESK, browsing.PHONE], ids=["desk", "phone"])
def test_no_label_of_an_axis_is_cut(browser: Browser, tmp_path: Path, size: dict[str, int]) -> None:
    base = Base(tmp_path / "rass-1.db")
    for n in range(30):
        base.wall += 60.0
        base.arrive(
            *(base.measurement(id, n, HERE._replace(reading=98_765.0 * (n + 1) / 30), age_s=90_000.0) for id in (7, 8))
        )
    base.arrive(*(base.measurement(9, n, HERE._replace(reading=54_321.0)) for n in range(12_345)))
    with browsing.served(base.path) as url, browsing.opened(browser, url, size=size) as page:
        page.locator("#compare-log").uncheck()
        page.locator("#drones button[data-drone='7']").click()
        for chart in ("arrivals", "compare-chart", "drone-readings"):
            page.locator(f"#{chart} canvas").scroll_into_view_if_needed()
            # A label that is cut leaves ink at an edge of the canvas.
            inked = page.locator(f"#{chart} canvas").evaluate(
                """(canvas) => {
                  const copy = new OffscreenCanvas(canvas.width, canvas.height);
                  const pen = copy.getContext("2d", { willReadFrequently: true });
                  pen.drawImage(canvas, 0, 0);
                  const [right, below] = [canvas.width - 1, canvas.height - 1];
                  const edges = [[0, 0, 1, below], [right, 0, 1, below], [0, 0, right, 1], [0, below, right, 1]];
                  const ink = (value, at) => at % 4 === 3 && value > 0;
                  return edges.map((edge) => pen.getImageData(...edge).data.some(ink));
                }"""
            )
            assert inked == [False] * 4, chart
        browsing.shoot(page, f"operator-axes-{size['width']}")
    base.close()


# -- measuring ---------------------------------------------------------------------------------------------------------


def metres(page: Page) -> float:
    return float(some(page.locator("#measured").text_content()).split(" m")[0].replace(",", ""))


def test_distances_are_measured(browser: Browser, tmp_path: Path) -> None:
    base = Base(tmp_path / "rass-1.db")
    # 222 m north of each other.
    base.arrive(*(base.measurement(id, 0, HERE._replace(latitude=47.0 + id / 1000)) for id in (1, 3)))
    with browsing.served(base.path) as url, browsing.opened(browser, url) as page:
        expect(page.locator(".mark")).to_have_count(2)
        page.locator("#measure").click()
        expect(page.locator("#measure")).to_have_attribute("aria-pressed", "true")
        for id in (1, 3):
            page.locator(f".mark[aria-label^='Drone {id},']").click()
        expect(page.locator("#measured")).to_have_text(re.compile("^22[0-9] m$"))
        assert metres(page) == pytest.approx(222.4, abs=3.0)
        expect(page.locator("#drone")).to_be_hidden()
        box = some(page.locator("#map").bounding_box())
        page.mouse.click(box["x"] + 100, box["y"] + box["height"] / 2)
        expect(page.locator("#measured")).to_contain_text("the last part ")
        # To move the map is not to measure.
        before = page.locator("#measured").text_content()
        page.mouse.move(box["x"] + 200, box["y"] + 200)
        page.mouse.down()
        page.mouse.move(box["x"] + 300, box["y"] + 250, steps=5)
        page.mouse.up()
        assert page.locator("#measured").text_content() == before
        browsing.shoot(page, "operator-measure")
        page.keyboard.press("Escape")
        expect(page.locator("#measured")).to_be_hidden()
        expect(page.locator("#measure")).to_have_attribute("aria-pressed", "false")
        page.locator(".mark[aria-label^='Drone 1,']").click()
        expect(page.locator("#drone-title")).to_have_text("Drone 1")
        # By keyboard: from mark to mark.
        page.keyboard.press("Escape")
        page.locator("#measure").focus()
        page.keyboard.press("Enter")
        for id in (1, 3):
            page.locator(f".mark[aria-label^='Drone {id},']").focus()
            page.keyboard.press("Enter")
        assert metres(page) == pytest.approx(222.4, abs=3.0)
    base.close()


# -- saving and printing -----------------------------------------------------------------------------------------------


def test_data_are_saved(browser: Browser, flight: Flight) -> None:
    with browsing.served(flight.base.path) as url, browsing.opened(browser, url) as page:
        browsing.wait_for_data(page, flight)
        assert {"CSV", "GeoPackage"} <= set(page.locator("#save-formats button").all_text_contents())
        with page.expect_download() as waiting:
            page.locator("#save-formats button", has_text="CSV").click()
        saved = waiting.value
        assert saved.suggested_filename.endswith("-rass-1.csv")
        rows = list(csv.DictReader(io.StringIO(Path(saved.path()).read_text(encoding="utf-8-sig"))))
        assert len(rows) == browsing.arrived(flight)
        expect(page.locator("#save-note")).to_have_text(f"Saved {saved.suggested_filename}.")
        expect(page.locator("#save-formats button").first).to_be_enabled()


def test_that_nothing_is_saved_is_said(browser: Browser, tmp_path: Path) -> None:
    base = Base(tmp_path / "rass-1.db")
    base.arrive(base.file(7, 0, "a.txt", b"x"))
    with browsing.served(base.path) as url, browser.new_page() as page:
        page.goto(url)
        page.locator("#save-formats button", has_text="KML").click()
        expect(page.locator("#save-note")).to_contain_text("KML was not saved: nothing to export: 1")
        expect(page.locator("#save-formats button", has_text="KML")).to_be_focused()
    base.close()


PRINTED = """() => {
  const map = document.querySelector("#map").getBoundingClientRect();
  const all = (selector) => [...document.querySelectorAll(selector)];
  const whole = (mark) => {
    const box = mark.getBoundingClientRect();
    return box.left >= map.left && box.right <= map.right && box.top >= map.top && box.bottom <= map.bottom;
  };
  const cut = (e) => e.checkVisibility() && getComputedStyle(e).overflow !== "visible"
    && e.scrollHeight > e.clientHeight + 1 && !e.closest("#map, .unseen");
  return {
    theme: document.documentElement.dataset.theme,
    map: [map.width, map.height],
    marks: all(".mark:not(.grouped)").every(whole),
    clipped: all("body *").filter(cut).map((e) => e.outerHTML.slice(0, 80)),
    wide: document.body.scrollWidth,
    buttons: all("button:not(#drones button, #compare-drones button)").filter((e) => e.checkVisibility())
      .map((e) => e.id),
    key: document.querySelector("#legend .ramp").checkVisibility(),
    lines: Math.max(...all("#drones tbody tr").map((row) => row.getBoundingClientRect().height)),
    exact: all(".ramp, #drones button, #drones tr").every((e) => getComputedStyle(e).printColorAdjust === "exact"),
  };
}"""


def test_paper_has_all_of_it(browser: Browser, tmp_path: Path) -> None:
    flight = Flight(tmp_path / "survey.db", drones=100)
    flight.fly(120)
    with (
        browsing.served(flight.base.path, now=lambda: flight.base.wall) as url,
        browsing.opened(browser, url, scheme="dark") as page,
    ):
        browsing.wait_for_data(page, flight)
        centre = page.locator("#map .leaflet-control-scale").inner_text()
        page.emulate_media(media="print")
        page.evaluate("window.dispatchEvent(new Event('beforeprint'))")
        found = page.evaluate(PRINTED)
        assert found["theme"] == "light"
        assert found["map"][0] > 650
        assert found["marks"], "the whole mission is on the map"
        assert found["clipped"] == []
        assert found["wide"] <= 703
        assert found["buttons"] == []
        assert found["lines"] < 20, "a drone a line"
        assert (found["key"], found["exact"]) == (True, True)
        assert len(ids(page)) > 50
        expect(page.locator("#printed")).to_contain_text("Printed ")
        page.evaluate("window.dispatchEvent(new Event('afterprint'))")
        page.emulate_media(media="screen")
        assert page.evaluate("document.documentElement.dataset.theme") == "dark"
        assert page.locator("#map .leaflet-control-scale").inner_text() == centre
        # The button waits until all is drawn.
        page.evaluate("window.print = () => { window.shown = document.documentElement.className; }")
        page.locator("#print").click()
        page.wait_for_function("() => window.shown === 'printing'")
        page.keyboard.press("Shift")
        assert page.evaluate("document.documentElement.className") == ""
        # Several pages of A4, with the table on more than one.
        page.emulate_media(media="null")
        paper = page.pdf(format="A4")
        assert len(re.findall(rb"/Type\s*/Page\b", paper)) >= 3
        if shutil.which("pdftotext") is None:
            pytest.skip("pdftotext is not installed (Debian: apt install poppler-utils)")
        text = subprocess.run(["pdftotext", "-layout", "-", "-"], input=paper, capture_output=True, check=True).stdout
        sheets = [sheet for sheet in text.decode().split("\f") if "unknown no status" in sheet]
        assert len(sheets) >= 2
        assert all("Lost if it fails now" in sheet for sheet in sheets), "the head of the table is on each page"
    flight.close()


# -- whether the run goes on -------------------------------------------------------------------------------------------


def test_a_store_whose_node_does_not_run_says_so(browser: Browser, tmp_path: Path) -> None:
    base = Base(tmp_path / "zurich.db")
    base.arrive(base.measurement(7, 0, HERE))
    later = 0.0
    with browsing.served(base.path, now=lambda: base.wall + later) as url, browsing.opened(browser, url) as page:
        expect(page.locator("#title")).to_have_text("zurich")
        expect(page).to_have_title("zurich - rass-mav")
        expect(page.locator("#link")).to_have_text("Live")
        later = 3 * 3600.0
        page.reload()
        expect(page.locator("#link")).to_have_text("Not running, last datum 3 h ago")
    base.close()


def test_a_page_that_was_stopped_says_so(browser: Browser, flight: Flight) -> None:
    with browsing.served(flight.base.path) as url:
        context = browser.new_context()
        page = context.new_page()
        page.goto(url)
        browsing.wait_for_data(page, flight)
    expect(page.locator("#link")).to_have_text("The page was stopped: the view is out of date")
    context.close()


def test_a_swarm_that_has_ended_says_so(browser: Browser) -> None:
    words = ["swarm", "islands", "--nodes", "9", "--steps", "60", "--page", "127.0.0.1:0", "--pace", "100000"]
    with subprocess.Popen(
        [sys.executable, "-m", "rass_mav", *words], env=environment(), stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True,
    ) as swarm:  # fmt: skip
        try:
            url = next(line for line in some(swarm.stderr) if line.startswith("http://")).split()[0]
            with browsing.opened(browser, url) as page:
                expect(page.locator("#title")).to_have_text("islands")
                expect(page.locator("#link")).to_have_text(re.compile("^Ended, last datum (at|[0-9]+ s ago)"))
        finally:
            swarm.send_signal(signal.SIGINT)
            swarm.communicate(timeout=PATIENCE_S)


def test_a_store_keeps_that_its_run_has_ended(tmp_path: Path) -> None:
    from rass_mav.cli import main

    store = tmp_path / "swarm.db"
    assert main(["swarm", "demo", "--nodes", "9", "--steps", "20", "--store", str(store)]) == 0
    with Archive(store) as archive:
        assert archive.ended

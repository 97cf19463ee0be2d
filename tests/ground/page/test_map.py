"""What is on the map, in a real browser: contours, hot spots, marks that would hide each other."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from rass_mav.core.datum import Kind
from rass_mav.wire.nodestatus import NodeStatus, encode_status
from tests.ground.missions import HERE, Base
from tests.some import some

pytest.importorskip("aiohttp", reason="aiohttp is not installed (extra ground)")
pytest.importorskip("playwright.sync_api", reason="playwright is not installed (extra dev)")

from playwright.sync_api import Browser, Page, expect

from . import test_browser
from .flights import Flight, place
from .images import image
from .test_browser import PHONE, opened, served, shoot, wait_for_data

browser = test_browser.browser
pytestmark = test_browser.pytestmark


@pytest.fixture
def flight(tmp_path: Path) -> Iterator[Flight]:
    flight = Flight(tmp_path / "rass-1.db", drones=10)
    flight.fly(600)
    yield flight
    flight.close()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_contours_have_a_layer_a_key_and_levels(browser: Browser, flight: Flight, scheme: str) -> None:
    with served(flight.base.path) as url, opened(browser, url, scheme=scheme) as page:
        wait_for_data(page, flight)
        expect(page.locator("#contour-levels")).to_have_text("125100")
        expect(page.locator("#contour-unit")).to_have_text("Lines, uSv/h")
        expect(page.locator(".level")).to_have_text(["1", "25", "100"])
        shoot(page, f"map-contours-{scheme}")
        page.locator("#layers summary").click()
        page.get_by_label("Lines of equal readings").uncheck()
        expect(page.locator(".level")).to_have_count(0)
        page.get_by_label("Lines of equal readings").check()
        expect(page.locator(".level")).to_have_count(3)
        # Long ago there was nothing, so there is no line.
        page.locator("#slider").focus()
        page.keyboard.press("Home")
        expect(page.locator("#past-note")).to_be_visible()
        expect(page.locator(".level")).to_have_count(0)
        expect(page.locator("#contour-scale")).to_be_hidden()


def off_the_middle(page: Page) -> float:
    """How far the first hot spot is from the middle of the map, pixels to the side."""
    shown, box = some(page.locator(".spot").first.bounding_box()), some(page.locator("#map").bounding_box())
    return abs(shown["x"] + shown["width"] / 2 - box["x"] - box["width"] / 2)


def test_who_has_asked_for_a_place_keeps_the_view_while_the_store_is_still_read(
    browser: Browser, flight: Flight
) -> None:
    with served(flight.base.path) as url, opened(browser, url) as page:
        page.add_init_script(
            """const parse = JSON.parse;
            JSON.parse = (text, reviver) => {
                const found = parse(text, reviver);
                if (found && "behind" in found) found.behind = true;
                return found;
            };"""
        )
        page.reload()
        page.locator("#spots li").first.get_by_role("button", name="Show").click()
        page.evaluate("document.getElementById('unit').dispatchEvent(new Event('change'))")
        assert off_the_middle(page) < 3, "the next frame has fitted the map to everything"


def test_the_places_of_hot_spots_are_copied_and_shown(browser: Browser, flight: Flight) -> None:
    with served(flight.base.path) as url, opened(browser, url) as page:
        wait_for_data(page, flight)
        page.context.grant_permissions(["clipboard-read", "clipboard-write"], origin=url)
        rows = page.locator("#spots li")
        expect(rows).to_have_count(page.locator(".spot").count())
        expect(rows.first).to_have_text(re.compile(r"^47\.\d{6}, 8\.\d{6}\d+ uSv/h, drone \d+, .*CopyShow$"))
        written = rows.first.locator("code").inner_text()
        rows.first.get_by_role("button", name="Copy the place of hot spot 1").focus()
        page.keyboard.press("Enter")
        expect(page.locator("#spots-said")).to_have_text(f"Copied: {written}")
        assert page.evaluate("navigator.clipboard.readText()") == written
        # Where there is no clipboard for scripts, as on another computer, the old way is left.
        page.evaluate("Object.defineProperty(navigator, 'clipboard', { value: undefined })")
        rows.first.get_by_role("button", name="Copy").click()
        expect(page.locator("#spots-said")).to_have_text(f"Copied: {written}")
        rows.first.get_by_role("button", name="Show hot spot 1 on the map").click()
        assert off_the_middle(page) < 3
        # The row that has the focus keeps it when the list changes.
        rows.first.get_by_role("button", name="Show").focus()
        flight.base.arrive(
            flight.base.measurement(
                90, 0, HERE._replace(latitude=place(900, 900)[0], longitude=place(900, 900)[1], reading=9e6, risk=1.0)
            )
        )
        expect(rows.first).to_contain_text("drone 90")
        assert page.evaluate("document.activeElement.dataset.act") == "show 1"


def crowd(base: Base, drones: int, *, apart_m: float) -> None:
    """So many drones side by side, and the base."""
    said = NodeStatus(0, 0, 0, None, 0.2, 1, 80, None, {1: 0.9}, {}, next_hop=1)
    for id in range(2, 2 + drones):
        status = said._replace(place=place(200.0, apart_m * (id - drones / 2)), risk=0.3)
        base.arrive(base.datum(id, 0, Kind.STATUS, encode_status(status)))
    base.arrive(base.datum(1, 0, Kind.STATUS, encode_status(said._replace(base=True, place=place(0, 0)))))


def middles(page: Page, which: str) -> list[tuple[float, float, float]]:
    """The middles and the sizes of marks, pixels."""
    found: list[tuple[float, float, float]] = page.evaluate(
        """which => [...document.querySelectorAll(which)].map((e) => e.getBoundingClientRect())
          .map((b) => [b.x + b.width / 2, b.y + b.height / 2, b.width])""",
        which,
    )
    return found


def shown_numbers(page: Page) -> int:
    """How many drones the marks stand for."""
    found: int = page.evaluate(
        """() => [...document.querySelectorAll('.mark:not(.grouped):not(.base)')]
          .map((e) => (e.classList.contains('group') ? parseInt(e.textContent.slice(1)) : 1))
          .reduce((a, b) => a + b, 0)"""
    )
    return found


def test_300_drones_on_a_phone_are_no_blob(browser: Browser, tmp_path: Path) -> None:
    base = Base(tmp_path / "rass-1.db")
    crowd(base, 300, apart_m=12.0)
    with served(base.path, now=lambda: base.wall + 1.0) as url, opened(browser, url, size=PHONE) as page:
        expect(page.locator("#n-arrived")).to_have_text("301")
        expect(page.locator(".mark.group")).not_to_have_count(0)
        assert shown_numbers(page) == 300, "each drone is in one mark"
        expect(page.locator(".mark.base")).to_be_visible()
        marks = middles(page, ".mark:not(.grouped)")
        assert len(marks) < 30
        for number, (x, y, wide) in enumerate(marks):
            for u, v, other in marks[:number]:
                assert ((x - u) ** 2 + (y - v) ** 2) ** 0.5 > (wide + other) / 2 - 12, "none hides another"
        shoot(page, "map-groups-phone")
        # Nearer, some groups are at the edge: whole, or out of view.
        page.locator(".mark.group").nth(page.locator(".mark.group").count() // 2).click(force=True)
        expect(page.locator(".mark.group")).not_to_have_count(0)
        box = some(page.locator("#map").bounding_box())
        for x, y, wide in middles(page, ".mark.group"):
            for at, least, size in ((x, box["x"], box["width"]), (y, box["y"], box["height"])):
                assert not least <= at < least + wide / 2, "cut at the left or above"
                assert not least + size - wide / 2 < at <= least + size, "cut at the right or below"
        shoot(page, "map-groups-edge-phone")
        # With a finger: nearer, until single drones are there.
        for _ in range(12):
            if not page.locator(".mark.group").count():
                break
            page.locator(".mark.group").nth(page.locator(".mark.group").count() // 2).click(force=True)
        expect(page.locator(".mark:not(.grouped):not(.group):not(.base)")).not_to_have_count(0)
    base.close()


def test_a_group_says_how_many_and_the_worst_and_opens_by_keyboard(browser: Browser, tmp_path: Path) -> None:
    base = Base(tmp_path / "rass-1.db")
    crowd(base, 6, apart_m=0.0)
    base.wall += 400.0
    base.arrive(*(base.datum(id, 1, Kind.STATUS, encode_status(NodeStatus(
        0, 0, 0, None, 0.4, 1, 80, place(200.0, 0.0), {1: 0.9}, {}, next_hop=1
    ))) for id in (2, 3, 4, 5, 6)))  # fmt: skip
    with served(base.path, now=lambda: base.wall) as url, opened(browser, url) as page:
        expect(page.locator("#n-arrived")).to_have_text("12")
        group = page.locator(".mark.group")
        expect(group).to_have_count(1)
        expect(group).to_have_text("×6!")
        expect(group).to_have_class(re.compile("alarm"))
        expect(group).to_have_attribute(
            "aria-label", "6 drones: 2, 3, 4, 5, 6, 7, alarm among them, highest risk 0.40. Enter shows them apart."
        )
        group.focus()
        # They are all at one place: at some point coming nearer is no use, and they are spread around it.
        for _ in range(8):
            if not page.locator(".mark.group").count():
                break
            page.keyboard.press("Enter")
        expect(page.locator(".mark.group")).to_have_count(0)
        expect(page.locator(".mark:not(.grouped):not(.base)")).to_have_count(6)
        assert page.evaluate("document.activeElement.getAttribute('aria-label')").startswith("Drone 2,")
        marks = middles(page, ".mark:not(.grouped):not(.base)")
        for number, (x, y, _) in enumerate(marks):
            assert all(((x - u) ** 2 + (y - v) ** 2) ** 0.5 > 20 for u, v, _ in marks[:number])
        shoot(page, "map-spread")
        page.keyboard.press("Enter")
        expect(page.locator("#drone-title")).to_have_text("Drone 2")
        page.keyboard.press("Escape")
        page.locator("#map").focus()
        page.keyboard.press("Escape")
        expect(page.locator(".mark.group")).to_have_count(1)
    base.close()


def test_a_mark_stays_where_the_focus_is_when_drones_come_together(browser: Browser, tmp_path: Path) -> None:
    base = Base(tmp_path / "rass-1.db")
    crowd(base, 2, apart_m=150.0)
    with served(base.path, now=lambda: base.wall) as url, opened(browser, url) as page:
        mark = page.locator(".mark[aria-label^='Drone 3,']")
        mark.focus()
        status = NodeStatus(0, 0, 0, None, 0.2, 1, 80, place(200.0, 150.0), {1: 0.9}, {}, next_hop=1)
        base.wall += 5.0
        base.arrive(*(base.datum(id, 1, Kind.STATUS, encode_status(status)) for id in (2, 3)))
        expect(page.locator(".mark.group")).to_have_text("×2")
        assert page.evaluate("document.activeElement.classList.contains('group')")
    base.close()


def test_the_text_of_the_highest_reading_is_under_no_mark(browser: Browser, tmp_path: Path) -> None:
    base = Base(tmp_path / "rass-1.db")
    hot = HERE._replace(reading=50.0, risk=0.9)
    # The drone is where it was highest, and another one is beside it.
    spots = [(0.0, 0.0), (0.0, 60.0), (300.0, 0.0), (-200.0, -300.0)]
    for number, spot in enumerate(spots):
        latitude, longitude = place(*spot)
        reading = 500.0 if number == 0 else 50.0
        base.arrive(
            base.measurement(7 + number, 0, hot._replace(latitude=latitude, longitude=longitude, reading=reading))
        )
    with served(base.path) as url, opened(browser, url) as page:
        peak = page.locator(".peak")
        expect(peak).to_have_text("max 500 uSv/h")
        for _ in range(3):
            box = some(peak.bounding_box())
            for x, y, _wide in middles(page, ".mark:not(.grouped)"):
                dx = max(box["x"] - x, 0, x - box["x"] - box["width"])
                dy = max(box["y"] - y, 0, y - box["y"] - box["height"])
                assert dx * dx + dy * dy > 12 * 12, "no mark is on it, nor is it on one"
            page.locator(".leaflet-control-zoom-out").click()
            page.wait_for_function("() => !document.querySelector('.leaflet-zoom-anim')")
    base.close()


def test_photographs_and_lines_are_in_a_strip_and_on_the_map(browser: Browser, tmp_path: Path) -> None:
    base = Base(tmp_path / "rass-1.db")
    line = "<img src=x onerror=alert(1)> fire at the north gate"
    base.arrive(
        base.measurement(7, 0, HERE, age_s=60.0), base.measurement(8, 0, HERE._replace(latitude=47.38), age_s=60.0),
        base.file(7, 1, "<b>gate</b>.jpg", image("JPEG", (400, 300))),
        base.datum(8, 1, Kind.BYTES, line.encode(), age_s=30.0),
    )  # fmt: skip
    with served(base.path) as url, opened(browser, url) as page:
        strip = page.locator("#notes button")
        expect(strip).to_have_count(2)
        expect(page.locator(".note-mark")).to_have_count(2)
        page.wait_for_function("() => document.querySelector('#notes img').naturalWidth === 400")
        expect(strip.nth(1)).to_contain_text("<img src=x onerror=alert(1)>")
        strip.nth(0).focus()
        page.keyboard.press("Enter")
        expect(page.locator("#note")).to_be_visible()
        expect(page.locator("#note-title")).to_have_text("Photograph of drone 7")
        expect(page.locator("#note-about")).to_contain_text("47.376900, 8.541700, <b>gate</b>.jpg")
        expect(page.locator("#note-image")).to_have_attribute("alt", "Photograph of drone 7, <b>gate</b>.jpg")
        shoot(page, "map-photograph")
        page.keyboard.press("Escape")
        expect(page.locator("#note")).to_be_hidden()
        assert page.evaluate("document.activeElement.dataset.note").startswith("7-"), "the focus goes back"
        # By mouse, from the map.
        page.locator(".note-mark").nth(1).click(force=True)
        expect(page.locator("#note-text")).to_have_text(line)
        page.locator("#note-show").click()
        expect(page.locator("#note")).to_be_hidden()
        # Another one comes; the one that is there is not loaded again.
        page.evaluate("document.querySelector('#notes img').dataset.same = 'yes'")
        base.arrive(base.datum(8, 2, Kind.BYTES, b"it is out"))
        expect(strip).to_have_count(3)
        assert page.locator("#notes img").get_attribute("data-same") == "yes"
        page.locator("#layers summary").click()
        page.locator("#show-notes").uncheck()
        expect(page.locator(".note-mark")).to_have_count(0)
        # Earlier there was nothing.
        page.locator("#slider").focus()
        page.keyboard.press("Home")
        expect(page.locator("#notes-panel")).to_be_hidden()
    base.close()


def test_a_forged_photograph_is_told_in_words(browser: Browser, tmp_path: Path) -> None:
    base = Base(tmp_path / "rass-1.db")
    base.arrive(base.measurement(7, 0, HERE), base.file(7, 1, "a.jpg", b"<svg onload=alert(1)>"))
    with served(base.path) as url:
        page = browser.new_page()
        page.goto(url)
        expect(page.locator("#notes button")).to_contain_text("a.jpg: cannot be shown")
        page.locator("#notes button").click()
        expect(page.locator("#note-text")).to_contain_text("It cannot be shown")
        page.close()
    base.close()

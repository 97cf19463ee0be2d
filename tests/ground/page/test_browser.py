"""The page in a real browser, while data arrive."""

from __future__ import annotations

import argparse
import asyncio
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from rass_mav.core.datum import Datum, DatumId, Fate, Kind
from rass_mav.ground.archive import Archive
from rass_mav.wire.measurement import Measurement
from rass_mav.wire.nodestatus import NodeStatus, encode_status
from tests.environment import environment
from tests.ground.missions import HERE, Base
from tests.ground.test_attention import mission_with_keys
from tests.patience import PATIENCE_S
from tests.some import some

from .flights import Flight

pytest.importorskip("aiohttp", reason="aiohttp is not installed (extra ground)")
pytest.importorskip("playwright.sync_api", reason="playwright is not installed (extra dev)")

from playwright.sync_api import Browser, Page, expect, sync_playwright

from rass_mav.ground.commands.data import open_archive, rules_of
from rass_mav.ground.page.access import Access
from rass_mav.ground.page.follow import Follower
from rass_mav.ground.page.server import Page as ServedPage
from rass_mav.ground.page.server import serve

from .serving import TOKEN

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
expect.set_options(timeout=PATIENCE_S * 1000)
pytestmark = [pytest.mark.no_cover, pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")]

DESK, PHONE = {"width": 1400, "height": 900}, {"width": 390, "height": 844}


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with sync_playwright() as programs:
        # A sandbox inside a sandbox is not possible everywhere; this browser sees our own page only.
        found = programs.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield found
        found.close()


@contextmanager
def served(
    store: Path, token: str | None = None, now: Callable[[], float] = time.time, follower: Follower | None = None
) -> Iterator[str]:
    """The page of a store, on a thread of its own; yields its address. `now`: the date, seconds since 1970."""
    page = ServedPage(follower or Follower(lambda: Archive(store, now=now)), Access("127.0.0.1", token), now=now)
    loop, stopped = asyncio.new_event_loop(), asyncio.Event()
    found: list[str] = []
    up = threading.Event()

    def ready(url: str) -> None:
        found.append(url)
        up.set()

    thread = threading.Thread(target=loop.run_until_complete, args=(serve(page, "127.0.0.1:0", ready, stopped),))
    thread.start()
    try:
        assert up.wait(PATIENCE_S)
        yield found[0]
    finally:
        loop.call_soon_threadsafe(stopped.set)
        thread.join(PATIENCE_S)
        loop.close()


@contextmanager
def opened(browser: Browser, url: str, *, size: dict[str, int] = DESK, scheme: str = "light") -> Iterator[Page]:
    """The page in a window of its own. At its end there was no error, and no request to another host."""
    context = browser.new_context(viewport=size, color_scheme=scheme)  # type: ignore[arg-type]
    context.set_default_timeout(PATIENCE_S * 1000)
    page = context.new_page()
    trouble: list[str] = []
    hosts: set[str] = set()
    page.on("console", lambda said: trouble.append(said.text) if said.type in ("error", "warning") else None)
    page.on("pageerror", lambda error: trouble.append(str(error)))
    page.on("request", lambda request: hosts.add(urlsplit(request.url).netloc))
    page.goto(url)
    yield page
    assert trouble == []
    assert hosts <= {urlsplit(url).netloc, ""}, "the second are data: addresses"
    context.close()


@pytest.fixture
def flight(tmp_path: Path) -> Iterator[Flight]:
    flight = Flight(tmp_path / "rass-1.db", drones=5)
    flight.fly(600)
    yield flight
    flight.close()


def number(page: Page, id: str) -> int:
    return int(page.locator(f"#{id}").inner_text().replace(",", ""))


def arrived(flight: Flight) -> int:
    with Archive(flight.base.path) as archive:
        return archive.count()


def shoot(page: Page, name: str) -> None:
    """A picture, where somebody wants to look at them."""
    if folder := os.environ.get("RASS_SHOTS"):
        page.screenshot(path=f"{folder}/{name}.png")


def wait_for_data(page: Page, flight: Flight) -> None:
    expect(page.locator("#n-arrived")).to_have_text(f"{arrived(flight):,}", timeout=PATIENCE_S * 1000)
    # These missions are some days old.
    expect(page.locator("#link")).to_have_text(re.compile("^(Live|Not running, last datum [0-9]+ d ago)$"))


def test_a_mission_that_grows_while_somebody_looks(browser: Browser, flight: Flight) -> None:
    with served(flight.base.path) as url, opened(browser, url) as page:
        wait_for_data(page, flight)
        before = number(page, "n-arrived")
        assert page.locator(".mark").count() == 6
        assert page.locator("#drones tbody tr").count() == 6
        flight.fly(120)
        wait_for_data(page, flight)
        assert number(page, "n-arrived") > before
        shoot(page, "browser-light")

        # A drone's panel, by mouse and by keyboard.
        page.locator("#drones button[data-drone='3']").click()
        expect(page.locator("#drone-title")).to_have_text("Drone 3")
        expect(page.locator("#drone-facts")).to_contain_text("newer data unknown")
        expect(page.locator("#drone-facts")).to_contain_text("Next hopnode 4")
        expect(page.locator("#drone-neighbours tr", has_text="next hop")).to_have_count(1)
        expect(page.locator("#drone-readings canvas")).to_be_visible()
        shoot(page, "browser-drone")
        page.keyboard.press("Escape")
        expect(page.locator("#drone")).to_be_hidden()
        assert page.evaluate("document.activeElement.dataset.drone") == "3", "the focus goes back"
        page.locator(".mark[aria-label^='Drone 4,']").focus()
        page.keyboard.press("Enter")
        expect(page.locator("#drone-title")).to_have_text("Drone 4")
        page.locator("#drone-close").click()

        # Back in time, and to the present.
        total = number(page, "n-arrived")
        page.locator("#slider").focus()
        page.keyboard.press("Home")
        expect(page.locator("#past-note")).to_be_visible()
        page.keyboard.press("PageUp")
        page.keyboard.press("PageUp")
        expect(page.locator("#link")).to_contain_text("At ")
        expect(page.locator("#n-lost")).to_have_text("-")
        expect(page.locator("#n-arrived")).not_to_have_text(f"{total:,}")
        earlier = number(page, "n-arrived")
        assert earlier < total
        page.locator("#play").click()
        expect(page.locator("#play")).to_have_text("Pause")
        expect(page.locator("#n-arrived")).not_to_have_text(f"{earlier:,}")
        page.locator("#live").click()
        expect(page.locator("#n-arrived")).to_have_text(f"{total:,}")
        expect(page.locator("#past-note")).to_be_hidden()


def test_a_mock_swarm_moves_and_its_counts_grow(browser: Browser) -> None:
    words = ["swarm", "--nodes", "9", "--topology", "random-walk", "--steps", "9999", "--page", "127.0.0.1:0"]
    command = [sys.executable, "-m", "rass_mav", *words]
    with subprocess.Popen(
        command, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as swarm:  # fmt: skip
        try:
            url = next(line for line in some(swarm.stderr) if line.startswith("http://")).split()[0]
            with opened(browser, url) as page:
                mark = page.locator(".mark[aria-label^='Drone 1,']")
                # The one that is chosen shares its mark with no other.
                page.locator("#drones button[data-drone='1']").click()
                mark.wait_for()
                was, arrived = mark.get_attribute("style"), number(page, "n-arrived")
                page.wait_for_function(
                    "was => document.querySelector(\".mark[aria-label^='Drone 1,']\").style.cssText != was", arg=was
                )
                page.wait_for_function(
                    "was => Number(document.querySelector('#n-arrived').textContent.replace(',', '')) > was",
                    arg=arrived,
                )
                expect(page.locator(".mark[aria-label^='Base 0,']")).to_be_visible()
        finally:
            swarm.send_signal(signal.SIGINT)
            swarm.communicate(timeout=PATIENCE_S)


def test_both_themes(browser: Browser, flight: Flight) -> None:
    with served(flight.base.path) as url:
        for scheme, other in (("light", "dark"), ("dark", "light")):
            with opened(browser, url, scheme=scheme) as page:
                wait_for_data(page, flight)
                theme = "document.documentElement.dataset.theme"
                ground = "getComputedStyle(document.body).backgroundColor"
                assert page.evaluate(theme) == scheme
                was = page.evaluate(ground)
                shoot(page, f"browser-theme-{scheme}")
                page.locator("#theme").click()
                assert page.evaluate(theme) == other
                assert page.evaluate(ground) != was
                page.reload()
                wait_for_data(page, flight)
                assert page.evaluate(theme) == other, "what was chosen stays"


def test_a_phone(browser: Browser, flight: Flight) -> None:
    with served(flight.base.path) as url, opened(browser, url, size=PHONE) as page:
        wait_for_data(page, flight)
        assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"], "nothing is beside the page"
        table = page.locator("#drones")
        assert table.evaluate("(t) => t.scrollWidth <= t.parentElement.clientWidth"), "the table fits"
        for id in ("play", "slider", "live", "theme", "fit"):
            box = some(page.locator(f"#{id}").bounding_box())
            assert box["x"] >= 0
            assert box["x"] + box["width"] <= PHONE["width"]
            assert box["height"] >= 30, "a thumb hits it"
        page.locator("#drones button[data-drone='2']").click()
        expect(page.locator("#drone-title")).to_be_in_viewport()
        shoot(page, "browser-phone")


def test_a_drone_that_only_others_hear(browser: Browser, flight: Flight) -> None:
    word = NodeStatus(0, 0, 0, None, 0.0, 2, None, None, {40: 0.5}, {})
    flight.base.arrive(flight.base.datum(3, 900, Kind.STATUS, encode_status(word)))
    with served(flight.base.path) as url, opened(browser, url) as page:
        row = page.locator("#drones tbody tr", has=page.locator("button[data-drone='40']"))
        expect(row).to_contain_text("by 3no data")
        row.locator("button").click()
        expect(page.locator("#drone-facts")).to_contain_text("Heardby drone 3, ")
        flight.base.arrive(flight.base.measurement(40, 0, HERE))
        expect(row).not_to_contain_text("no data")
        expect(row).to_have_count(1)


@contextmanager
def mission(folder: Path) -> Iterator[Base]:
    """Drone 3 has died, drone 5 has a full store and has no route, drones 2 and 4 fly on. It is 10:20."""
    base = Base(folder / "rass-1.db")
    said = NodeStatus(9, 6, 0, 5000, 0.1, 1, 80, (47.377, 8.541), {1: 0.9}, {}, next_hop=1)
    numbers = dict.fromkeys((1, 2, 3, 4, 5), -1)

    def say(origin: int, **more: object) -> Datum:
        numbers[origin] += 1
        place = (47.377 + origin / 1000, 8.541)
        status = said._replace(place=place, **more)  # type: ignore[arg-type]
        return base.datum(origin, numbers[origin], Kind.STATUS, encode_status(status))

    for minute in range(20):
        base.arrive(
            *(say(id) for id in (2, 4)), *(say(3) for _ in range(minute < 8)),
            *(say(5, free=max(0, 9 - minute), hops=None) for _ in range(minute < 12)),
            say(1, base=True, free=None),
        )  # fmt: skip
        base.wall += 60.0
    yield base
    base.close()


def test_the_first_screen_names_who_is_dead_and_who_is_revoked_and_full(
    browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    base = mission_with_keys(tmp_path)
    options = argparse.Namespace(store="base.yaml", keys=None)
    for size in (DESK, PHONE):
        follower = Follower(lambda: open_archive(options), rules_of(options))
        with (
            served(base.path, now=lambda: base.wall, follower=follower) as url,
            opened(browser, url, size=size) as page,
        ):
            rows = page.locator("#attention-list li")
            expect(rows).to_have_count(4)
            for row, text in zip(rows.all(), ("3: silent", "5: silent", "5: store full", "5: revoked"), strict=True):
                expect(row).to_contain_text(f"drone {text}")
            expect(rows.nth(0)).to_be_in_viewport()
            expect(page.locator("#n-created-what")).to_have_text("created at least")
            shoot(page, f"browser-purpose-{size['width']}")
    base.close()


def test_what_needs_attention_stands_above_everything(browser: Browser, tmp_path: Path) -> None:
    with (
        mission(tmp_path) as base,
        served(base.path, now=lambda: base.wall) as url,
        opened(browser, url) as page,
    ):
        rows = page.locator("#attention-list li")
        expect(rows).to_have_count(4)
        expect(rows.nth(0)).to_have_text(re.compile("^ALARMdrone 3: silent for 13 min.*send a relay"))
        expect(rows.nth(1)).to_have_text(re.compile("^ALARMdrone 5: silent for 9 min"))
        expect(rows.nth(2)).to_contain_text("drone 5: store full")
        expect(rows.nth(3)).to_contain_text("drone 5: no route to a base")
        expect(page.locator("#attention-said")).to_contain_text("Alarm: drone 3: silent")
        row = page.locator("#drones tbody tr", has=page.locator("button[data-drone='3']"))
        expect(row).to_have_class("alarm")
        expect(row).to_contain_text("3alarm")
        expect(row).to_contain_text("8+")
        cell = row.locator("td").last
        expect(cell).to_have_text(re.compile(r"^6( to [\d,]+)?\+?13 min ago$"))
        at_risk = re.compile("^If it fails now: 6 data lost.*, of those older than 13 min; newer")
        expect(cell).to_have_attribute("title", at_risk)
        expect(page.locator("#n-created-what")).to_have_text("created at least")
        expect(page.locator(".mark.alarm")).to_have_count(2)
        assert some(page.locator("#attention").bounding_box())["y"] < some(page.locator("#map").bounding_box())["y"]
        shoot(page, "browser-attention")

        # It sounds until somebody acknowledges it, and a new one sounds again.
        rang = "Number(document.documentElement.dataset.rang ?? 0)"
        assert page.evaluate(rang) == 0, "a browser allows no sound before somebody has done something"
        page.locator("h1").click()
        page.wait_for_function(f"() => {rang} > 0")
        page.locator("#attention-ack").click()
        expect(page.locator("#attention-ack")).to_be_hidden()
        assert page.evaluate("document.activeElement.id") == "attention-list"
        page.reload()
        expect(rows).to_have_count(4)
        expect(page.locator("#attention-ack")).to_be_hidden()
        before = page.evaluate(rang)
        page.locator("h1").click()
        assert page.evaluate(rang) == before, "what was acknowledged stays quiet"
        base.wall += 400.0
        base.arrive()  # it notes its time
        expect(page.locator("#attention-ack")).to_be_visible()
        expect(page.locator("#attention-said")).to_contain_text("4 drones: silent")
        page.wait_for_function(f"() => {rang} > {before}")
        page.locator("#attention-sound").click()
        expect(page.locator("#attention-sound")).to_have_text("Sound: off")

        # It is over when the drones are heard, and the log has both.
        base.arrive(*(base.measurement(id, 900, HERE) for id in (2, 4)))
        expect(rows).to_have_count(4)
        expect(page.locator("#events li").nth(0)).to_contain_text("over: drone")
        expect(page.locator("#events")).to_contain_text("ALARM: drone 2: silent")
        # At an earlier time the list still is that of now, and the table is not marked.
        page.locator("#slider").focus()
        page.keyboard.press("Home")
        expect(page.locator("#past-note")).to_be_visible()
        expect(page.locator("#drones tr.alarm")).to_have_count(0)
        expect(rows).to_have_count(4)


def test_an_alarm_is_told_outside_the_page_if_that_is_allowed(browser: Browser, tmp_path: Path) -> None:
    with mission(tmp_path) as base, served(base.path, now=lambda: base.wall) as url, opened(browser, url) as page:
        expect(page.locator("#attention-list li")).to_have_count(4)
        page.context.grant_permissions(["notifications"], origin=url)
        page.evaluate(
            """() => {
              window.told = [];
              window.Notification = class extends Notification {
                constructor(title, more) { super(title, more); window.told.push(more.body); }
              };
            }"""
        )
        base.wall += 400.0
        base.arrive()  # it notes its time
        page.wait_for_function("() => window.told.length > 0")
        assert "4 drones: silent" in page.evaluate("window.told[0]")
        expect(page.locator("#attention-notify")).to_be_hidden()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_list_on_a_phone(browser: Browser, tmp_path: Path, scheme: str) -> None:
    with (
        mission(tmp_path) as base,
        served(base.path, now=lambda: base.wall) as url,
        opened(browser, url, size=PHONE, scheme=scheme) as page,
    ):
        expect(page.locator("#attention-list li")).to_have_count(4)
        assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"], "nothing is beside the page"
        assert page.locator("#drones").evaluate("(t) => t.scrollWidth <= t.parentElement.clientWidth")
        first = page.locator("#attention-list li").nth(1)
        expect(first).to_be_in_viewport()
        for id in ("attention-ack", "attention-sound"):
            assert some(page.locator(f"#{id}").bounding_box())["height"] >= 30, "a thumb hits it"
        shoot(page, f"browser-attention-phone-{scheme}")


def test_a_base_without_a_position_is_told_beside_the_map(browser: Browser, tmp_path: Path) -> None:
    base = Base(tmp_path / "rass-1.db")
    said = NodeStatus(0, 0, 0, None, 0.0, 0, None, None, {7: 0.9}, {}, base=True)
    nowhere = HERE._replace(latitude=None, longitude=None)
    base.arrive(base.measurement(7, 0, nowhere), base.datum(1, 0, Kind.STATUS, encode_status(said)))
    with served(base.path) as url, opened(browser, url) as page:
        expect(page.locator("#n-arrived")).to_have_text("2")
        assert page.locator(".mark").count() == 0
        expect(page.locator("#remarks")).to_be_visible()
        expect(page.locator("#remarks")).to_contain_text("Base 1 is not on the map: no position is known")
        shoot(page, "browser-no-place")
        base.arrive(base.measurement(7, 1, HERE))
        mark = page.locator(".mark.base")
        expect(mark).to_have_class(re.compile("guess"))
        expect(mark).to_contain_text("1?place: a guess")
        drone = some(page.locator(".mark:not(.base)").bounding_box())
        assert some(mark.bounding_box())["x"] + 26 < drone["x"], "beside the drone from which it was guessed"
        expect(mark).to_have_attribute("aria-label", re.compile("Base 1, .*its position is a guess"))
        expect(page.locator("#remarks")).to_contain_text("The position of base 1 is a guess")
        shoot(page, "browser-guess")
        base.arrive(base.datum(1, 1, Kind.STATUS, encode_status(said._replace(place=(47.377, 8.541)))))
        expect(mark).not_to_have_class(re.compile("guess"))
        expect(page.locator(".mark:not(.grouped)")).to_have_count(2)
        expect(page.locator("#remarks")).to_be_hidden()
    base.close()


def test_hostile_names_are_text(browser: Browser, tmp_path: Path) -> None:
    name = "<img src=x onerror=alert(1)>&amp;.db"
    flight = Flight(tmp_path / name, drones=2)
    flight.fly(60)
    with served(flight.base.path) as url, opened(browser, url) as page:
        wait_for_data(page, flight)
        expect(page.locator("#title")).to_have_text(name.removesuffix(".db"))
        assert page.locator("img[src='x']").count() == 0
    flight.close()


def test_forged_data_do_not_stop_it(browser: Browser, flight: Flight) -> None:
    most, here = 3.4028234663852886e38, Measurement(47.37, 8.54, 0.0, 1.0, 1.0, unit="usvh")
    places = ((90.0, 180.0), (-90.0, -180.0), (0.0, 0.0), (47.37, 8.54), (47.37, -179.99999))
    forged = [
        here._replace(latitude=latitude, longitude=longitude, reading=reading, unit=unit)
        for latitude, longitude in places
        for reading in (most, -most, 1e-45, 0.0, None)
        for unit in ("usvh", "cps", None)
    ]
    base = flight.base
    numbers = (0, 1, 2**32 - 2, 2**32 - 1)
    base.arrive(*(base.measurement(60_000 + n, numbers[n % 4], m, age_s=2e6 * n) for n, m in enumerate(forged)))
    said = NodeStatus(
        65535, 65535, 65535, None, 1.0, 254, None, (90.0, 180.0), {2: 1.0, 65535: 0.0}, {}, next_hop=65535
    )
    base.arrive(base.datum(65535, 2**32 - 1, Kind.STATUS, encode_status(said)))
    base.store.lose(DatumId(0, 2**32 - 1, 2**32 - 1), Fate.OVERFLOW)
    base.arrive()
    with served(base.path) as url, opened(browser, url) as page:
        wait_for_data(page, flight)
        assert number(page, "n-created") > 30 * 2**32
        assert page.locator(".totals").evaluate("(t) => t.scrollWidth <= t.clientWidth"), "large numbers are wrapped"
        for unit in ("cps", "", "usvh"):
            page.locator("#layers").evaluate("(e) => { e.open = true; }")
            page.locator("#unit").select_option(unit)
        page.locator("#drones button[data-drone='65535']").click()
        expect(page.locator("#drone-facts")).to_contain_text("node 65535")
        page.locator("#fit").click()
        page.locator("#slider").focus()
        page.keyboard.press("Home")
        expect(page.locator("#past-note")).to_be_visible()
        page.locator("#live").click()
        flight.fly(60)
        wait_for_data(page, flight)
        shoot(page, "browser-forged")


def test_the_login(browser: Browser, flight: Flight) -> None:
    with served(flight.base.path, TOKEN) as url, opened(browser, url) as page:
        assert urlsplit(page.url).path == "/login"
        page.locator("#token").fill(TOKEN)
        page.keyboard.press("Enter")
        wait_for_data(page, flight)
        assert page.evaluate("document.cookie") == "", "scripts do not see the cookie"
        page.locator("#logout button").click()
        page.wait_for_url("**/login")


def test_every_control_has_a_name(browser: Browser, flight: Flight) -> None:
    with served(flight.base.path) as url, opened(browser, url) as page:
        wait_for_data(page, flight)
        page.locator("#layers summary").click()
        nameless = page.evaluate(
            """() => [...document.querySelectorAll("button, input, select, [role=button], [tabindex='0']")]
              .filter((e) => e.checkVisibility() && !e.ariaLabel && !e.getAttribute("aria-labelledby")
                && !e.textContent.trim() && !(e.labels && e.labels.length))
              .map((e) => e.outerHTML)"""
        )
        assert nameless == []

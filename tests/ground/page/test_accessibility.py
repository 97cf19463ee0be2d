"""What axe-core finds in the page: nothing may keep people with disabilities from using it."""

from __future__ import annotations

from pathlib import Path

import pytest

from rass_mav.ground import html
from rass_mav.ground.archive import Archive
from tests.ground.missions import HERE

from . import test_browser as browsing
from .serving import TOKEN

pytest.importorskip("axe_playwright_python", reason="axe-playwright-python is not installed (extra dev)")

from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, Page, expect

browser = browsing.browser
pytestmark = browsing.pytestmark

LOOKS = [(size, scheme) for size in ("desk", "phone") for scheme in ("light", "dark")]


def check(page: Page, name: str) -> None:
    """Nothing is found."""
    browsing.shoot(page, name)
    found = Axe().run(page)
    assert not found.response["violations"], f"{name}: {found.generate_report()}"


@pytest.mark.parametrize(("size", "scheme"), LOOKS)
def test_the_page(browser: Browser, tmp_path: Path, size: str, scheme: str) -> None:
    window = {"desk": browsing.DESK, "phone": browsing.PHONE}[size]
    with (
        browsing.mission(tmp_path) as base,
        browsing.served(base.path, now=lambda: base.wall) as url,
        browsing.opened(browser, url, size=window, scheme=scheme) as page,
    ):
        base.arrive(*(base.measurement(id, 900, HERE) for id in (2, 4)))
        expect(page.locator("#attention-list li")).to_have_count(4)
        expect(page.locator("#compare-chart canvas")).to_have_count(1)
        page.locator("#drones button[data-drone='3']").click()
        expect(page.locator("#drone-title")).to_have_text("Drone 3")
        page.locator("#layers summary").click()
        page.locator(".help summary").click()
        page.locator("#measure").click()
        check(page, f"axe-{size}-{scheme}-open")
        # What one finger or one key does not reach shows at an earlier time, and with a filter.
        page.keyboard.press("Escape")
        page.locator("#drones-attention").check()
        expect(page.locator("#drones tbody tr")).to_have_count(2)
        page.locator("#slider").focus()
        page.keyboard.press("Home")
        expect(page.locator("#past-note")).to_be_visible()
        check(page, f"axe-{size}-{scheme}-past")


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_login(browser: Browser, tmp_path: Path, scheme: str) -> None:
    with (
        browsing.mission(tmp_path) as base,
        browsing.served(base.path, TOKEN) as url,
        browsing.opened(browser, url, scheme=scheme) as page,
    ):
        check(page, f"axe-login-{scheme}")


def test_the_report(browser: Browser, tmp_path: Path) -> None:
    with browsing.mission(tmp_path) as base, Archive(base.path, now=lambda: base.wall) as archive:
        html.write(archive, tmp_path / "report.html", base.wall)
    with browsing.opened(browser, (tmp_path / "report.html").as_uri()) as page:
        check(page, "axe-report")

"""Makes the pictures of the page and the report in docs/images, from a mock swarm, with Debian's Chromium.

    python -m tools.pictures

The swarm is always the same; its dates are those of the moment.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from playwright.sync_api import Browser, Page, expect, sync_playwright

IMAGES = Path(__file__).parents[1] / "docs" / "images"
#: The swarm of the pictures: a survey by 20 drones.
SWARM = ("swarm", "field-wifi-6m", "--nodes", "21", "--steps", "450", "--seed", "1", "--pace", "1000000")
DRONE = 9
DESK, PHONE = (1200, 760), (390, 844)
#: Until the last frame is drawn.
_DRAWN_MS = 1500


@contextmanager
def flown(store: Path) -> Iterator[str]:
    """The address of the page, after the swarm's last step."""
    command = [sys.executable, "-m", "rass_mav", *SWARM, "--store", str(store), "--page", "127.0.0.1:0"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as swarm:
        try:
            assert swarm.stderr is not None
            url = next(line.split()[0] for line in swarm.stderr if line.startswith("http"))
            if not any(line.startswith("all steps are done") for line in swarm.stderr):
                raise SystemExit("the swarm has ended before its last step")
            yield url
        finally:
            swarm.terminate()


@contextmanager
def window(browser: Browser, url: str, size: tuple[int, int], scheme: str) -> Iterator[Page]:
    """A window with the page."""
    page = browser.new_page(viewport={"width": size[0], "height": size[1]}, color_scheme=scheme)  # type: ignore[arg-type]
    page.goto(url)
    yield page
    page.close()


def wait_for_all(page: Page) -> None:
    """Until the page has read all data, and drawn them."""
    expect(page.locator("#link")).to_contain_text("Ended")
    page.locator(f".mark[aria-label^='Drone {DRONE},']").wait_for(state="attached")
    page.wait_for_timeout(_DRAWN_MS)


def main() -> None:
    """Make all pictures anew."""
    chromium = shutil.which("chromium") or sys.exit("chromium is not installed: see tools/ci-packages")
    with TemporaryDirectory() as folder, sync_playwright() as programs:
        store, report = Path(folder) / "swarm.db", Path(folder) / "mission.html"
        browser = programs.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        with flown(store) as url:
            with window(browser, url, DESK, "light") as page:
                wait_for_all(page)
                page.screenshot(path=IMAGES / "page.png")
            with window(browser, url, PHONE, "dark") as page:
                wait_for_all(page)
                page.locator(f"#drones button[data-drone='{DRONE}']").click()
                page.locator("#drone-readings canvas").wait_for()
                page.screenshot(path=IMAGES / "page-phone.png")
        subprocess.run([sys.executable, "-m", "rass_mav", "report", str(store), "--html", str(report)], check=True)
        with window(browser, report.as_uri(), DESK, "light") as page:
            page.screenshot(path=IMAGES / "report.png")
        browser.close()


if __name__ == "__main__":
    main()

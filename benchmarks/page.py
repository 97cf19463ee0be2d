"""What the page costs while 100 drones send a datum a second each, and the base has 100,000 data already.

    python -m benchmarks.page            a table
    python -m benchmarks.page --json     one JSON object

The base is a real `rass-mav run`, the page a real `rass-mav page` with Chromium on it. This process plays the drones:
each sends a beacon and a datum a second, as UDP datagrams. First the base alone receives for `--seconds`, then the same
with the page. All times are of this computer's one clock.

- A frame drawn: the time of the browser's main thread for one event of the server. It reads the event, draws what has
  changed, and lays out and paints the page. The time in which it waits for the display does not count.
- The server's share: its processor time, of one core. That of its estimate of sources, a process of low priority, is
  given beside it. The browser's share: the same of all its processes.
- From arrival to page: from the time at which the base got a datum to the end of the painting that counts it.
- Late steps: those that the base left out because it was late.

Other programs that run on the computer make all of this longer. So the load is printed too: how many processes wanted
to run, a mean of the last minute, ours included.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import os
import select
import shutil
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from benchmarks.tables import table
from rass_mav.core.datum import Datum, DatumId, Fate, Kind, make_datum
from rass_mav.core.messages import NO_ROUTE, Beacon, Data, Handover
from rass_mav.ground.archive import Archive
from rass_mav.mavlink.frames import FrameWriter
from rass_mav.wire import encode
from rass_mav.wire.measurement import Measurement, encode_measurement
from rass_mav.wire.nodestatus import NodeStatus, encode_status
from tests.app.app_nodes import RunningNode, free_ports
from tests.environment import environment
from tests.ground.missions import EPOCH, Base
from tests.ground.page.flights import dose, place

BASE_ID = 1
#: Of so many data one is missing, and of so many one is reported lost.
MISSING, LOST = 100, 300
#: Seconds between two statuses of a drone.
STATUS_S = 60
#: Drones hear each other over this distance, metres.
RANGE_M = 150.0
DEADLINE_S = 120.0
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")

#: Runs in the page before its own scripts.
PROBE = """
(() => {
  const probe = { drawn: [], counts: [], longest: 0 };
  window.probe = probe;
  const spend = (ms) => { if (probe.drawn.length) probe.drawn[probe.drawn.length - 1] += ms; };
  const listen = EventSource.prototype.addEventListener;
  EventSource.prototype.addEventListener = function (kind, handle) {
    return listen.call(this, kind, (event) => {
      const begun = performance.now();
      handle(event);
      probe.drawn.push(performance.now() - begun);
    });
  };
  let begun = null;
  // What is posted while a frame is drawn is received when it is painted.
  const painted = new MessageChannel();
  painted.port1.onmessage = () => {
    spend(performance.now() - begun);
    begun = null;
    const count = Number(document.getElementById("n-arrived").textContent.replaceAll(",", ""));
    if (count !== probe.counts.at(-1)?.[1]) probe.counts.push([Date.now() / 1000, count]);
  };
  const request = window.requestAnimationFrame;
  window.requestAnimationFrame = (draw) => request.call(window, (now) => {
    if (begun === null) {
      begun = performance.now();
      painted.port2.postMessage(null);
    }
    draw(now);
  });
  new PerformanceObserver((list) => {
    for (const { duration } of list.getEntries()) probe.longest = Math.max(probe.longest, duration);
  }).observe({ type: "longtask" });
})();
"""


class Fleet:
    """Drones that fly lanes side by side, 1,200 m north and back. Each creates a datum a second."""

    def __init__(self, drones: int) -> None:
        self.ids = range(BASE_ID + 1, BASE_ID + 1 + drones)
        self._numbers = dict.fromkeys(self.ids, 0)

    def spot(self, id: int, now: float) -> tuple[float, float]:
        """Where a drone is: metres north and east of the base. `now`: seconds since the mission began."""
        link_queue = id - self.ids[0] - (len(self.ids) - 1) / 2
        way = 4.0 * now % 2400.0
        return 20.0 + min(way, 2400.0 - way), 60.0 * link_queue + 25.0 * math.sin(now / 40.0 + id)

    def create(self, id: int, now: float) -> tuple[DatumId, int, bytes]:
        """Its next datum: number, kind and payload."""
        number = self._numbers[id]
        self._numbers[id] += 1
        spot = self.spot(id, now)
        reading = dose(*spot)
        risk = min(reading / 60.0, 1.0)
        if (number + id) % STATUS_S == 0:
            others = [other for other in range(id - 3, id + 4) if other in self.ids and other != id]
            near = {other: math.dist(spot, self.spot(other, now)) for other in others}
            heard = {other: 1.0 - metres / (2 * RANGE_M) for other, metres in near.items() if metres < RANGE_M}
            alone = id % 7
            status = NodeStatus(
                40, alone, 20, 900, risk, 1 + int(spot[0] // 200), 80, place(*spot), heard, {id: alone} if alone else {}
            )
            return DatumId(id, EPOCH, number), Kind.STATUS, encode_status(status)
        measurement = Measurement(*place(*spot), 440.0, reading, risk, unit="usvh", error_m=1.8)
        return DatumId(id, EPOCH, number), Kind.MEASUREMENT, encode_measurement(measurement)


def archive(path: Path, fleet: Fleet, data: int) -> float:
    """A base's store with at least so many data that have arrived until now. Returns when the mission began."""
    begun = time.time() - data / len(fleet.ids) * (1.0 + 2.0 / MISSING)
    base = Base(path, wall=begun)
    count = 0
    while count < data:
        arrived: list[Datum] = []
        for id in fleet.ids:
            name, kind, payload = fleet.create(id, base.wall - begun)
            chance = name.sequence * 7 + id
            if chance % LOST == 0:
                base.store.lose(name, Fate.OVERFLOW)
            elif chance % MISSING:
                arrived.append(base.datum(id, name.sequence, kind, payload, age_s=1.0 + id % 5))
        base.arrive(*arrived)
        base.wall += 1.0
        count += len(arrived)
    base.close()
    return begun


class Senders:
    """The drones as the base hears them."""

    def __init__(self, fleet: Fleet, begun: float, own: socket.socket, base: tuple[str, int]) -> None:
        """`begun`: when the mission began, seconds since 1970."""
        self._fleet, self._begun, self._own, self._base = fleet, begun, own, base
        self._writers = {id: FrameWriter(id % 255 + 1, 191) for id in fleet.ids}
        self._beacons = 0
        self.sent = 0

    def fly(self, seconds: int) -> None:
        """Send for so long, evenly."""
        ids = self._fleet.ids
        start = time.monotonic()
        for turn in range(seconds * len(ids)):
            time.sleep(max(0.0, start + turn / len(ids) - time.monotonic()))
            self._send(ids[turn % len(ids)])

    def _send(self, id: int) -> None:
        self._beacons += 1
        now = time.time()
        name, kind, payload = self._fleet.create(id, now - self._begun)
        handover = Handover(1 + self.sent, make_datum(name, kind, now, payload))
        beacon = Beacon(id, id, self._beacons & 0xFFFF, 0, 0, 0, 0, NO_ROUTE, 0, 0, 0, 50, 0, 0, 0)
        for message in (beacon, Data(id, BASE_ID, (handover,))):
            for part in encode(message, now):
                self._own.sendto(self._writers[id].tunnel(part, payload_type=33200), self._base)
        self.sent += 1


@contextmanager
def served(directory: Path, config: str) -> Iterator[tuple[str, int]]:
    """The page of a base, in a process of its own: its address and the process's number."""
    command = [sys.executable, "-m", "rass_mav", "page", config, "--listen", "127.0.0.1:0", "--json"]
    with subprocess.Popen(command, cwd=directory, env=environment(), stdout=subprocess.PIPE) as process:
        try:
            assert process.stdout is not None
            if not select.select([process.stdout], [], [], DEADLINE_S)[0]:
                raise RuntimeError("the page did not start")
            yield json.loads(process.stdout.readline())["url"], process.pid
        finally:
            process.terminate()


@contextmanager
def watched(url: str, arrived: int) -> Iterator[Any]:
    """A browser that shows the page, with `arrived` data."""
    from playwright.sync_api import expect, sync_playwright

    with sync_playwright() as programs:
        # A sandbox inside a sandbox is not possible everywhere; this browser sees our own page only.
        browser = programs.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1400, "height": 900})
        page.add_init_script(PROBE)
        page.goto(url)
        expect(page.locator("#link")).to_have_text("Live", timeout=DEADLINE_S * 1000)
        expect(page.locator("#n-arrived")).to_have_text(f"{arrived:,}", timeout=DEADLINE_S * 1000)
        yield page
        browser.close()


def processor_s(*processes: Any) -> float:
    """The processor time of some processes so far, seconds."""
    times = [process.cpu_times() for process in processes]
    return float(sum(each.user + each.system for each in times))


def browsers() -> list[Any]:
    """The processes of the browser that this process has started: of its pages, its network, its pictures."""
    import psutil

    return [child for child in psutil.Process().children(recursive=True) if "--type=" in " ".join(child.cmdline())]


def summary(values: Sequence[float]) -> dict[str, float]:
    """Least, median, 95 % and most."""
    ordered = sorted(values)
    return {
        "least": round(ordered[0], 3),
        "median": round(statistics.median(ordered), 3),
        "p95": round(ordered[len(ordered) * 95 // 100], 3),
        "most": round(ordered[-1], 3),
    }


def delays(rows: Sequence[float], counts: Sequence[tuple[float, int]]) -> list[float]:
    """How long it took until the page counted each datum, seconds. `rows`: when each datum of the store arrived, in
    this order. `counts`: when the page showed which count, beginning with what it showed at first."""
    return [
        shown - arrived for (_, before), (shown, count) in itertools.pairwise(counts) for arrived in rows[before:count]
    ]


def measure(drones: int, data: int, seconds: int) -> dict[str, Any]:
    """All figures. `seconds`: of each of the two parts."""
    fleet = Fleet(drones)
    near, far = free_ports(2)
    with tempfile.TemporaryDirectory() as name, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as own:
        directory = Path(name)
        own.bind(("127.0.0.1", far))
        begun = archive(directory / "n1.db", fleet, data)
        node = RunningNode(
            directory, BASE_ID, node={"role": "base", "step_s": 1.0, "clock": "trusted"},
            links=[{"listen": f"127.0.0.1:{near}", "peers": [{"address": f"127.0.0.1:{far}"}]}],
        )  # fmt: skip
        senders = Senders(fleet, begun, own, ("127.0.0.1", near))
        try:
            node.start()
            return {"drones": drones, "seconds": seconds, **_measure(node, senders, seconds)}
        finally:
            node.end()


def _measure(node: RunningNode, senders: Senders, seconds: int) -> dict[str, Any]:
    def late() -> int:
        skipped: int = node.status()["skipped_steps"]
        return skipped

    def stored() -> int:
        with Archive(path) as store:
            return store.count()

    import psutil

    path = node.directory / f"{node.name}.db"
    archived = stored()
    before = late()
    senders.fly(seconds)
    alone = late() - before
    node.until(lambda: stored() >= archived + senders.sent)
    with served(node.directory, node.config) as (url, pid):
        opened = time.monotonic()
        with watched(url, stored()) as page:
            live = time.monotonic() - opened
            # The browser compiles what it uses often.
            senders.fly(-(-seconds // 10))
            page.evaluate("probe.drawn.length = probe.longest = 0, probe.counts.splice(0, probe.counts.length - 1)")
            server, shown = psutil.Process(pid), browsers()
            watching = ([server], server.children(recursive=True), shown)
            before, spent, start = late(), [processor_s(*each) for each in watching], time.monotonic()
            senders.fly(seconds)
            shares = [processor_s(*each) - begun for each, begun in zip(watching, spent, strict=True)]
            lasted = time.monotonic() - start
            with_page, load = late() - before, round(os.getloadavg()[0], 2)
            node.until(lambda: page.evaluate("probe.counts.at(-1)[1]") >= archived + senders.sent)
            probe = page.evaluate("probe")
    with Archive(path) as store:
        rows = [entry.arrived or 0.0 for entry in store.entries()]
    return {
        "archived": archived,
        "received": len(rows) - archived,
        "load": load,
        "live_s": round(live, 2),
        "drawn_ms": summary(probe["drawn"]),
        "longest_task_ms": round(probe["longest"], 1),
        "events_per_s": round(len(probe["drawn"]) / lasted, 2),
        **{
            name: round(share / lasted, 3)
            for name, share in zip(("server_share", "sources_share", "browser_share"), shares, strict=True)
        },
        "to_page_s": summary(delays(rows, probe["counts"])),
        "late_steps": with_page,
        "late_steps_alone": alone,
    }


def show(results: dict[str, Any]) -> str:
    """The tables."""
    shown = (("drawn_ms", "a frame drawn, ms", 0), ("to_page_s", "from arrival to page, s", 2))
    rows = [[what, *(f"{one:.{digits}f}" for one in results[key].values())] for key, what, digits in shown]
    single = [
        [what, f"{results[key]:.4g}"]
        for key, what in (
            ("longest_task_ms", "longest task of the browser, ms"),
            ("server_share", "server, share of a core"),
            ("sources_share", "estimate of sources, share of a core"),
            ("browser_share", "browser, share of a core"),
            ("late_steps", "late steps of the base"),
            ("late_steps_alone", "the same without the page"),
            ("live_s", "from opening the page to all data, s"),
        )
    ]
    drones, seconds, archived, load = (results[key] for key in ("drones", "seconds", "archived", "load"))
    return (
        f"{drones} drones at 1 Hz for {seconds} s, {archived:,} data before; load {load}.\n\n"
        + table(["", "least", "median", "95 %", "most"], rows)
        + "\n"
        + table(["one run", ""], single)
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--drones", type=int, default=100, help="each sends a datum a second (default: 100)")
    parser.add_argument("--data", type=int, default=100_000, help="in the store before (default: 100,000)")
    parser.add_argument("--seconds", type=int, default=60, help="without the page, and then with it (default: 60)")
    options = parser.parse_args(arguments)
    results = measure(options.drones, options.data, options.seconds)
    print(json.dumps(results) if options.json else show(results))


if __name__ == "__main__":
    main()

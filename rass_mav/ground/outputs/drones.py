"""What a base knows of each drone, as metrics, and what needs attention."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from itertools import islice
from threading import Lock
from typing import TYPE_CHECKING, Any

from prometheus_client.core import GaugeMetricFamily, Metric

from rass_mav.errors import RassError
from rass_mav.ground.attention.conditions import Condition, in_order
from rass_mav.ground.attention.node import of_node
from rass_mav.ground.attention.rules import RuleBook
from rass_mav.ground.attention.watch import Watch
from rass_mav.ground.entry import Data
from rass_mav.ground.follow import Follower

if TYPE_CHECKING:
    from rass_mav.ground.report import Drone

#: Drones, and conditions, that have samples. There are more only if ids are forged.
MOST_DRONES, MOST_CONDITIONS = 500, 1000


class Drones:
    """Follows the base's store. One thread reads, others ask."""

    def __init__(
        self, open: Callable[[], Data], rules: RuleBook | None = None, now: Callable[[], float] = time.time
    ) -> None:
        """`open`, `rules`: as of a `Follower`. `now`: the date, seconds since 1970."""
        self._open, self._rules, self._now = open, rules, now
        self._follower: Follower[Watch] | None = None
        self._lock = Lock()
        self.trouble = ""
        """Why the store cannot be read; empty: it can."""

    def look(self) -> None:
        """Read a part of what has arrived."""
        with self._lock:
            try:
                if self._follower is None:
                    self._follower = Follower(self._open, Watch, self._rules)
                self._follower.look()
                self.trouble = self._follower.trouble
            except RassError as error:
                self.trouble = " ".join(error.lines())

    def collect(self, status: dict[str, Any]) -> Iterator[Metric]:
        """`status`: the node's own."""
        with self._lock:
            found = of_node(status)
            if self._follower is not None:
                watch = self._follower.mission
                found = in_order(found + watch.conditions(self._now(), self._follower.date))
                silent = {one.drone for one in found if one.kind == "silent"}
                yield from _of_drones(watch, silent)
            yield _attention(found)


def _of_drones(watch: Watch, silent: set[int | None]) -> Iterator[Metric]:
    report = watch.report
    drones = [drone for drone in islice(report.listed, MOST_DRONES) if not report.is_base(drone.id)]
    gauges: list[tuple[str, str, Callable[[Drone], float | None]]] = [
        (
            "last_heard_timestamp_seconds", "When its newest datum was created",
            lambda drone: None if drone.heard is None else drone.heard.utc,
        ),
        ("silent", "1: for longer than usual", lambda drone: drone.id in silent),
        ("data_created", "At least this many", lambda drone: drone.created),
        ("data_arrived", "Data that have arrived", lambda drone: drone.arrived),
        ("data_missing", "In transit, or lost without a report", lambda drone: drone.missing),
        ("data_lost", "Data known to be lost", lambda drone: drone.lost.total()),
        ("data_at_risk", "Lost if it fails, by its last status", lambda drone: report.at_risk(drone.id)),
        ("store_held", "Data in its custody", lambda drone: drone.status and drone.status.held),
        ("store_free", "Space for more data; absent: no limit", lambda drone: drone.status and drone.status.free),
        ("battery_percent", "Of its vehicle", lambda drone: drone.status and drone.status.battery),
    ]  # fmt: skip
    for name, help, value in gauges:
        metric = GaugeMetricFamily(f"rass_drone_{name}", help, labels=["drone"])
        for drone in drones:
            if (found := value(drone)) is not None:
                metric.add_metric([str(drone.id)], float(found))
        yield metric
    reading = GaugeMetricFamily("rass_drone_reading", "Its last reading, in the unit", labels=["drone", "unit"])
    for drone in drones:
        if (last := watch.last_reading(drone.id)) is not None:
            reading.add_metric([str(drone.id), last[1]], last[0])
    yield reading


def _attention(found: list[Condition]) -> Metric:
    metric = GaugeMetricFamily(
        "rass_attention", "1 for each condition that needs attention", labels=["level", "kind", "drone"]
    )
    of_node: set[str] = set()
    for one in found[:MOST_CONDITIONS]:
        if one.drone is not None or one.kind not in of_node:
            of_node.add(one.kind)
            metric.add_metric([one.level.word, one.kind, "" if one.drone is None else str(one.drone)], 1.0)
    return metric

"""The state of a node as metrics, after the conventions of Prometheus (https://prometheus.io/docs/practices/naming/)."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily, Metric

#: Names in the ledger that can fall.
_GAUGES = ("handovers_pending", "overheard")


def figures(status: dict[str, Any], store: Path) -> Iterator[Metric]:
    """:param status: as `rass-mav status --json` prints it.
    :param store: the node's store, whose disk is asked how much is free.
    """
    about = {name: str(status[name]) for name in ("node_id", "role", "version", "policy", "life", "epoch")}
    yield InfoMetricFamily("rass_node", "The node", about)
    yield _gauge("rass_uptime_seconds", "Since the node was started", status["uptime_s"])
    yield _counter("rass_steps", "Steps done", status["steps"])
    yield _counter("rass_steps_skipped", "Steps skipped because the computer was late", status["skipped_steps"])
    yield _gauge("rass_step_age_seconds", "Since the last step", status["step_age_s"])
    yield _gauge("rass_neighbours", "Nodes in range", len(status["neighbours"]))
    yield _gauge("rass_hops", "Hops to a base; absent without a route", status["hop_count"])
    # A base has no risk of its own: what arrives there is at its goal.
    risk = None if status["role"] == "base" else status["risk"]
    yield _gauge("rass_risk", "0 to 1, if unknown the worst; of a drone", risk)
    yield from _of_store(status, store)
    for name, count in status["ledger"].items():
        make = _gauge if name in _GAUGES else _counter
        yield make(f"rass_ledger_{name}", f"{name} of the node's ledger", count)
    commits = status["commits"]
    yield _counter("rass_commits", "Commits of the store", commits["done"])
    yield _counter("rass_commits_failed", "Commits that failed, and were tried again", commits["failed"])
    yield _gauge("rass_frames_waiting", "Frames waiting for a commit", commits["frames_waiting"])
    yield _counter("rass_frames_dropped", "Frames dropped while they waited for a commit", commits["frames_dropped"])
    yield _counter("rass_frames_malformed", "Frames that were not understood", status["malformed"])
    yield _counter("rass_frames_foreign", "Frames of other programs", status["foreign"])
    faults = status["faults"]
    yield _counter("rass_faults", "Frames that triggered a fault in this program", faults["count"] if faults else 0)
    yield from _of_links(status["links"])
    yield from _of_outlets(status["outputs"] or {})


def _of_store(status: dict[str, Any], path: Path) -> Iterator[Metric]:
    store = status["store"]
    yield _gauge("rass_store_items", "Data in the store", store["items"])
    yield _gauge("rass_store_replicas", "Replicas among them", store["replicas"])
    yield _gauge("rass_store_bytes", "Bytes of data in the store", store["bytes"])
    yield _gauge("rass_store_free_bytes", "Free space for the store, on the disk or in its quota", _free(store, path))
    if status["role"] == "base":
        yield _counter("rass_data_arrived", "Data that have arrived at this base", store["items"])


def _free(store: dict[str, Any], path: Path) -> float | None:
    try:
        disk = os.statvfs(path)
    except OSError:
        return None
    free = disk.f_bavail * disk.f_frsize
    quota = store["quota_bytes"]
    return free if quota is None else max(0, min(free, quota - store["bytes"]))


def _of_links(links: Iterable[dict[str, Any]]) -> Iterator[Metric]:
    sent = CounterMetricFamily("rass_link_sent", "Datagrams sent", labels=["link"])
    received = CounterMetricFamily("rass_link_received", "Datagrams received", labels=["link"])
    dropped = CounterMetricFamily("rass_link_dropped", "Datagrams lost in buffers", labels=["link", "direction"])
    usable = GaugeMetricFamily("rass_link_usable", "1: yes; 0: it has a problem, which `status` names", labels=["link"])
    for link in links:
        name = link["name"]
        sent.add_metric([name], link["sent"])
        received.add_metric([name], link["received"])
        dropped.add_metric([name, "in"], link["dropped_in"])
        dropped.add_metric([name, "out"], link["dropped_out"])
        usable.add_metric([name], 0 if link["trouble"] else 1)
    yield from (sent, received, dropped, usable)


def _of_outlets(outputs: dict[str, Any]) -> Iterator[Metric]:
    if (hook := outputs.get("on_arrival")) is not None:
        yield _counter("rass_on_arrival_succeeded", "Data for which the command succeeded", hook["succeeded"])
        yield _counter("rass_on_arrival_failed", "Data for which the command failed", hook["failed"])
        yield _gauge("rass_on_arrival_behind", "Data for which it has not been run yet", hook["behind"])
    if (posted := outputs.get("postgres")) is not None:
        yield _counter("rass_postgres_written", "Data written to the database", posted["posted"])
        yield _gauge("rass_postgres_behind", "Data that are not in the database yet", posted["behind"])
        yield _gauge("rass_postgres_connected", "1: the database can be reached", int(posted["connected"]))
    if (cot := outputs.get("cot")) is not None:
        yield _counter("rass_cot_sent", "Events sent to TAK", cot["sent"])
        yield _gauge("rass_cot_connected", "1: the server or client can be reached", int(cot["connected"]))


def _gauge(name: str, help: str, value: float | None) -> Metric:
    """Without a value, the metric has no sample."""
    metric = GaugeMetricFamily(name, help)
    if value is not None:
        metric.add_metric([], value)
    return metric


def _counter(name: str, help: str, value: float) -> Metric:
    return CounterMetricFamily(name, help, value)

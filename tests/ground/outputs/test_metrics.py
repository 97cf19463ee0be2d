"""/metrics and /healthz of real bases."""

from __future__ import annotations

import json
import re
import select
import signal
import socket
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from threading import Event
from typing import Any

import pytest
import yaml

from rass_mav.app.outlets import MetricsSection
from tests.app.app_nodes import ROOT, RunningNode, Tidy, line_of
from tests.patience import PATIENCE_S

from .beside import served

pytest.importorskip("prometheus_client", reason="prometheus-client is not installed")

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.parser import text_string_to_metric_families

from rass_mav.core.datum import Kind
from rass_mav.ground.archive import Archive
from rass_mav.ground.outputs import metrics
from rass_mav.ground.outputs.drones import Drones
from rass_mav.ground.outputs.metrics import MOST_CLIENTS, Metrics, Node
from rass_mav.wire.nodestatus import NodeStatus, encode_status
from tests.ground.missions import HERE, Base

METRICS = {"listen": "127.0.0.1:0"}
[GROUP] = yaml.safe_load((ROOT / "docs/examples/prometheus-alerts.yml").read_text(encoding="utf-8"))["groups"]
ALERTS = GROUP["rules"]


def get(address: str, page: str) -> tuple[int, str]:
    try:
        with urllib.request.urlopen(f"http://{address}{page}", timeout=PATIENCE_S) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read().decode()


def samples(text: str) -> dict[tuple[str, tuple[tuple[str, str], ...]], float]:
    return {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


@pytest.mark.processes_measured
def test_the_figures_of_a_base_are_those_of_its_status(tmp_path: Path, tidy: Tidy) -> None:
    base, far = (tidy(node) for node in line_of(tmp_path, [1, 2]))
    with (tmp_path / base.config).open("a") as file:
        file.write(f"metrics: {json.dumps(METRICS)}\non_arrival: {{command: ['true']}}\n")
    base.start()
    far.start()
    for number in range(3):
        far.ask("put", payload=b"datum %d" % number)
    base.until(lambda: base.status()["outputs"].get("on_arrival", {}).get("succeeded") == 3)
    base.until(lambda: len(base.status()["neighbours"]) == 1)
    address = served(base, "metrics")
    found: dict[Any, float] = {}
    families: set[str] = set()

    def current() -> bool:
        code, text = get(address, "/metrics")
        assert code == 200
        found.update(samples(text))
        families.update(re.findall(r"^# TYPE (\S+)", text, re.M))
        told = found.get(("rass_drone_data_arrived", (("drone", "2"),)))
        return found["rass_data_arrived_total", ()] == told == found["rass_on_arrival_succeeded_total", ()] == 3

    base.until(current)
    status = base.status()
    [link] = status["links"]
    assert found["rass_store_items", ()] == 3
    assert found["rass_store_bytes", ()] == status["store"]["bytes"]
    assert found["rass_store_free_bytes", ()] > 0
    assert found["rass_hops", ()] == 0
    assert ("rass_risk", ()) not in found, "a base has none of its own"
    assert 0 < found["rass_link_received_total", (("link", link["name"]),)] <= link["received"]
    assert found["rass_link_usable", (("link", link["name"]),)] == 1
    assert 0 < found["rass_steps_total", ()] <= status["steps"]
    assert found["rass_ledger_refused_total", ()] == status["ledger"]["refused"]
    info = next(dict(labels) for name, labels in found if name == "rass_node_info")
    assert (info["node_id"], info["role"]) == ("1", "base")
    assert all(re.fullmatch(r"rass_[a-z_]+", name) for name, _ in found)
    assert {name for rule in ALERTS for name in re.findall(r"rass_\w+", rule["expr"])} <= families
    assert get(address, "/healthz") == (200, "ok\n")
    assert get(address, "/")[0] == 404
    # The node hangs: nothing answers for it.
    assert base.process is not None
    base.process.send_signal(signal.SIGSTOP)
    code, text = get(address, "/healthz")
    while code == 200:  # said a moment ago
        code, text = get(address, "/healthz")
    assert (code, "does not answer" in text) == (503, True)
    assert get(address, "/metrics")[0] == 503
    base.process.send_signal(signal.SIGCONT)
    base.until(lambda: get(address, "/healthz")[0] == 200)
    for node in (base, far):
        assert node.signal(signal.SIGTERM) == 0


def test_clients_that_hang_cost_a_bounded_amount(tmp_path: Path, tidy: Tidy) -> None:
    node = tidy(RunningNode(tmp_path, 1, node={"role": "base"}, metrics=METRICS)).start()
    host, port = served(node, "metrics").split(":")
    with ExitStack() as stack:
        for _ in range(3 * MOST_CLIENTS):
            stack.enter_context(socket.create_connection((host, int(port)), PATIENCE_S))

        def answered() -> bool:
            try:
                return get(f"{host}:{port}", "/healthz")[0] == 200
            except OSError:
                return False

        node.until(answered)
    assert node.signal(signal.SIGTERM) == 0


@contextmanager
def serving(socket: Path) -> Iterator[tuple[str, int]]:
    """Where it serves the pages of whatever answers on that socket."""
    pages, stopping = Metrics(MetricsSection(**METRICS), socket, socket), Event()
    thread = threading.Thread(target=pages.run, args=[stopping])
    thread.start()
    try:
        deadline = time.monotonic() + PATIENCE_S
        while (listens := pages.report()["listen"]) is None:
            assert time.monotonic() < deadline, pages.report()
        host, port = listens.split(":")
        yield host, int(port)
    finally:
        stopping.set()
        thread.join()


def test_clients_that_ask_slowly_make_way(tmp_path: Path) -> None:
    with serving(tmp_path / "n.sock") as (host, port), ExitStack() as stack:
        for _ in range(3 * MOST_CLIENTS):
            client = stack.enter_context(socket.create_connection((host, port), PATIENCE_S))
            client.sendall(b"GET /healthz HTTP/1.0\r\nA:")
        code, text = get(f"{host}:{port}", "/healthz")
        assert (code, "no running node" in text) == (503, True)


def test_a_client_that_has_asked_keeps_its_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    asked, answers = Event(), Event()
    with answering(Path("n.sock"), asked, answers, step_s=1.0, step_age_s=0.0), ExitStack() as stack:
        host, port = stack.enter_context(serving(Path("n.sock")))
        first = stack.enter_context(socket.create_connection((host, port), PATIENCE_S))
        first.sendall(b"GET /healthz HTTP/1.0\r\n\r\n")
        assert asked.wait(PATIENCE_S)
        others = [stack.enter_context(socket.create_connection((host, port), PATIENCE_S)) for _ in range(MOST_CLIENTS)]
        assert others[0].recv(1) == b""
        answers.set()
        assert first.makefile("rb").read().endswith(b"ok\n")


def test_a_request_has_one_deadline_however_often_something_comes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(metrics, "REQUEST_S", 0.05)
    with serving(tmp_path / "n.sock") as (host, port), socket.create_connection((host, port)) as client:
        client.sendall(b"GET /healthz HTTP/1.0\r\nA:")
        for _ in range(2000):
            ended, _, _ = select.select([client], [], [], 0.01)
            if ended:
                break
            with suppress(OSError):  # it ends just now
                client.sendall(b"a")
        assert ended, "it has been let in for 400 times its time"


@contextmanager
def answering(path: Path, asked: Event | None = None, answers: Event | None = None, **status: Any) -> Iterator[None]:
    """A node that has only this to say, when `answers` is set."""
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(path))
        listening.listen()

        def answer() -> None:
            client, _ = listening.accept()
            with client, client.makefile("rwb") as file:
                file.readline()
                if asked is not None:
                    asked.set()
                assert answers is None or answers.wait(PATIENCE_S)
                file.write(json.dumps({"ok": True, "status": status}).encode() + b"\n")

        thread = threading.Thread(target=answer)
        thread.start()
        yield
        thread.join()


@pytest.mark.parametrize(
    ("step_s", "age_s", "illness"),
    [
        (0.1, None, "no step done yet"),
        (0.1, 4.9, ""),
        (0.1, 5.1, "the last step was 5.1 s ago"),
        (10.0, 49.0, ""),
        (10.0, 51.0, "the last step was 51.0 s ago"),
    ],
)
def test_a_node_is_ill_that_has_not_stepped_for_long(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step_s: float, age_s: float | None, illness: str
) -> None:
    monkeypatch.chdir(tmp_path)  # the path of a socket must be short
    with answering(Path("n.sock"), step_s=step_s, step_age_s=age_s):
        assert Node(Path("n.sock"), tmp_path).illness() == illness


def test_without_a_node_it_is_ill(tmp_path: Path) -> None:
    assert "no running node" in Node(tmp_path / "n.sock", tmp_path).illness()


class TestDrones:
    """What the base knows of each drone."""

    SAID = NodeStatus(9, 6, 0, 41, 0.2, 2, 73, (47.0, 8.0), {}, {})

    def samples(self, base: Base, now: float) -> dict[Any, float]:
        drones = Drones(lambda: Archive(base.path, now=lambda: now), now=lambda: now)
        drones.look()
        registry = CollectorRegistry()
        registry.register(_Of(drones))
        return samples(generate_latest(registry).decode())

    def test_each_has_its_figures(self, base: Base) -> None:
        base.arrive(
            base.measurement(7, 0, HERE, age_s=20.0), base.datum(7, 3, Kind.STATUS, encode_status(self.SAID)),
            base.datum(1, 0, Kind.STATUS, encode_status(self.SAID._replace(base=True))),
        )  # fmt: skip
        found = self.samples(base, base.wall)
        seven = (("drone", "7"),)
        assert found["rass_drone_last_heard_timestamp_seconds", seven] == base.wall
        of_seven = {
            name.removeprefix("rass_drone_"): value for (name, labels), value in found.items() if labels == seven
        }
        assert {name: of_seven[name] for name in of_seven if name != "last_heard_timestamp_seconds"} == {
            "silent": 0, "data_created": 4, "data_arrived": 2, "data_missing": 2, "data_lost": 0, "data_at_risk": 6,
            "store_held": 9, "store_free": 41, "battery_percent": 73,
        }  # fmt: skip
        assert found["rass_drone_reading", (("drone", "7"), ("unit", "usvh"))] == pytest.approx(0.142)
        assert not any(("drone", "1") in labels for _, labels in found), "a base is no drone"

    def test_what_needs_attention_has_a_sample_each(self, base: Base) -> None:
        base.arrive(base.datum(7, 0, Kind.STATUS, encode_status(self.SAID._replace(free=0, hops=None)), age_s=170.0))
        found = self.samples(base, base.wall + 15.0)
        attention = {tuple(value for _, value in labels) for name, labels in found if name == "rass_attention"}
        assert attention == {("7", "silent", "alarm"), ("7", "full", "alarm"), ("7", "no route", "warning")}
        assert found["rass_drone_silent", (("drone", "7"),)] == 1

    def test_invented_drones_are_bounded(self, base: Base, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("rass_mav.ground.outputs.drones.MOST_DRONES", 3)
        base.arrive(*(base.measurement(id, 0, HERE) for id in range(2, 40)))
        found = self.samples(base, base.wall)
        assert len([1 for name, _ in found if name == "rass_drone_data_created"]) == 3

    def test_a_store_that_cannot_be_read_is_trouble_and_no_end(self, tmp_path: Path) -> None:
        drones = Drones(lambda: Archive(tmp_path / "none.db"))
        drones.look()
        assert "none.db" in drones.trouble
        assert [family.name for family in drones.collect({})] == ["rass_attention"]


class _Of:
    """What a registry asks."""

    def __init__(self, drones: Drones) -> None:
        self._drones = drones

    def collect(self) -> Any:
        return self._drones.collect({})

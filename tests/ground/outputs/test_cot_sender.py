"""Cursor on Target over UDP, TCP and TLS: real listeners, which read with pytak."""

from __future__ import annotations

import asyncio
import shutil
import signal
import socket
import ssl
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from queue import Queue
from threading import Event
from typing import Any
from xml.etree import ElementTree

import pytest

from rass_mav.app.outlets import CotSection
from rass_mav.core.datum import Kind
from rass_mav.ground.entry import Opens
from rass_mav.wire.nodestatus import NodeStatus, encode_status
from tests.app.app_nodes import RunningNode, Tidy, command
from tests.ground.missions import HERE, Base
from tests.ground.sealed_data import OPENS, sealed
from tests.patience import PATIENCE_S

from .beside import report

pytest.importorskip("pytak", reason="pytak is not installed")

import pytak

from rass_mav.ground.outputs import cot_sender
from rass_mav.ground.outputs.cot_sender import CotSender

needs_openssl = pytest.mark.skipif(
    shutil.which("openssl") is None, reason="openssl is not installed (Debian: apt install openssl)"
)


class Listener:
    """A server of TAK that hands out what it hears, as pytak cuts it from the stream."""

    def __init__(self, context: ssl.SSLContext | None = None) -> None:
        self.heard: Queue[bytes] = Queue()
        self.connections: list[asyncio.StreamWriter] = []
        self._context = context
        self._loop = asyncio.new_event_loop()
        self._server = self._loop.run_until_complete(self._listen(0))
        self.port: int = self._server.sockets[0].getsockname()[1]
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()

    async def _listen(self, port: int) -> asyncio.Server:
        return await asyncio.start_server(self._serve, "127.0.0.1", port, ssl=self._context)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.connections.append(writer)
        # As a server does, to every client.
        writer.write(b'<event version="2.0" uid="x" type="t-x-c-t"/>' * 2000)
        worker = pytak.RXWorker(asyncio.Queue(), {"COT_URL": "tcp://127.0.0.1"}, reader)
        with suppress(OSError):
            while event := await worker.readcot():
                self.heard.put(event)
        writer.close()

    def next(self, wanted: Callable[[ElementTree.Element], bool] = lambda event: True) -> ElementTree.Element:
        """The next event that is wanted; each must be well-formed."""
        while True:
            event = ElementTree.fromstring(self.heard.get(timeout=PATIENCE_S))
            if wanted(event):
                return event

    def drop(self) -> None:
        """Close the connections."""
        for writer in self.connections:
            self._loop.call_soon_threadsafe(writer.close)
        self.connections.clear()

    def close(self) -> None:
        async def end() -> None:
            self._server.close()
            for writer in self.connections:
                writer.close()
            for task in asyncio.all_tasks() - {asyncio.current_task()}:
                task.cancel()

        asyncio.run_coroutine_threadsafe(end(), self._loop).result(PATIENCE_S)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(PATIENCE_S)
        self._loop.close()


@contextmanager
def listening(context: ssl.SSLContext | None = None) -> Iterator[Listener]:
    found = Listener(context)
    try:
        yield found
    finally:
        found.close()


@contextmanager
def sending(
    store: Base, opens: Opens | None = None, *, clock: Callable[[], float] | None = None, **section: Any
) -> Iterator[CotSender]:
    """A sender beside a store. `clock`: None: that of the store's node."""
    now = clock or (lambda: store.wall)
    task, stopping = CotSender(CotSection(**section), store.path, 1, opens, now=now), Event()
    thread = threading.Thread(target=task.run, args=(stopping,))
    thread.start()
    try:
        yield task
    finally:
        stopping.set()
        thread.join(PATIENCE_S)
        assert not thread.is_alive()


@pytest.fixture
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Base]:
    monkeypatch.setattr(cot_sender, "LOOK_S", 0.01)
    made = Base(tmp_path / "base.db")
    yield made
    made.close()


def until(condition: Callable[[], object]) -> None:
    """Wait for something on another thread."""
    found = threading.Event()
    for _ in range(round(PATIENCE_S / 0.05)):
        if condition():
            return
        found.wait(0.05)
    raise AssertionError("it did not happen")


def about(uid: str) -> Callable[[ElementTree.Element], bool]:
    return lambda event: event.get("uid") == uid


def place(event: ElementTree.Element) -> tuple[str | None, str | None]:
    point = event.find("point")
    assert point is not None
    return point.get("lat"), point.get("lon")


# -- the three ways ----------------------------------------------------------------------------------------------------


def test_over_tcp_each_datum_moves_its_drone(store: Base) -> None:
    with listening() as server, sending(store, url=f"tcp://127.0.0.1:{server.port}") as task:
        store.arrive(store.measurement(7, 0, HERE))
        event = server.next(about("rass-7"))
        assert (event.get("type"), *place(event)) == ("a-f-A-M-H-Q", "47.3769000", "8.5417000")
        store.arrive(store.measurement(7, 1, HERE._replace(latitude=47.4)))
        assert place(server.next(about("rass-7"))) == ("47.4000000", "8.5417000")
        until(lambda: task.report() == {
            "url": f"tcp://127.0.0.1:{server.port}", "connected": True, "sent": 2, "trouble": None,
        })  # fmt: skip
    assert task.report()["connected"] is False


def test_over_udp(store: Base) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        listener.settimeout(PATIENCE_S)
        with sending(store, url=f"udp://127.0.0.1:{listener.getsockname()[1]}"):
            store.arrive(store.measurement(7, 0, HERE))
            event = ElementTree.fromstring(listener.recv(1 << 16))
    assert (event.get("uid"), *place(event)) == ("rass-7", "47.3769000", "8.5417000")


def test_a_udp_address_that_nobody_listens_at_is_tried_again(store: Base) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        port = listener.getsockname()[1]
    store.arrive(*(store.measurement(drone, 0, HERE) for drone in range(2, 40)))
    with sending(store, url=f"udp://127.0.0.1:{port}") as task:
        until(lambda: "refused" in (task.report()["trouble"] or ""))


def certificates(folder: Path) -> None:
    """An authority, and a server's and a client's certificate that it has signed; and a stranger's."""

    def openssl(*words: str) -> None:
        subprocess.run(["openssl", *words], cwd=folder, check=True, capture_output=True, timeout=PATIENCE_S)

    new = ("req", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-days", "2")
    for name in ("ca", "stranger"):
        openssl(*new, "-x509", "-subj", f"/CN={name}", "-keyout", f"{name}.key", "-out", f"{name}.pem")
    for name in ("server", "client"):
        openssl(
            *new, "-x509", "-CA", "ca.pem", "-CAkey", "ca.key", "-subj", f"/CN={name}",
            "-addext", "subjectAltName=DNS:takserver", "-addext", "basicConstraints=critical,CA:FALSE",
            "-keyout", f"{name}.key", "-out", f"{name}.pem",
        )  # fmt: skip


def _troubled(task: CotSender) -> bool:
    return bool(task.report()["trouble"])


def tls(folder: Path, port: int, **other: Any) -> dict[str, Any]:
    files = {"cert_file": "client.pem", "key_file": "client.key", "ca_file": "ca.pem"}
    return {
        "url": f"tls://127.0.0.1:{port}", "server_name": "takserver",
        **{name: str(folder / file) for name, file in files.items()}, **other,
    }  # fmt: skip


@needs_openssl
# pytak switches old versions off in an old way.
@pytest.mark.filterwarnings("ignore:ssl.OP_NO_:DeprecationWarning")
def test_over_tls_both_ends_show_a_certificate(store: Base, tmp_path: Path) -> None:
    certificates(tmp_path)
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH, cafile=str(tmp_path / "ca.pem"))
    context.load_cert_chain(tmp_path / "server.pem", tmp_path / "server.key")
    context.verify_mode = ssl.CERT_REQUIRED
    store.arrive(store.measurement(7, 0, HERE))
    with listening(context) as server:
        with sending(store, **tls(tmp_path, server.port)):
            assert place(server.next(about("rass-7"))) == ("47.3769000", "8.5417000")
        for wrong, why in (
            ({"ca_file": str(tmp_path / "stranger.pem")}, "certificate verify failed"),
            ({"server_name": "other"}, "hostname mismatch"),
            ({"key_file": str(tmp_path / "stranger.key")}, "key values mismatch"),
            ({"cert_file": str(tmp_path / "none.pem")}, "none.pem"),
        ):
            with sending(store, **tls(tmp_path, server.port, **wrong)) as task:
                until(partial(_troubled, task))
                assert why in task.report()["trouble"].lower()
                assert task.report()["sent"] == 0
        assert server.heard.empty()


# -- how soon ----------------------------------------------------------------------------------------------------------


def test_what_arrives_is_sent_in_the_next_look_and_drawn_within_two_seconds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By a clock that goes on only while the sender rests: how fast the computer is does not matter."""
    store = Base(tmp_path / "base.db")
    stopping = Event()
    sent: list[tuple[float, ElementTree.Element]] = []
    arrived: dict[str, float] = {}
    rests: list[float] = []

    async def handle(worker: object, event: bytes) -> None:
        sent.append((store.wall, ElementTree.fromstring(event)))

    async def rest(seconds: float) -> None:
        """Between two looks: the next drone's readings arrive."""
        store.wall += seconds
        rests.append(seconds)
        n = len(arrived)
        if n < 5:
            arrived[f"rass-{7 + n}"] = store.wall
            around = [
                HERE._replace(
                    latitude=47.0 + 0.01 * n + 1e-4 * row, longitude=8.0 + 1e-4 * column, unit="usvh",
                    reading=500.0 / (1 + row**2 + column**2), risk=1.0 if row == column == 0 else 0.5,
                )
                for row in range(-3, 4) for column in range(-3, 4)
            ]  # fmt: skip
            store.arrive(*(store.measurement(7 + n, number, one) for number, one in enumerate(around)))
        elif store.wall > max(arrived.values()) + 2.0:
            stopping.set()

    monkeypatch.setattr(pytak.TXWorker, "handle_data", handle)
    monkeypatch.setattr(asyncio, "sleep", rest)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        section = CotSection(url=f"udp://127.0.0.1:{listener.getsockname()[1]}")
        CotSender(section, store.path, 1, now=lambda: store.wall).run(stopping)
    store.close()

    def first(wanted: Callable[[ElementTree.Element], bool], since: float) -> float:
        return next(at for at, event in sent if at >= since and wanted(event)) - since

    for uid, at in arrived.items():
        assert first(about(uid), at) == 0.0
        assert first(lambda event: event.get("type") == "b-m-p-s-m", at) == 0.0
        # What arrives at the beginning of a rest has waited for all of it before.
        assert max(rests) + first(lambda event: event.get("type") == "u-d-f", at) <= 2.0


# -- what goes wrong ---------------------------------------------------------------------------------------------------


def test_a_server_that_comes_back_gets_everything_again(store: Base, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rass_mav.ground.outputs.task.AGAIN_S", 0.01)
    store.arrive(store.measurement(7, 0, HERE), store.measurement(8, 0, HERE))
    with listening() as server, sending(store, url=f"tcp://127.0.0.1:{server.port}") as task:
        first = {server.next().get("uid") for _ in range(2)}
        server.drop()
        assert {server.next().get("uid") for _ in range(2)} == first == {"rass-7", "rass-8"}
        until(lambda: task.report()["trouble"] is None)


def test_a_server_that_reads_nothing_holds_up_nobody(store: Base, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cot_sender, "PATIENCE_S", 0.2)
    monkeypatch.setattr(cot_sender, "AGAIN_AFTER_S", 0.0)
    with socket.create_server(("127.0.0.1", 0)) as deaf:
        deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1)
        store.arrive(*(store.measurement(drone, 0, HERE) for drone in range(2, 400)))
        with sending(store, url=f"tcp://127.0.0.1:{deaf.getsockname()[1]}") as task:
            until(lambda: "no answer within" in (task.report()["trouble"] or ""))


def test_what_does_not_change_is_sent_again(store: Base, monkeypatch: pytest.MonkeyPatch) -> None:
    """Clients that come later have it too."""
    monkeypatch.setattr(cot_sender, "AGAIN_AFTER_S", 0.0)
    store.arrive(store.measurement(7, 0, HERE))
    with listening() as server, sending(store, url=f"tcp://127.0.0.1:{server.port}"):
        assert [server.next().get("uid") for _ in range(3)] == ["rass-7"] * 3


def test_a_hot_spot_that_is_one_no_more_is_deleted(store: Base) -> None:
    hot = HERE._replace(reading=5.0, risk=1.0)
    store.arrive(store.measurement(7, 0, hot))
    with listening() as server, sending(store, url=f"tcp://127.0.0.1:{server.port}"):
        first = server.next(lambda event: event.get("type") == "b-m-p-s-m")
        store.arrive(store.measurement(7, 1, hot._replace(reading=9.0)))
        gone = server.next(lambda event: event.get("type") == "t-x-d-d")
        assert [link.get("uid") for link in gone.iter("link")] == [first.get("uid")]


def test_a_silent_drone_is_not_deleted(store: Base) -> None:
    store.arrive(store.measurement(7, 0, HERE))
    with listening() as server, sending(store, url=f"tcp://127.0.0.1:{server.port}"):
        server.next(about("rass-7"))
        store.wall += 1000.0
        store.arrive(store.measurement(8, 0, HERE))
        assert server.next().get("uid") == "rass-8"


def test_sealed_data_move_nothing_but_with_the_keys(store: Base) -> None:
    store.arrive(sealed(store.measurement(7, 0, HERE)))
    with listening() as server:
        with sending(store, url=f"tcp://127.0.0.1:{server.port}"):
            store.arrive(store.measurement(8, 1, HERE))
            assert server.next().get("uid") == "rass-8"
        with sending(store, OPENS, url=f"tcp://127.0.0.1:{server.port}"):
            assert {server.next().get("uid") for _ in range(2)} == {"rass-7", "rass-8"}


def test_a_store_without_a_date_says_how_old_its_places_are(tmp_path: Path, store: Base) -> None:
    (tmp_path / "lost").mkdir()
    undated = Base(tmp_path / "lost" / "base.db", trusted=False, wall=1000.0)
    undated.arrive(undated.measurement(7, 0, HERE, age_s=60.0))
    with listening() as server, sending(undated, url=f"tcp://127.0.0.1:{server.port}", clock=lambda: store.wall):
        event = server.next(about("rass-7"))
    assert (event.get("time"), event.get("start")) == ("2026-11-22T10:00:00.000Z", "2026-11-22T09:59:00.000Z")
    undated.close()


def test_a_base_of_a_status_without_a_place_is_on_no_map(store: Base) -> None:
    status = NodeStatus(1, 0, 0, None, 0.0, 0, None, None, {}, {}, base=True)
    store.arrive(store.datum(1, 0, Kind.STATUS, encode_status(status)))
    with listening() as server, sending(store, url=f"tcp://127.0.0.1:{server.port}") as task:
        until(lambda: task.report()["connected"])
        store.arrive(store.datum(1, 1, Kind.STATUS, encode_status(status._replace(place=(47.0, 8.0)))))
        event = server.next()
        assert (event.get("uid"), event.get("type"), *place(event)) == (
            "rass-1", "a-f-G-I-U-T", "47.0000000", "8.0000000",
        )  # fmt: skip


# -- beside a real base ------------------------------------------------------------------------------------------------


def test_a_real_base_shows_itself(tmp_path: Path, tidy: Tidy) -> None:
    with listening() as server:
        url = f"tcp://127.0.0.1:{server.port}"
        node = tidy(
            RunningNode(tmp_path, 1, node={"role": "base"}, base={"place": [47.0, 8.0]}, cot={"url": url})
        ).start()
        event = server.next(about("rass-1"))
        assert (event.get("type"), *place(event)) == ("a-f-G-I-U-T", "47.0000000", "8.0000000")
        node.until(lambda: report(node, "cot").get("sent", 0) >= 1)
        assert f"cot: {url}, connected, 1 events sent" in command(tmp_path, "status", "n1.yaml").stdout.decode()
        assert node.signal(signal.SIGTERM) == 0


def test_a_server_that_is_away_needs_attention(tmp_path: Path, tidy: Tidy) -> None:
    with socket.create_server(("127.0.0.1", 0)) as away:
        url = f"tcp://127.0.0.1:{away.getsockname()[1]}"
    node = tidy(RunningNode(tmp_path, 1, node={"role": "base"}, cot={"url": url})).start()
    node.until(lambda: "connect call failed" in str(report(node, "cot")).lower())
    assert f"WARNING: cot: {url}: " in command(tmp_path, "status", "n1.yaml").stdout.decode()
    assert node.signal(signal.SIGTERM) == 0

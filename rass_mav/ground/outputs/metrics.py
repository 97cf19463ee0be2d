"""/metrics for Prometheus and /healthz, over HTTP. The node is asked on its control socket, at most once a second."""

from __future__ import annotations

import math
import socket
import socketserver
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from threading import Event
from typing import Any

from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, generate_latest
from prometheus_client.core import Metric
from prometheus_client.registry import Collector

from rass_mav.app.client import ControlClient
from rass_mav.app.outlets import MetricsSection
from rass_mav.errors import ControlError, LinkError, os_errors_as
from rass_mav.ground.archive import Archive
from rass_mav.ground.attention.rules import RuleBook
from rass_mav.ground.entry import Opens
from rass_mav.link.address import parse_address

from .drones import Drones
from .figures import figures
from .task import Task

#: A node that has not stepped for so many steps, and so many seconds, is not healthy.
LATE_STEPS = 5
LATE_S = 5.0
#: The status is asked for again when it is older, seconds.
FRESH_S = 1.0
#: Clients at a time, and how long one may take for its whole request, and to take the answer, seconds.
MOST_CLIENTS = 8
REQUEST_S = 5.0
#: Seconds between two looks at the event that ends it.
_LOOK_S = 0.5


class Node:
    """The state of the node, as it last said."""

    def __init__(self, socket: Path, store: Path) -> None:
        self._socket = socket
        self._store = store
        self._lock = threading.Lock()
        self._asked = -FRESH_S
        self._status: dict[str, Any] | str = ""

    def status(self) -> dict[str, Any]:
        """Raises `ControlError` if it does not answer."""
        with self._lock:
            if time.monotonic() - self._asked >= FRESH_S:
                try:
                    with ControlClient(self._socket, timeout_s=LATE_S) as client:
                        self._status = client.ask("status")["status"]
                except ControlError as error:
                    self._status = str(error)
                self._asked = time.monotonic()
            if isinstance(self._status, str):
                raise ControlError(self._status)
            return self._status

    def collect(self) -> Iterator[Metric]:
        """Raises `ControlError`."""
        return figures(self.status(), self._store)

    def illness(self) -> str:
        """Why it does not work; empty: it does."""
        try:
            status = self.status()
        except ControlError as error:
            return str(error)
        age_s, limit_s = status["step_age_s"], max(LATE_STEPS * status["step_s"], LATE_S)
        if age_s is None:
            return "no step done yet"
        return f"the last step was {age_s:.1f} s ago" if age_s > limit_s else ""


class _Figures(Collector):
    def __init__(self, node: Node, drones: Drones) -> None:
        self._node, self._drones = node, drones

    def collect(self) -> Iterator[Metric]:
        yield from self._node.collect()
        yield from self._drones.collect(self._node.status())


class _Handler(BaseHTTPRequestHandler):
    timeout = REQUEST_S
    server: _Server

    def do_GET(self) -> None:
        self.server.has_asked(self.request)
        path = self.path.partition("?")[0]
        if path == "/healthz":
            illness = self.server.node.illness()
            self._answer(503 if illness else 200, f"{illness or 'ok'}\n".encode())
        elif path == "/metrics":
            try:
                found = generate_latest(self.server.registry)
            except ControlError as error:
                self._answer(503, f"{error}\n".encode())
            else:
                self._answer(200, found, CONTENT_TYPE_LATEST)
        else:
            self._answer(404, b"/metrics or /healthz\n")

    def _answer(self, code: int, body: bytes, type: str = "text/plain; charset=utf-8") -> None:
        self.send_response(code)
        self.send_header("Content-Type", type)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:
        """A scrape is not worth a line."""


class _Server(socketserver.ThreadingTCPServer):
    allow_reuse_address = True
    daemon_threads = True
    block_on_close = False
    timeout = _LOOK_S

    def __init__(self, address: tuple[str, int], node: Node, drones: Drones) -> None:
        self.node = node
        self.registry = CollectorRegistry()
        self._places = threading.BoundedSemaphore(MOST_CLIENTS)
        self._lock = threading.Lock()
        self._unasked: dict[socket.socket, float] = {}
        """Clients whose request is not complete, and until when it must be; the oldest first."""
        super().__init__(address, _Handler)
        self.registry.register(_Figures(node, drones))

    def process_request(self, request: Any, client_address: Any) -> None:
        """If there is no place, the client makes way that has waited longest without a whole request; if all have
        asked, it is the new one."""
        if not self._places.acquire(blocking=False):
            self._cut_oldest(math.inf)
            # The thread of the one that was cut ends at once.
            if not self._places.acquire(timeout=_LOOK_S):
                self.shutdown_request(request)
                return
        with self._lock:
            self._unasked[request] = time.monotonic() + REQUEST_S
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._places.release()

    def has_asked(self, request: socket.socket) -> None:
        """Its request is complete. Raises `ConnectionError` if it was cut off meanwhile."""
        with self._lock:
            if self._unasked.pop(request, None) is None:
                raise ConnectionAbortedError("the client took too long")

    def shutdown_request(self, request: Any) -> None:
        """It is over, whether it has asked or not."""
        with self._lock:
            self._unasked.pop(request, None)
        super().shutdown_request(request)

    def cut_late(self) -> None:
        """Cut off the clients whose requests are not complete in time."""
        while self._cut_oldest(time.monotonic()):
            pass

    def _cut_oldest(self, now: float) -> bool:
        """Whether there was one that must be complete before `now`. Its thread sees the end and closes it."""
        with self._lock:
            oldest = next(iter(self._unasked), None)
            if oldest is None or self._unasked[oldest] > now:
                return False
            del self._unasked[oldest]
            with suppress(OSError):  # it is gone already
                oldest.shutdown(socket.SHUT_RDWR)
            return True

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that goes away or takes too long is no fault; anything else is."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(request, client_address)


class Metrics(Task):
    """Serves both pages."""

    name = "metrics"
    last_s = 1.0

    def __init__(
        self, section: MetricsSection, socket: Path, store: Path, opens: Opens | None = None,
        rules: RuleBook | None = None,
    ) -> None:  # fmt: skip
        """`socket`: of the node that writes the store. `opens`: opens sealed data; None: they stay sealed. `rules`: of
        what needs attention."""
        super().__init__()
        self._address = parse_address(section.listen, any_port=True)
        self._drones = Drones(lambda: Archive(store, salvage=False, opens=opens), rules)
        self._node = Node(socket, store)
        self._listens: str | None = None

    def report(self) -> dict[str, Any]:
        """For `status`."""
        return {"listen": self._listens, "trouble": self.trouble or self._drones.trouble or None}

    def work(self, stopping: Event) -> None:
        """Raises `LinkError`: the address cannot be used."""
        with os_errors_as(LinkError, "{}:{}".format(*self._address)):
            server = _Server(self._address, self._node, self._drones)
        self.works()
        with server:
            self._listens = "{}:{}".format(*server.server_address[:2])
            while not stopping.is_set():
                server.handle_request()
                server.cut_late()
                self._drones.look()

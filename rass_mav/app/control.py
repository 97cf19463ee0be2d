"""The local control socket: newline-delimited JSON over a unix stream socket, for `status`, `put` and `measure`.

A file that is larger than a datum comes in several requests (`file_requests`).

A request is one object on one line, `{"command": "put", "kind": 0, "payload": "<base64>"}`. So is an answer,
`{"ok": true, ...}` or `{"ok": false, "error": "..."}`. What the node holds is read from its store. Any user who can
open the socket's file can use it; only the node's own user can.

A client that stops is disconnected. While all places are taken, the next client waits for one. If none gets free, the
client that has been silent longest makes way, so clients that hang do not lock others out. A client whose request is
being answered always keeps its place.
"""

from __future__ import annotations

import asyncio
import logging
import os
import socket
import stat
from collections.abc import Callable, Coroutine, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from rass_mav.config.sections import Meta, Section
from rass_mav.config.typed import build
from rass_mav.core.datum import MAX_PAYLOAD, MOST_PRIORITY, MOST_TTL_S, TERMS, USUAL_PRIORITY, Kind, Terms
from rass_mav.errors import ConfigError, ControlError, MalformedError, RassError, StoreDamagedError, why
from rass_mav.sensor.settings import SensorSettings

from .driver import Driver
from .jsonlines import dump_line, load_bytes, load_line
from .on_demand import FilesOnDemand
from .payloads import parse_name
from .status import status

if TYPE_CHECKING:
    from .measures import Measures
    from .spool import Draft

log = logging.getLogger(__name__)

T = TypeVar("T")

#: Longest line, bytes: the largest payload in base64, and the rest of the line.
MAX_LINE = (MAX_PAYLOAD + 2) // 3 * 4 + 4096
#: Clients at a time. Each may hold two waiting lines and one that is being read, 4.3 MB; all of them hold 35 MB, which
#: a Pi Zero has.
MAX_CLIENTS = 8
#: Clients that wait for a place, in the kernel: what it allows by default on old systems.
WAITING = 128
#: A client that we have waited for this long, seconds, makes way if another one needs its place.
SPARED_S = 1.0
#: A client without a request for this long, seconds, is disconnected.
IDLE_S = 60.0
#: How long a request may take to be complete once begun, and an answer to be taken, seconds.
REQUEST_S = 5.0
TAKE_S = 5.0
#: Longest name of a field in a request, characters.
_MAX_NAME = 32
# Seconds until the node tries again to accept a client, when it could not.
AGAIN_S = 1.0
# How long answers in progress may still take when the node stops, seconds.
_LAST_WORDS_S = 2.0


class Request(Section):
    """What a client asks."""

    async def answer(self, control: ControlServer, client: Client) -> dict[str, Any]:
        """Do it. Raises `RassError` if that fails."""
        raise NotImplementedError

    @classmethod
    def misread(cls, control: ControlServer, reason: str) -> None:
        """Take note of a request of this kind that is malformed."""


class StatusRequest(Request):
    """The state of the node."""

    async def answer(self, control: ControlServer, client: Client) -> dict[str, Any]:
        """As `rass-mav status --json` shows it."""
        return {"status": control.status()}


class WithTerms(Request):
    """What creates data."""

    priority: Annotated[int, Meta(ge=0, le=MOST_PRIORITY)] = USUAL_PRIORITY
    ttl_s: Annotated[int, Meta(ge=1, le=MOST_TTL_S)] | None = None
    """They expire when they are older, seconds; null: never."""

    @property
    def terms(self) -> Terms:
        """Both."""
        return Terms(self.priority, self.ttl_s)


class PutRequest(WithTerms):
    """Create a datum."""

    payload: str
    """1 byte to 1 MiB, in base64."""
    kind: Annotated[int, Meta(ge=0, lt=TERMS)] = Kind.BYTES

    async def answer(self, control: ControlServer, client: Client) -> dict[str, Any]:
        """Its id, when it is on disk."""
        with understood():
            payload = load_bytes(self.payload)
        return {"id": str(await control.driver.put(payload, self.kind, self.terms))}


class ProgressRequest(Request):
    """How much of a datum or of a file has arrived."""

    id: str
    """As `put` and `done` answer it."""

    async def answer(self, control: ControlServer, client: Client) -> dict[str, Any]:
        """As far as the node knows."""
        return {**control.files.progress(parse_name(self.id)[0])}


#: The requests by their command: `module:name` of a `Request`. A node loads those in other modules with the first one.
_REQUESTS = {
    "progress": f"{__name__}:ProgressRequest",
    "status": f"{__name__}:StatusRequest",
    "put": f"{__name__}:PutRequest",
    "measure": "rass_mav.app.measure_request:MeasureRequest",
    "refused": "rass_mav.app.measure_request:RefusedRequest",
    "file": "rass_mav.app.file_requests:FileRequest",
    "piece": "rass_mav.app.file_requests:PieceRequest",
    "done": "rass_mav.app.file_requests:DoneRequest",
}


@contextmanager
def understood() -> Iterator[None]:
    """Raise a `ControlError` for what is no request."""
    try:
        yield
    except (MalformedError, ConfigError) as error:
        raise ControlError(f"not a request: {'; '.join(error.lines())}") from None


class Client:
    """A connected client."""

    __slots__ = ("_reader", "_writer", "answered", "draft", "waited_for")

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader = reader
        self._writer = writer
        # With this, `drain` returns when the kernel has everything, and nothing is left when the client is gone.
        writer.transport.set_write_buffer_limits(high=0)
        self.answered = False
        """Whether a request of the client is being answered."""
        self.draft: Draft | None = None
        """The file that it puts."""
        self.waited_for: float | None = _now()
        """Since when we wait for the next bytes of its request, or for it to take the answer; None: we do not wait."""

    @classmethod
    async def accepted(cls, sock: socket.socket) -> Client:
        """The one at the other end."""
        loop = asyncio.get_running_loop()
        protocol = _Heard(reader := asyncio.StreamReader(MAX_LINE))
        transport, _ = await loop.connect_accepted_socket(lambda: protocol, sock)
        protocol.client = client = cls(reader, asyncio.StreamWriter(transport, protocol, reader, loop))
        return client

    async def request(self) -> bytes:
        """The next line; empty: the client is done. Raises `ConnectionError` if none comes in time, `ControlError` if
        it is too long or has no end."""
        self.waited_for = _now()
        line = await _in_time(self._reader.read(1), IDLE_S)
        if line and line != b"\n":
            try:
                line += await _in_time(self._reader.readline(), REQUEST_S)
            except ValueError:
                raise ControlError(f"request too long, expected at most {MAX_LINE} bytes") from None
            except ConnectionAbortedError:
                raise ControlError(f"request not complete after {REQUEST_S:g} s") from None
            if not line.endswith(b"\n"):
                raise ControlError("request without a newline")
        self.waited_for = None
        return line

    async def say(self, answer: dict[str, Any]) -> None:
        """Send an answer. Returns when the client has taken it. Raises `ConnectionError` if that takes too long."""
        self._writer.write(dump_line(answer))
        self.waited_for = _now()
        await _in_time(self._writer.drain(), TAKE_S)
        self.waited_for = None

    def displace(self) -> None:
        """Close the connection at once, and say why unless it is in the middle of an answer."""
        if not self._writer.transport.get_write_buffer_size():
            self._writer.write(dump_line({"ok": False, "error": "too many clients, try again"}))
        self.cut()

    def cut(self) -> None:
        """Close the connection at once."""
        self._writer.transport.abort()


class _Heard(asyncio.StreamReaderProtocol):
    """Notes when a client says something."""

    client: Client | None = None

    def data_received(self, data: bytes) -> None:
        """The wait for it begins again."""
        if self.client is not None and self.client.waited_for is not None:
            self.client.waited_for = _now()
        super().data_received(data)


class ControlServer:
    """Answers on a unix socket for a driver."""

    def __init__(
        self,
        driver: Driver,
        path: Path,
        files: FilesOnDemand,
        around: Callable[[], dict[str, Any]] = dict,
        sensor: SensorSettings | None = None,
    ) -> None:
        """`path`: the socket's file. `files`: those that are put. `around`: what else `status` shows, which the driver
        does not know. `sensor`: where the node's readings come from; None: the default."""
        self.driver = driver
        self.files = files
        self.sensor = sensor or SensorSettings()
        self.measures: Measures | None = None
        """The readings that programs have handed in; None: there was none."""
        self._around = around
        self._path = path
        self._started = driver.now()
        self._listening: asyncio.Task[None] | None = None
        self._clients: dict[Client, asyncio.Task[None]] = {}
        self._turn = asyncio.Lock()

    async def start(self) -> None:
        """Start listening. Raises `ControlError` if another node listens there, or the file cannot be created."""
        self._socket = _listening_socket(self._path)
        self._listening = asyncio.create_task(self._listen())

    async def close(self) -> None:
        """Stop listening, and finish the answers in progress."""
        if self._listening is None:
            return
        listening, self._listening = self._listening, None
        listening.cancel()
        await asyncio.wait([listening])
        self._socket.close()
        self._path.unlink(missing_ok=True)
        for client, task in self._clients.items():
            if not client.answered:
                task.cancel()
        if self._clients:
            _, late = await asyncio.wait(self._clients.values(), timeout=_LAST_WORDS_S)
            for task in late:
                task.cancel()

    async def _listen(self) -> None:
        """Accept one client after the other, each when there is a place for it: the others wait in the kernel."""
        loop = asyncio.get_running_loop()
        try:
            while True:
                try:
                    sock, _ = await loop.sock_accept(self._socket)
                except OSError as error:
                    log.warning("%s: cannot accept a client: %s", self._path, why(error))
                    await asyncio.sleep(AGAIN_S)
                    continue
                with ExitStack() as unless_served:
                    unless_served.callback(sock.close)
                    await self._make_room()
                    client = await Client.accepted(sock)
                    self._clients[client] = asyncio.create_task(self._serve(client))
                    unless_served.pop_all()
        except asyncio.CancelledError:
            pass  # the node is stopping
        except BaseException as error:
            # Nothing awaits this task, so pass the bug on.
            self.driver.fail(error)
            raise

    async def _serve(self, client: Client) -> None:
        try:
            await self._converse(client)
        except (ConnectionError, asyncio.CancelledError):
            pass  # the client went away or was cut, or the node is stopping
        except BaseException as error:
            self.driver.fail(error)
            raise
        finally:
            self._clients.pop(client, None)
            self.drop_draft(client)
            client.cut()

    async def _make_room(self) -> None:
        """Wait until there is a place for one more. If none gets free, disconnect the client that we have waited for
        longest."""
        while len(self._clients) >= MAX_CLIENTS:
            waits = {client: client.waited_for for client in self._clients if client.waited_for is not None}
            left_s = min(waits.values(), default=_now()) + SPARED_S - _now()
            if left_s > 0 or not waits:
                await asyncio.wait(self._clients.values(), timeout=left_s, return_when=asyncio.FIRST_COMPLETED)
                continue
            longest = min(waits, key=waits.__getitem__)
            self._clients.pop(longest).cancel()
            longest.displace()

    async def _converse(self, client: Client) -> None:
        while self._listening is not None:
            try:
                line = await client.request()
            except ControlError as error:
                await client.say({"ok": False, "error": str(error)})
                return
            # One that had to make way while its line arrived is not carried out: others wait for their turn.
            if not line or client not in self._clients:
                return
            client.answered = True
            try:
                # One request at most in each round of the loop, of each client in turn, so that steps are not late.
                async with self._turn:
                    await asyncio.sleep(0)
                await client.say({"ok": True, **await self._answer(line, client)})
            except StoreDamagedError as error:
                self.driver.fail(error)
                await client.say({"ok": False, "error": str(error)})
                return
            except RassError as error:
                await client.say({"ok": False, "error": str(error)})
            finally:
                client.answered = False

    async def _answer(self, line: bytes, client: Client) -> dict[str, Any]:
        with understood():
            # A line that is no JSON object may be meant as a reading all the same.
            kind = _kind("measure") if b'"measure"' in line else Request
            try:
                kind, raw = _command(line)
                request = _request(kind, raw)
            except (MalformedError, ConfigError) as error:
                kind.misread(self, "; ".join(error.lines()))
                raise
        return await request.answer(self, client)

    def status(self) -> dict[str, Any]:
        """All that is known of the node."""
        handed_in = None if self.measures is None else self.measures.report()
        return {**status(self.driver, self._started), "handed_in": handed_in, **self.files.report(), **self._around()}

    def drop_draft(self, client: Client) -> None:
        """Leave nothing of a file that the client has begun."""
        if client.draft is not None:
            self.files.open().give_up(client.draft)
            client.draft = None


def _command(line: bytes) -> tuple[type[Request], dict[str, Any]]:
    """The kind of a request, and its fields. Raises `MalformedError`."""
    raw = load_line(line)
    command = raw.pop("command", None)
    if not isinstance(command, str) or command not in _REQUESTS:
        raise MalformedError(f"expected a command, one of {', '.join(_REQUESTS)}")
    return _kind(command), raw


def _kind(command: str) -> type[Request]:
    kind: type[Request] = resolve_name(_REQUESTS[command])
    return kind


def _request(kind: type[Request], raw: dict[str, Any]) -> Request:
    """Raises `MalformedError` or `ConfigError`."""
    if any(len(name) > _MAX_NAME for name in raw):
        raise MalformedError(f"expected names of at most {_MAX_NAME} characters")
    if any(isinstance(value, (dict, list)) for value in raw.values()):
        raise MalformedError("expected text and numbers only")
    return build(raw, kind)


def _now() -> float:
    return asyncio.get_running_loop().time()


async def _in_time(waits: Coroutine[Any, Any, T], limit_s: float) -> T:
    try:
        return await asyncio.wait_for(waits, limit_s)
    except asyncio.TimeoutError:
        raise ConnectionAbortedError("the client has stopped") from None


def _listening_socket(path: Path) -> socket.socket:
    """Bind the socket's file. The socket of a killed node is replaced; that of a running node is not."""
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        try:
            if stat.S_ISSOCK(path.lstat().st_mode):
                if _answers_there(path):
                    raise ControlError(f"{path}: another node is running there")
                path.unlink()
            else:
                raise ControlError(f"{path}: exists, but is not a socket")
        except FileNotFoundError:
            pass
        # Only its owner may use it, from the first moment.
        before = os.umask(0o177)
        try:
            sock.bind(str(path))
        finally:
            os.umask(before)
        sock.listen(WAITING)
        sock.setblocking(False)
    except OSError as error:
        sock.close()
        raise ControlError(f"{path}: {why(error)}") from None
    except ControlError:
        sock.close()
        raise
    return sock


def _answers_there(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(1.0)
        try:
            probe.connect(str(path))
        except (ConnectionRefusedError, FileNotFoundError):
            return False
        except TimeoutError:
            return True
    return True

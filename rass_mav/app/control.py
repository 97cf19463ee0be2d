"""The local control socket: newline-delimited JSON over a unix stream socket, for `status` and `put`.

A file that is larger than a datum comes in several requests: `file`, so many times `piece`, and `done`.

A request is one object on one line, `{"command": "put", "kind": 0, "payload": "<base64>"}`. So is an answer,
`{"ok": true, ...}` or `{"ok": false, "error": "..."}`. What the node holds is read from its store. Any user who can
open the socket's file can use it; only the node's own user can.

A client that stops is disconnected. If all places are taken, the client that has waited longest makes way for the next
one, so clients that hang do not lock others out. A client whose request is being answered always keeps its place.
"""

from __future__ import annotations

import asyncio
import logging
import os
import socket
import stat
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Annotated, Any, TypeVar

from rass_mav.config.sections import Meta, Section
from rass_mav.config.typed import build
from rass_mav.core.datum import MAX_PAYLOAD, Kind
from rass_mav.core.terms import MOST_PRIORITY, MOST_TTL_S, TERMS, USUAL_PRIORITY, Terms
from rass_mav.errors import ConfigError, ControlError, MalformedError, RassError, StoreDamagedError, why
from rass_mav.wire.file import MOST_FILE, MOST_NAME, PACKINGS, PLAIN

from .driver import Driver
from .files import Files
from .jsonlines import dump_line, load_bytes, load_line
from .payloads import parse_name
from .redundancy import MOST_SHARES
from .spool import Draft
from .staging import About
from .status import status

log = logging.getLogger(__name__)

T = TypeVar("T")

#: Longest line, bytes: the largest payload in base64, and the rest of the line.
MAX_LINE = (MAX_PAYLOAD + 2) // 3 * 4 + 4096
#: Clients at a time. Each may hold two waiting lines and one that is being read, 4.3 MB; all of them hold 35 MB, which
#: a Pi Zero has.
MAX_CLIENTS = 8
#: A client without a request for this long, seconds, is disconnected.
IDLE_S = 60.0
#: How long a request may take to be complete once begun, and an answer to be taken, seconds.
REQUEST_S = 5.0
TAKE_S = 5.0
#: Longest name of a field in a request, characters.
_MAX_NAME = 32
# How long answers in progress may still take when the node stops, seconds.
_LAST_WORDS_S = 2.0


class StatusRequest(Section):
    """The state of the node."""


class _WithTerms(Section):
    """What creates data."""

    priority: Annotated[int, Meta(ge=0, le=MOST_PRIORITY)] = USUAL_PRIORITY
    ttl_s: Annotated[int, Meta(ge=1, le=MOST_TTL_S)] | None = None
    """They expire when they are older, seconds; null: never."""

    @property
    def terms(self) -> Terms:
        """Both."""
        return Terms(self.priority, self.ttl_s)


class PutRequest(_WithTerms):
    """Create a datum. The answer comes when it is on disk."""

    payload: str
    """1 byte to 1 MiB, in base64."""
    kind: Annotated[int, Meta(ge=0, lt=TERMS)] = Kind.BYTES


class FileRequest(_WithTerms):
    """Begin a file, one at a time."""

    name: Annotated[str, Meta(min_length=1)]
    size: Annotated[int, Meta(ge=1, le=MOST_FILE)]
    """Bytes."""
    digest: Annotated[str, Meta(min_length=64, max_length=64)]
    """SHA-256, in hexadecimal."""
    packing: Annotated[int, Meta(ge=0, le=max(PACKINGS))]
    length: Annotated[int, Meta(ge=1, le=MOST_FILE)]
    """Bytes when packed."""
    time: float
    """When it was last changed, seconds since 1970."""
    needed: Annotated[int, Meta(ge=0, le=MOST_SHARES)] = 0
    """K: so many of each `shares` data are enough; 0: no redundancy."""
    shares: Annotated[int, Meta(ge=0, le=MOST_SHARES)] = 0
    """N."""


class PieceRequest(Section):
    """The next bytes of the file."""

    payload: str
    """1 byte to 64 KiB, in base64."""


class DoneRequest(Section):
    """The file is complete. The answer comes when it is on disk."""


class ProgressRequest(Section):
    """How much of a datum or of a file has arrived."""

    id: str
    """As `put` and `done` answer it."""


_REQUESTS: dict[str, type[Section]] = {
    "progress": ProgressRequest,
    "status": StatusRequest, "put": PutRequest, "file": FileRequest, "piece": PieceRequest, "done": DoneRequest,
}  # fmt: skip


class _Client:
    """A connected client."""

    __slots__ = ("_writer", "answered", "draft", "task", "waited_for")

    def __init__(self, task: asyncio.Task[None], writer: asyncio.StreamWriter) -> None:
        self.task = task
        self._writer = writer
        # With this, `drain` returns when the kernel has everything, and nothing is left when the client is gone.
        writer.transport.set_write_buffer_limits(high=0)
        self.answered = False
        """Whether a request of the client is being answered."""
        self.draft: Draft | None = None
        """The file that it puts."""
        self.waited_for: float | None = _now()
        """Since when we wait for its request, for the end of it, or for it to take the answer; None: we do not wait."""

    async def request(self, reader: asyncio.StreamReader) -> bytes:
        """The next line. Raises `ConnectionError` if none comes in time, `ValueError` if it is too long."""
        self.waited_for = _now()
        line = await _in_time(reader.read(1), IDLE_S)
        if line and line != b"\n":
            line += await _in_time(reader.readline(), REQUEST_S)
        self.waited_for = None
        return line

    async def say(self, answer: dict[str, Any]) -> None:
        """Send an answer. Returns when the client has taken it. Raises `ConnectionError` if that takes too long."""
        self._writer.write(dump_line(answer))
        self.waited_for = _now()
        await _in_time(self._writer.drain(), TAKE_S)
        self.waited_for = None

    def cut(self) -> None:
        """Close the connection at once."""
        self._writer.transport.abort()


class ControlServer:
    """Answers on a unix socket for a driver."""

    def __init__(self, driver: Driver, path: Path, files: Files, around: Callable[[], dict[str, Any]] = dict) -> None:
        """`path`: the socket's file. `files`: those that are put. `around`: what else `status` shows, which the driver
        does not know."""
        self._driver = driver
        self._files = files
        self._around = around
        self._path = path
        self._started = driver.now()
        self._server: asyncio.Server | None = None
        self._clients: set[_Client] = set()
        self._turn = asyncio.Lock()

    async def start(self) -> None:
        """Start listening. Raises `ControlError` if another node listens there, or the file cannot be created."""
        sock = _listening_socket(self._path)
        self._server = await asyncio.start_unix_server(self._serve, sock=sock, limit=MAX_LINE, backlog=MAX_CLIENTS)

    async def close(self) -> None:
        """Stop listening, and finish the answers in progress."""
        if self._server is None:
            return
        self._server.close()
        self._path.unlink(missing_ok=True)
        for client in self._clients:
            if not client.answered:
                client.task.cancel()
        if self._clients:
            _, late = await asyncio.wait([client.task for client in self._clients], timeout=_LAST_WORDS_S)
            for task in late:
                task.cancel()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        client = _Client(task, writer)
        try:
            if not self._make_room():
                await client.say({"ok": False, "error": "too many clients"})
                return
            self._clients.add(client)
            await self._converse(reader, client)
        except (ConnectionError, asyncio.CancelledError):
            pass  # the client went away or was cut, or the node is stopping
        except BaseException as error:
            # Nothing awaits this task, so pass the bug on.
            self._driver.fail(error)
            raise
        finally:
            self._clients.discard(client)
            self._drop_draft(client)
            client.cut()

    def _make_room(self) -> bool:
        """Whether there is a place for one more. If need be, disconnect the client that we have waited for longest."""
        if len(self._clients) < MAX_CLIENTS:
            return True
        waited_for = {client: client.waited_for for client in self._clients if client.waited_for is not None}
        if not waited_for:
            return False
        longest = min(waited_for, key=waited_for.__getitem__)
        self._clients.discard(longest)
        longest.cut()
        longest.task.cancel()
        return True

    async def _converse(self, reader: asyncio.StreamReader, client: _Client) -> None:
        while self._server is not None and self._server.is_serving():
            try:
                line = await client.request(reader)
            except ValueError:
                await client.say({"ok": False, "error": f"a request has at most {MAX_LINE} bytes"})
                return
            # One that had to make way while its line arrived is not carried out: others wait for their turn.
            if not line.endswith(b"\n") or client not in self._clients:
                return
            client.answered = True
            try:
                # One request at most in each round of the loop, of each client in turn, so that steps are not late.
                async with self._turn:
                    await asyncio.sleep(0)
                await client.say({"ok": True, **await self._answer(line, client)})
            except StoreDamagedError as error:
                self._driver.fail(error)
                await client.say({"ok": False, "error": str(error)})
                return
            except RassError as error:
                await client.say({"ok": False, "error": str(error)})
            finally:
                client.answered = False

    async def _answer(self, line: bytes, client: _Client) -> dict[str, Any]:
        try:
            request = _request(line)
            payload = load_bytes(request.payload) if isinstance(request, (PutRequest, PieceRequest)) else b""
            about = _about(request) if isinstance(request, FileRequest) else None
        except (MalformedError, ConfigError) as error:
            raise ControlError(f"not a request: {'; '.join(error.lines())}") from None
        if isinstance(request, PutRequest):
            return {"id": str(await self._driver.put(payload, request.kind, request.terms))}
        if about is not None:
            self._drop_draft(client)
            client.draft = await self._files.begin(about, redundancy=_redundancy(request))
            return {"part_bytes": client.draft.manifest.cut.part_bytes}
        if isinstance(request, ProgressRequest):
            return {**self._files.progress(parse_name(request.id)[0])}
        if isinstance(request, (PieceRequest, DoneRequest)):
            return await self._go_on(client, request, payload)
        return {"status": {**status(self._driver, self._started), "files": self._files.report(), **self._around()}}

    async def _go_on(self, client: _Client, request: Section, payload: bytes) -> dict[str, Any]:
        """With the file of a client. After an error nothing is left of it."""
        draft = client.draft
        if draft is None:
            raise ControlError("no file was begun")
        try:
            if isinstance(request, PieceRequest):
                await self._files.write(draft, payload)
                return {}
            id = await self._files.finish(draft)
        except BaseException:
            self._drop_draft(client)
            raise
        client.draft = None
        return {"id": str(id), "parts": draft.manifest.cut.data()}

    def _drop_draft(self, client: _Client) -> None:
        if client.draft is not None:
            self._files.give_up(client.draft)
            client.draft = None


def _request(line: bytes) -> Section:
    """Raises `MalformedError` or `ConfigError`."""
    raw = load_line(line)
    command = raw.pop("command", None)
    if not isinstance(command, str) or command not in _REQUESTS:
        raise MalformedError(f"expected a command, one of {', '.join(_REQUESTS)}")
    if any(len(name) > _MAX_NAME for name in raw):
        raise MalformedError(f"expected names of at most {_MAX_NAME} characters")
    if any(isinstance(value, (dict, list)) for value in raw.values()):
        raise MalformedError("expected text and numbers only")
    return build(raw, _REQUESTS[command])


def _about(request: FileRequest) -> About:
    """Raises `MalformedError`."""
    try:
        digest = bytes.fromhex(request.digest)
    except ValueError:
        raise MalformedError("expected a digest in hexadecimal") from None
    if len(request.name.encode(errors="replace")) > MOST_NAME or len(digest) != 32:
        raise MalformedError(f"expected a name of at most {MOST_NAME} bytes, and a digest of 32")
    if request.needed >= request.shares > 0 or bool(request.needed) != bool(request.shares):
        raise MalformedError("expected more shares than are needed")
    if request.packing == PLAIN and request.length != request.size:
        raise MalformedError("expected the same size and length, for it is not packed")
    return About(request.name, request.size, request.time, digest, request.packing, request.length, request.terms)


def _redundancy(request: Section) -> tuple[int, int] | None:
    assert isinstance(request, FileRequest)
    return (request.needed, request.shares) if request.needed else None


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
                raise ControlError(f"{path}: exists and is not a socket")
        except FileNotFoundError:
            pass
        # Only its owner may use it, from the first moment.
        before = os.umask(0o177)
        try:
            sock.bind(str(path))
        finally:
            os.umask(before)
        sock.listen(MAX_CLIENTS)
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

"""The control socket among clients that hang: they cost a bounded amount, and keep nobody out."""

from __future__ import annotations

import asyncio
import base64
import json
import os
import select
import socket
import stat
from collections.abc import AsyncIterator, Callable, Iterable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from rass_mav.app import control
from rass_mav.app.client import ControlClient
from rass_mav.app.control import MAX_CLIENTS, MAX_LINE, ControlServer
from rass_mav.app.on_demand import FilesOnDemand
from rass_mav.core.store import Store
from rass_mav.errors import RefusedError
from rass_mav.store.memory import MemoryStore
from rass_mav.store.sqlite import SqliteStore
from tests.link.loopback import LoopbackHub
from tests.patience import PATIENCE_S

from .app_drivers import HeldExecutor, running, settings

PATH = Path("n.sock")
PAYLOAD = os.urandom(1 << 20)
#: Questions whose answers fill the buffers of a socket.
MANY = b'{"command": "status"}\n' * 2000


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # The path of a unix socket must be short.
    monkeypatch.chdir(tmp_path)


@asynccontextmanager
async def listening(
    store: Store | None = None, executor: Executor | None = None, around: Callable[[], dict[str, Any]] = dict
) -> AsyncIterator[ControlServer]:
    link = LoopbackHub().endpoint("node")
    async with running(link, store or MemoryStore(1), settings(1, base=True), executor=executor) as driver:
        files = FilesOnDemand(driver, Path("spool"), 1 << 15)
        server = ControlServer(driver, PATH, files, around)
        await server.start()
        try:
            yield server
        finally:
            await server.close()


class Client:
    """One that goes as far as the test wants."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader = reader
        self.writer = writer

    @classmethod
    async def connect(cls) -> Client:
        return cls(*await asyncio.wait_for(asyncio.open_unix_connection(PATH, limit=1 << 22), PATIENCE_S))

    async def ask(self, command: str, **fields: Any) -> dict[str, Any]:
        self.writer.write(json.dumps({"command": command, **fields}).encode() + b"\n")
        return await self.answer()

    async def answer(self) -> dict[str, Any]:
        line = await asyncio.wait_for(self.reader.readline(), PATIENCE_S)
        answer: dict[str, Any] = json.loads(line)
        return answer

    async def is_cut(self) -> None:
        """Returns when the node has ended the connection."""
        assert await asyncio.wait_for(self.reader.read(), PATIENCE_S) == b""

    def close(self) -> None:
        self.writer.close()


class Hanger:
    """One that never reads what it is told."""

    def __init__(self, *said: bytes) -> None:
        self.sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.sock.settimeout(PATIENCE_S)
        self.said = said

    async def hang(self) -> Hanger:
        await asyncio.get_running_loop().run_in_executor(None, self._connect)
        return self

    def _connect(self) -> None:
        self.sock.connect(str(PATH))
        try:
            for one in self.said:
                self.sock.sendall(one)
        except OSError:
            pass  # it had to make room before it had said everything

    async def is_cut(self) -> None:
        """Returns when the node has ended the connection; without reading."""
        poll = select.poll()
        poll.register(self.sock, 0)
        assert await asyncio.get_running_loop().run_in_executor(None, poll.poll, 1000 * PATIENCE_S)


def close_all(clients: Iterable[Hanger]) -> None:
    for client in clients:
        client.sock.close()


async def work(payload: bytes = b"honest") -> str:
    """What an honest client does; returns the id of its datum."""
    client = await Client.connect()
    assert (await client.ask("status"))["ok"]
    put = await client.ask("put", payload=base64.b64encode(payload).decode())
    assert put["ok"], put
    client.close()
    id: str = put["id"]
    return id


async def test_the_socket_is_for_the_nodes_own_user() -> None:
    async with listening():
        assert stat.S_IMODE(PATH.stat().st_mode) == 0o600


@pytest.mark.parametrize(
    "said",
    [(), (b'{"command": "sta',), (b"x" * (MAX_LINE - 1),), (MANY,)],
    ids=["nothing", "half a line", "a long half", "many, and takes no answer"],
)
async def test_a_hundred_that_hang_keep_nobody_out(said: tuple[bytes, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(control, "SPARED_S", 0.02)
    async with listening() as server:
        hangers = [await Hanger(*said).hang() for _ in range(100 if sum(map(len, said)) < 10_000 else 24)]
        await work()
        assert len(server._clients) <= MAX_CLIENTS
        close_all(hangers)


@pytest.mark.parametrize("programs", [MAX_CLIENTS - 1, 5 * MAX_CLIENTS])
async def test_programs_that_connect_for_each_request_all_get_their_answers(programs: int) -> None:
    def asks(_: int) -> list[bytes]:
        return [one() for _ in range(60)]

    def one() -> bytes:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as sock:
            sock.settimeout(PATIENCE_S)
            sock.connect(str(PATH))
            sock.sendall(b'{"command": "progress", "id": "1-00000001-1"}\n')
            with sock.makefile("rb") as answers:
                return answers.readline()

    async with listening():
        loop = asyncio.get_running_loop()
        with ThreadPoolExecutor(programs) as pool:
            answered = await asyncio.gather(*(loop.run_in_executor(pool, asks, number) for number in range(programs)))
        assert all(json.loads(line)["ok"] for lines in answered for line in lines)


async def test_one_that_makes_way_is_told_why() -> None:
    async with listening() as server:
        silent = [await Client.connect() for _ in range(MAX_CLIENTS)]
        while len(server._clients) < MAX_CLIENTS:
            await asyncio.sleep(0)
        busy = silent.pop(0)
        assert (await busy.ask("status"))["ok"]
        await work()
        assert await silent[0].answer() == {"ok": False, "error": "too many clients, try again"}
        await silent[0].is_cut()
        assert (await busy.ask("status"))["ok"]
        for client in (busy, *silent):
            client.close()


async def test_a_client_reads_why_it_had_to_make_way(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(control, "SPARED_S", 0.02)
    async with listening() as server:
        with ControlClient(PATH) as first:
            others = [await Client.connect() for _ in range(MAX_CLIENTS)]
            while len(server._clients) < MAX_CLIENTS:
                await asyncio.sleep(0)
            await others[-1].ask("status")
            with pytest.raises(RefusedError, match="too many clients, try again"):
                await asyncio.to_thread(first.ask, "status")
        for client in others:
            client.close()


async def test_answers_that_nobody_takes_keep_nobody_out() -> None:
    async with listening():
        hangers = [await Hanger(MANY).hang() for _ in range(2 * MAX_CLIENTS)]
        await work(PAYLOAD)
        close_all(hangers)


async def test_a_request_without_end_is_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(control, "REQUEST_S", 0.05)
    async with listening():
        client = await Client.connect()
        assert (await client.ask("status"))["ok"]
        client.writer.write(b'{"command": "sta')
        assert await client.answer() == {"ok": False, "error": "request not complete after 0.05 s"}
        await client.is_cut()
        client.close()


async def test_a_request_without_a_newline_is_answered() -> None:
    async with listening():
        client = await Client.connect()
        client.writer.write(b'{"command": "status"}')
        client.writer.write_eof()
        assert await client.answer() == {"ok": False, "error": "request without a newline"}
        await client.is_cut()
        client.close()


async def test_one_that_asks_nothing_is_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(control, "IDLE_S", 0.05)
    async with listening():
        client = await Client.connect()
        await client.is_cut()
        client.close()


async def test_one_that_does_not_take_its_answer_is_cut_and_nothing_of_it_stays(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(control, "TAKE_S", 0.05)
    async with listening() as server:
        await work()
        files = len(os.listdir("/proc/self/fd"))
        for _ in range(3):
            hanger = await Hanger(MANY).hang()
            hanger.sock.shutdown(socket.SHUT_WR)
            await hanger.is_cut()
            hanger.sock.close()
        await work()
        assert len(os.listdir("/proc/self/fd")) <= files + 1
        assert len(server._clients) <= 1


async def test_one_whose_request_is_carried_out_keeps_its_place(monkeypatch: pytest.MonkeyPatch) -> None:
    disk = HeldExecutor()
    store = SqliteStore.open(Path("n.db"), node_id=7, draw_epoch=lambda: 7)
    async with listening(store, disk) as server:
        # A base stores its announcement number first of all; the data of all clients come in the write after it.
        await asyncio.wait_for(disk.arrived.wait(), PATIENCE_S)
        clients = [await Client.connect() for _ in range(MAX_CLIENTS)]
        for client in clients:
            client.writer.write(b'{"command": "put", "payload": "eA=="}\n')
        while len(server._clients) < MAX_CLIENTS or any(one.waited_for is not None for one in server._clients):
            await asyncio.sleep(0)
        monkeypatch.setattr(control, "SPARED_S", 0.02)
        newcomer = await Client.connect()
        status = asyncio.create_task(newcomer.ask("status"))

        async def write() -> None:
            while True:
                await disk.arrived.wait()
                disk.arrived.clear()
                while disk.submitted:
                    disk.release()

        writing = asyncio.create_task(write())
        answers = await asyncio.gather(*(client.answer() for client in clients))
        assert all(answer["ok"] for answer in answers)
        assert (await status)["ok"]
        writing.cancel()
        newcomer.close()
        for client in clients:
            client.close()
        # What is written at the end is written at once.
        disk.submit = _done  # type: ignore[method-assign]
    store.close()


def _done(fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
    future: Future[Any] = Future()
    future.set_result(fn(*args, **kwargs))
    return future


async def test_each_round_of_the_node_answers_one_request_at_most() -> None:
    rounds = 0
    counted = asyncio.Event()
    answered: list[int] = []

    def count() -> None:
        nonlocal rounds
        rounds += 1
        if not counted.is_set():
            asyncio.get_running_loop().call_soon(count)

    def around() -> dict[str, Any]:
        answered.append(rounds)
        return {}

    async with listening(around=around) as server:
        clients = [await Client.connect() for _ in range(MAX_CLIENTS)]
        while len(server._clients) < MAX_CLIENTS:
            await asyncio.sleep(0)
        count()
        for client in clients:
            client.writer.write(b'{"command": "status"}\n' * 20)
        assert all([(await client.answer())["ok"] for client in clients for _ in range(20)])
        counted.set()
        assert len(set(answered)) == len(answered) == 20 * MAX_CLIENTS
        for client in clients:
            client.close()


async def test_names_that_are_none_are_refused_briefly() -> None:
    async with listening():
        client = await Client.connect()
        told = await client.ask("status", **{"x" * (1 << 20): 1})
        assert not told["ok"]
        assert len(told["error"]) < 100
        client.close()

"""Real nodes for the tests: `rass-mav run` as processes."""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import BytesIO, TextIOWrapper
from pathlib import Path
from typing import Any

import pytest
import yaml

from rass_mav.app.client import ControlClient
from rass_mav.cli import main
from rass_mav.ground.archive import Archive
from rass_mav.ground.entry import Entry
from tests.environment import environment
from tests.forked import Forked
from tests.patience import PATIENCE_S

ROOT = Path(__file__).resolve().parents[2]
STEP_S = 0.05


def free_ports(count: int) -> list[int]:
    """UDP ports that nobody uses at this moment."""
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(count)]
    for sock in sockets:
        sock.bind(("127.0.0.1", 0))
    ports = [sock.getsockname()[1] for sock in sockets]
    for sock in sockets:
        sock.close()
    return ports


def process(directory: Path, *arguments: str, stdin: bytes | None = None) -> subprocess.CompletedProcess[bytes]:
    """Run `rass-mav` to its end, as a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", "rass_mav", *arguments],
        cwd=directory,
        env=environment(),
        input=stdin,
        capture_output=True,
        timeout=PATIENCE_S,
        check=False,
    )


def command(directory: Path, *arguments: str, stdin: bytes = b"") -> subprocess.CompletedProcess[bytes]:
    """Run `rass-mav` to its end, in this process: to start one takes longer than most commands do."""
    streams = {
        name: TextIOWrapper(BytesIO(content)) for name, content in (("stdin", stdin), ("stdout", b""), ("stderr", b""))
    }
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(directory)
        for name, stream in streams.items():
            patch.setattr(sys, name, stream)
        try:
            code = main(arguments)
        except SystemExit as end:
            code = int(end.code or 0)
    said = []
    for name in ("stdout", "stderr"):
        streams[name].flush()
        buffer = streams[name].buffer
        assert isinstance(buffer, BytesIO)
        said.append(buffer.getvalue())
    return subprocess.CompletedProcess(arguments, code, *said)


@contextmanager
def said_by(directory: Path, *arguments: str) -> Iterator[Iterator[bytes]]:
    """The lines that a command prints, one after the other while it runs. It is killed at the end."""
    running = Forked(arguments, cwd=directory, env=environment())

    def lines() -> Iterator[bytes]:
        said = b""
        while True:
            while b"\n" not in said:
                ready, _, _ = select.select([running.stdout], [], [], PATIENCE_S)
                assert ready
                some = running.stdout.read(4096)
                assert some, "it has ended"
                said += some
            line, _, said = said.partition(b"\n")
            yield line

    try:
        yield lines()
    finally:
        running.send_signal(signal.SIGKILL)
        running.wait(PATIENCE_S)
        running.stdout.close()


class RunningNode:
    """A `rass-mav run` in a directory of its own swarm. Its configuration is `n<id>.yaml` there."""

    def __init__(self, directory: Path, node_id: int, name: str | None = None, **sections: Any) -> None:
        self.directory = directory
        self.name = name or f"n{node_id}"
        self.config = f"{self.name}.yaml"
        self.process: Forked | subprocess.Popen[bytes] | None = None
        self.faulty = False
        """Whether it is expected to hit faults."""
        node = {"id": node_id, "step_s": STEP_S, **sections.pop("node", {})}
        data = {"interval_steps": 0, "status_s": 0, **sections.pop("data", {})}
        store = {"path": f"{self.name}.db", **sections.pop("store", {})}
        plain = {"node": node, "data": data, "store": store, **sections}
        (directory / self.config).write_text(yaml.safe_dump(plain))

    def start(self, *, forked: bool = True) -> RunningNode:
        """Returns when it runs.

        :param forked: False: an interpreter of its own, as a user starts it. In another network namespace, too.
        """
        self.process = self.fork(environment()) if forked else self.spawn(environment())
        assert self.process.stdout is not None
        ready, _, _ = select.select([self.process.stdout], [], [], PATIENCE_S)
        line = self.process.stdout.readline() if ready else b""
        assert line, f"{self.name} did not start: {self.log()}"
        self.about = json.loads(line)
        return self

    def fork(self, env: dict[str, str]) -> Forked:
        return Forked(self.arguments(), cwd=self.directory, env=env, stderr=self.directory / f"{self.name}.log")

    def spawn(self, env: dict[str, str]) -> subprocess.Popen[bytes]:
        command = [sys.executable, *self.program(), *self.arguments()]
        with (self.directory / f"{self.name}.log").open("ab") as log:
            return subprocess.Popen(command, cwd=self.directory, env=env, stdout=subprocess.PIPE, stderr=log)

    def program(self) -> list[str]:
        """What an interpreter of its own runs."""
        return ["-m", "rass_mav"]

    def arguments(self) -> list[str]:
        return ["run", self.config, "--json", "-v"]

    def client(self) -> ControlClient:
        return ControlClient(os.path.relpath(self.directory / f"{self.name}.sock"))

    def ask(self, request: str, **fields: Any) -> dict[str, Any]:
        with self.client() as client:
            return client.ask(request, **fields)

    def status(self) -> dict[str, Any]:
        status: dict[str, Any] = self.ask("status")["status"]
        return status

    def listing(self) -> dict[str, Entry]:
        """What is on its disk, by id."""
        with Archive(self.directory / f"{self.name}.db") as archive:
            return {entry.name: entry for entry in archive.entries()}

    def content(self, id: str) -> bytes:
        """The bytes of a datum on its disk."""
        with Archive(self.directory / f"{self.name}.db") as archive:
            return archive.datum(id).payload

    def until(self, condition: Callable[[], bool]) -> None:
        """Ask again and again until it is so. A node that ends, or a deadline that passes, is a failure."""
        assert self.process is not None
        assert self.process.stdout is not None
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < deadline, f"{self.name}: not in time; {self.log()}"
            # Waits for the next step or so; returns at once when the process ends.
            ended, _, _ = select.select([self.process.stdout], [], [], STEP_S)
            assert not ended, f"{self.name} has ended: {self.log()}"

    def signal(self, number: int) -> int:
        """Send a signal and wait for the end. Returns the exit code. A frame that hit a fault is a failure."""
        code = self._signal(number)
        assert self.faulty or "triggered a fault in this program" not in self.log(), self.log()
        return code

    def _signal(self, number: int) -> int:
        assert self.process is not None
        self.process.send_signal(number)
        code = self.process.wait(PATIENCE_S)
        if self.process.stdout is not None:
            self.process.stdout.close()
        self.process = None
        return code

    def log(self) -> str:
        return (self.directory / f"{self.name}.log").read_text()

    def end(self) -> None:
        """For tidying up after a failure."""
        if self.process is not None:
            self._signal(signal.SIGKILL)


def line_of(directory: Path, ids: list[int], **sections: Any) -> list[RunningNode]:
    """Nodes that hear only those next to them; the first is the base. Not started."""
    ports = free_ports(len(ids))
    nodes = []
    for index, node_id in enumerate(ids):
        peers = [
            {"id": ids[i], "address": f"127.0.0.1:{ports[i]}"} for i in (index - 1, index + 1) if 0 <= i < len(ids)
        ]
        link = {"listen": f"127.0.0.1:{ports[index]}", "peers": peers}
        role = {"role": "base" if index == 0 else "drone"}
        nodes.append(RunningNode(directory, node_id, node=role, links=[link], **sections))
    return nodes


#: Takes a node, and ends it after the test.
Tidy = Callable[[RunningNode], RunningNode]

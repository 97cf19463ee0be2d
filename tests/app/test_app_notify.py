"""What a service manager hears of a node, and what journald gets from its logs."""

from __future__ import annotations

import logging
import math
import os
import re
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.app.notify import Notifier
from tests.environment import environment
from tests.patience import PATIENCE_S

from .app_nodes import RunningNode, free_ports


class Manager:
    """The service manager's end of the notification socket."""

    def __init__(self, address: str) -> None:
        self.address = address
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind("\0" + address[1:] if address.startswith("@") else address)
        self.socket.settimeout(PATIENCE_S)

    def next(self) -> str:
        return self.socket.recv(4096).decode()

    def silent(self) -> bool:
        return not select.select([self.socket], [], [], 0)[0]


@pytest.fixture
def manager() -> Iterator[Manager]:
    manager = Manager(f"@rass-mav-test-{os.getpid()}")
    yield manager
    manager.socket.close()


def notifier(manager: Manager, **more: str) -> Notifier:
    return Notifier.of({"NOTIFY_SOCKET": manager.address, **more}, os.getpid())


def test_what_is_said(manager: Manager) -> None:
    node = notifier(manager)
    node.ready("node 7 (drone)")
    assert manager.next() == "READY=1\nSTATUS=node 7 (drone)"
    node.stopping()
    assert manager.next().splitlines()[0] == "STOPPING=1"
    node.close()
    node.ready("again")
    assert manager.silent()


def test_signs_of_life_twice_in_each_period(manager: Manager) -> None:
    node = notifier(manager, WATCHDOG_USEC="30000000", WATCHDOG_PID=str(os.getpid()))
    assert node.alive(100.0) == 115.0
    assert manager.next() == "WATCHDOG=1"
    assert node.alive(114.9) == 115.0
    assert manager.silent()
    assert node.alive(120.0) == 135.0
    assert manager.next() == "WATCHDOG=1"
    node.close()


@pytest.mark.parametrize(
    "environment",
    [
        {},
        {"NOTIFY_SOCKET": ""},
        {"NOTIFY_SOCKET": "vsock:2:1234", "WATCHDOG_USEC": "1000000"},
        {"WATCHDOG_USEC": "1000000"},
        {"NOTIFY_SOCKET": "@nobody-listens-here"},
        {"NOTIFY_SOCKET": "@nobody-listens-here", "WATCHDOG_USEC": "0"},
        {"NOTIFY_SOCKET": "@nobody-listens-here", "WATCHDOG_USEC": "soon"},
        {"NOTIFY_SOCKET": "@nobody-listens-here", "WATCHDOG_USEC": "1000000", "WATCHDOG_PID": "1"},
    ],
    ids=str,
)
def test_without_a_watchdog_nothing_is_due(environment: dict[str, str]) -> None:
    node = Notifier.of(environment, os.getpid())
    assert node.alive(5.0) == math.inf
    node.close()


def test_a_manager_that_does_not_listen_is_told_of_once(caplog: pytest.LogCaptureFixture, tmp_path: Path) -> None:
    node = Notifier(str(tmp_path / "gone"), 2.0)
    with caplog.at_level(logging.WARNING):
        assert [node.alive(now) for now in (0.0, 1.0, 2.0)] == [1.0, 2.0, 3.0]
    assert len(caplog.records) == 1
    node.close()


@given(st.lists(st.floats(0, 10), max_size=50))
def test_a_loop_that_comes_round_when_asked_is_never_late(gaps: list[float]) -> None:
    """Whatever wakes it earlier: between two signs of life there is never more than half a period."""
    node = Notifier("@nobody-listens-here", 4.0)
    now, said, due = 0.0, [0.0], node.alive(0.0)
    for gap in gaps:
        now = min(now + gap, due)
        before, due = due, node.alive(now)
        if due != before:
            said.append(now)
    assert all(later - earlier <= 2.0 for earlier, later in pairwise(said))
    node.close()


def test_a_node_tells_when_it_is_ready_that_it_lives_and_that_it_stops(
    manager: Manager, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NOTIFY_SOCKET", manager.address)
    monkeypatch.setenv("WATCHDOG_USEC", "100000")
    monkeypatch.delenv("WATCHDOG_PID", raising=False)
    port, peer = free_ports(2)
    link = {"listen": f"127.0.0.1:{port}", "peers": [{"address": f"127.0.0.1:{peer}"}]}
    # Steps much rarer than the watchdog wants to hear: the loop comes round for it all the same.
    node = RunningNode(tmp_path, 7, node={"step_s": 1000.0}, links=[link])
    try:
        node.start()
        assert manager.next() == "READY=1\nSTATUS=node 7 (drone)"
        assert [manager.next() for _ in range(3)] == ["WATCHDOG=1"] * 3
        assert node.signal(signal.SIGTERM) == 0
        said = manager.next()
        while said == "WATCHDOG=1":
            said = manager.next()
        assert said.startswith("STOPPING=1\n")
    finally:
        node.end()


_LOG = """
import logging, sys
from rass_mav.commands.common import start_logging
start_logging(2)
for level in (logging.DEBUG, logging.INFO, logging.WARNING, logging.ERROR, logging.CRITICAL):
    logging.getLogger("a.name").log(level, "two\\nlines")
"""


def logged(journal: str | None) -> list[str]:
    """What a program logs to a pipe. `journal`: $JOURNAL_STREAM; "here": that pipe."""
    reading, writing = os.pipe()
    about = os.fstat(writing)
    here = f"{about.st_dev}:{about.st_ino}"
    variables = {} if journal is None else {"JOURNAL_STREAM": here if journal == "here" else journal}
    try:
        subprocess.run(
            [sys.executable, "-c", _LOG],
            env=environment(**variables),
            stderr=writing,
            timeout=PATIENCE_S,
            check=True,
        )
    finally:
        os.close(writing)
    with open(reading, encoding="utf-8") as pipe:
        return pipe.read().splitlines()


def test_journald_gets_levels_and_no_time_stamps() -> None:
    expected = [f"<{number}>{text}" for number in (7, 6, 4, 3, 2) for text in ("a.name: two", "lines")]
    assert logged("here") == expected


@pytest.mark.parametrize("journal", [None, "", "1:2", "nonsense"])
def test_everybody_else_gets_time_stamps(journal: str | None) -> None:
    lines = logged(journal)
    assert len(lines) == 10
    assert all(re.match(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d+ [A-Z]+ a\.name: two$", line) for line in lines[::2])

"""What `run` says on a terminal when something changes: in virtual time, and a real node on a pseudo-terminal."""

from __future__ import annotations

import os
import pty
import select
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from rass_mav.app.narration import MAX_LOST, MOST_CHANGES, MOST_OF_NEIGHBOURS, NOT_YET_S, Narration
from tests.agent.build import fit_beacon
from tests.agent.field import BASE, Field
from tests.environment import environment
from tests.patience import PATIENCE_S
from tests.some import some

from .app_nodes import RunningNode, free_ports


def narrated(*others: int, **about: Any) -> tuple[Field, list[str]]:
    field, said = Field(*others), list[str]()
    expected = {"autopilot": True, "reading": True, **about}
    field.drone.services.append(Narration(field.drone, said.append, 0.0, **expected))
    return field, said


def taken(said: list[str]) -> list[str]:
    lines, said[:] = said[:], []
    return lines


def test_a_flight_is_told() -> None:
    field, said = narrated(3, 4)
    field.silent = {BASE}
    field.until(10.0)
    assert taken(said) == [
        "autopilot 7 heard",
        "sensor heard: reading 0.5, risk 0.50",
        "neighbours 3, 4 heard",
    ]
    field.silent = set()
    field.until(30.0)
    assert taken(said) == [
        "neighbour 1 (base) heard",
        "base 1 reached: 1 hop, next node 1",
        "data of this node have arrived at a base",
    ]
    field.silent = {4, BASE}
    field.until(50.0)
    told = taken(said)
    assert [line for line in told if "neighbour" in line] == ["neighbours 1, 4 lost"]
    assert told[-1] == "route to a base lost: data wait here"
    field.autopilot = False
    field.silent = {4}
    field.until(80.0)
    assert taken(said) == [
        "neighbour 1 (base) heard",
        "base 1 reached: 1 hop, next node 1",
        "autopilot silent for 5 s",
        "sensor silent for 10 s: risk counts as 1",
    ]
    field.until(300.0)
    assert taken(said) == [], "nothing changes"


ORDERS = ((3, 7), (7, 3))


def test_a_base_says_whose_data_have_arrived() -> None:
    field = Field(3)
    said: list[str] = []
    field.base.services.append(Narration(field.base, said.append, 0.0, autopilot=False, reading=False))
    field.until(60.0)
    # Whoever has its turn first is heard first.
    assert said[:2] == ["neighbour 7 heard", "neighbour 3 heard"]
    # In one line, if they arrive between the same two steps of the base.
    assert said[2:] in (["data of nodes 3, 7 arrived"], *([f"data of node {n} arrived" for n in ns] for ns in ORDERS))


def test_after_a_while_it_says_what_was_never_heard() -> None:
    field, said = narrated()
    field.silent, field.autopilot = {BASE}, False
    field.until(NOT_YET_S - 1.0)
    assert said == []
    field.until(60.0)
    assert said == ["not heard yet: autopilot, sensor, neighbour (rass-mav doctor shows why)"]
    field, said = narrated(autopilot=False, reading=False)
    field.silent, field.autopilot = {BASE}, False
    field.until(60.0)
    assert said == ["not heard yet: neighbour (rass-mav doctor shows why)"]


@pytest.mark.no_cover
def test_a_neighbour_that_comes_and_goes_does_not_flood_the_terminal() -> None:
    field, said = narrated(3)

    def flap() -> None:
        field.silent = {3} if field.now % 12.0 < 6.0 else set()

    field.until(600.0, flap)
    of_it = [line for line in said if "3" in line]
    assert MOST_CHANGES < len(of_it) <= 10 * MOST_CHANGES
    # In the end it says what is so.
    field.silent = set()
    field.until(700.0)
    assert [line for line in said if "neighbour 3" in line][-1] == "neighbour 3 heard"


@pytest.mark.no_cover
def test_invented_names_do_not_flood_it_either() -> None:
    field, said = narrated()
    field.until(10.0)
    said.clear()
    names = iter(range(1000, 30000))

    def invent() -> None:
        neighbours = field.drone.node.routing.neighbours
        for name in (next(names) for _ in range(10)):
            for number in (1, 2):
                neighbours.hear(fit_beacon(field.drone, name, number), field.now, None)

    field.until(610.0, invent)
    assert len(said) <= 10 * 2 * MOST_OF_NEIGHBOURS
    assert max(map(len, said)) < 90
    (narration,) = (service for service in field.drone.services if isinstance(service, Narration))
    assert len(narration._neighbours) <= MAX_LOST + field.drone.node.settings.routing.max_neighbours


def test_whoever_was_heard_once_is_no_news() -> None:
    field, said = narrated()
    field.until(10.0)
    said.clear()
    routing = field.drone.node.routing
    routing.hear(fit_beacon(field.drone, 9, 1), field.now)
    assert 9 in routing.neighbours
    field.until(20.0)
    assert said == []


def test_a_file_hears_what_the_node_is(tmp_path: Path) -> None:
    """Otherwise `nohup rass-mav run` looks dead."""
    (port,) = free_ports(1)
    link = {"listen": f"127.0.0.1:{port}", "peers": [{"address": "127.0.0.1:9"}]}
    node = RunningNode(tmp_path, 7, links=[link])
    log = tmp_path / "log"
    introduced = [
        f"node 7 (drone): link udp:127.0.0.1:{port}, store {tmp_path / 'n7.db'}",
        "open: no keys, anyone can send on the link",
    ]
    for words, lines in (((), introduced), (("-q",), [])):
        command = [sys.executable, "-m", "rass_mav", "run", node.config, "--json", *words]
        with (
            log.open("wb") as file,
            subprocess.Popen(command, cwd=tmp_path, env=environment(), stdout=subprocess.PIPE, stderr=file) as started,
        ):
            assert some(started.stdout).readline().startswith(b"{")
            started.terminate()
        assert [line[9:] for line in log.read_text().splitlines()] == lines


def test_a_node_says_on_a_terminal_what_it_is_and_nothing_on_stdout(tmp_path: Path) -> None:
    (port,) = free_ports(1)
    RunningNode(tmp_path, 7, links=[{"listen": f"127.0.0.1:{port}", "peers": [{"address": "127.0.0.1:9"}]}])
    ours, theirs = pty.openpty()
    command = [sys.executable, "-m", "rass_mav", "run", "n7.yaml"]
    with subprocess.Popen(command, cwd=tmp_path, env=environment(), stdout=subprocess.PIPE, stderr=theirs) as node:
        os.close(theirs)
        said = b""
        try:
            while said.count(b"\n") < 2:
                ready, _, _ = select.select([ours], [], [], PATIENCE_S)
                assert ready
                said += os.read(ours, 4096)
        finally:
            node.terminate()
            os.close(ours)
        assert [line[9:] for line in said.decode().splitlines()] == [
            f"node 7 (drone): link udp:127.0.0.1:{port}, store {tmp_path / 'n7.db'}; Ctrl-C stops it",
            "open: no keys, anyone can send on the link",
        ]
        assert node.stdout is not None
        assert node.stdout.read() == b""
        assert node.wait(PATIENCE_S) == 0

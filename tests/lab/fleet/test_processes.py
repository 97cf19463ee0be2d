"""The swarm as real processes, over UDP on 127.0.0.1 and in real time."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import psutil
import pytest

from rass_mav.app.config import load_config
from rass_mav.errors import ConfigError, SwarmError
from rass_mav.lab.fleet.children import Children
from rass_mav.lab.fleet.fleet import NodeProcess
from rass_mav.lab.fleet.processes import MAX_NODES, run
from rass_mav.lab.swarm.scenario import Scenario, load_scenario
from rass_mav.lab.swarm.world import World
from rass_mav.mavlink.frames import FrameReader
from rass_mav.store.reader import SqliteReader
from tests.patience import PATIENCE_S
from tests.some import some


def line(*assignments: str) -> Scenario:
    """A short and quick line; the base at one end."""
    return load_scenario("udp-line", assignments=["nodes=4", "steps=40", "node.step_s=0.05", *assignments])


_before: set[psutil.Process] = set()


@pytest.fixture(autouse=True)
def _those_before() -> None:
    """Another test's helper (multiprocessing keeps one for as long as the interpreter runs) is none of ours."""
    _before.clear()
    _before.update(psutil.Process().children(recursive=True))


def no_children() -> bool:
    return set(psutil.Process().children(recursive=True)) <= _before


class Kept(NamedTuple):
    """A run that was kept."""

    scenario: Scenario
    summary: dict[str, Any]
    directory: Path
    tape: bytes
    arrived: int
    """How many data were at the base then."""


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Kept:
    """A lossy radio, and drones that are killed."""
    scenario = line("radio.loss=0.1", "radio.duplicate=0.05", "radio.reorder=0.05", "failures.kill_every_s=0.6")
    # However long the directory's name: the sockets, whose names have a limit, are elsewhere.
    keep = tmp_path_factory.mktemp("processes") / ("kept" * 30)
    record = keep.with_name("air.tlog")
    summary = run(scenario, keep=keep, record=record)
    with SqliteReader(keep / "node-0.db") as base:
        return Kept(scenario, summary, keep, record.read_bytes(), len(base.ids()))


def test_data_hop_to_the_base_over_a_lossy_radio_and_nothing_is_lost_to_kill_9(kept: Kept) -> None:
    summary = kept.summary
    assert summary["created"] > 0
    assert summary["created"] == summary["delivered"] + summary["held"]
    assert not any(summary["lost"].values())
    assert summary["altered"] == 0
    assert summary["reliability"] == 1.0
    assert summary["hops"]["p95"] >= 3
    assert summary["routing"]["max_hop_count"] >= 3
    assert summary["frames"]["dropped"] > 0
    assert summary["frames"]["malformed"] == 0
    assert summary["transport"]["kills"] > 0
    # Measurements hold what the flight controllers said: the radio heard their companions' heartbeats.
    assert summary["transport"]["heartbeats"] > 0


def test_a_kept_run_can_be_looked_into(kept: Kept) -> None:
    assert kept.arrived == kept.summary["delivered"]
    assert len(FrameReader().feed(kept.tape)) == kept.summary["frames"]["sent"]


def test_the_summary_has_the_keys_of_virtual_time(kept: Kept) -> None:
    virtual = World(replace(kept.scenario, transport="loopback"))
    virtual.run(kept.scenario.steps)
    expected = virtual.statistics.summary()
    assert {*expected, "wall_s", "cpu_s", "robot_steps_per_s", "transport"} == kept.summary.keys()
    for key in ("lost", "delay_steps", "hops", "frames", "routing"):
        assert kept.summary[key].keys() == expected[key].keys()
    # The processes' time is counted, with the start of their interpreters: by far more than this process needs.
    assert kept.summary["cpu_s"] > 0.2


def test_kept_nodes_run_again_and_hear_each_other(kept: Kept) -> None:
    keep = kept.directory
    with Children() as children:
        nodes = [NodeProcess(n, keep, load_config(keep / f"node-{n}.yaml").socket_path, f"node-{n}") for n in range(2)]
        for node in nodes:
            node.start(children)
        children.wait_for(lambda: [node.name for node in nodes if not node.ready], PATIENCE_S)
        deadline = time.monotonic() + PATIENCE_S
        while not all(node.status and node.status["neighbours"] for node in nodes):
            assert time.monotonic() < deadline
            children.wait(time.monotonic() + 0.05)
            for node in nodes:
                node.ask()
        for node in nodes:
            node.hang_up()
            node.socket.unlink()
    assert no_children()


def test_a_run_that_failed_is_kept_too(tmp_path: Path) -> None:
    def interrupt(step: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(line("nodes=2"), keep=tmp_path / "kept", progress=interrupt)
    assert no_children()
    config = load_config(tmp_path / "kept" / "node-0.yaml")
    assert config.socket_path == tmp_path / "kept" / "node-0.sock"
    assert [[peer.id for peer in link.peers] for link in config.links] == [[1]]


def test_a_node_that_dies_unasked_fails_the_run_with_its_name() -> None:
    killed: list[psutil.Process] = []

    def kill_node_2(step: int) -> None:
        if not killed:
            node = next(c for c in psutil.Process().children() if any("node-2.yaml" in word for word in c.cmdline()))
            node.kill()
            killed.append(node)

    with pytest.raises(SwarmError, match=r"^node 2: killed by SIGKILL"):
        run(line(), progress=kill_node_2)
    assert no_children()


def test_a_child_that_dies_is_remembered_by_its_last_words(tmp_path: Path) -> None:
    """And not by a line that it said many times when it started, as ArduCopter does for each list of defaults."""
    code = "import sys; print('Loaded defaults from a file\\n' * 20, file=sys.stderr, flush=True); input(); sys.exit(5)"
    with Children() as children:
        child = children.start("vehicle 1", ["-c", code], tmp_path / "vehicle-1.log")
        # What it says over MAVLink.
        for text in ("Arming motors", "Crash: Disarming", "Hit ground at 7.1 m/s"):
            child.note(text)
        child.tell("go")
        with pytest.raises(SwarmError) as caught:
            children.wait(time.monotonic() + PATIENCE_S)
    words = str(caught.value).split(": ", 2)
    assert words[:2] == ["vehicle 1", "ended with exit code 5"]
    assert sorted(words[2].split(" | ")) == sorted(
        ["Loaded defaults from a file", "Arming motors", "Crash: Disarming", "Hit ground at 7.1 m/s"]
    )


def test_what_cannot_start_fails_the_run_with_its_own_words(tmp_path: Path) -> None:
    with pytest.raises(SwarmError, match=r"^radio: ended with exit code 1: .*missing.*there is no folder .*missing$"):
        run(line(), record=tmp_path / "missing" / "air.tlog")
    assert no_children()
    (tmp_path / "node-1.db").mkdir()
    node = NodeProcess(1, tmp_path, tmp_path / "1.sock", "node-1")
    node.config.write_text(f"node: {{id: 1, role: base}}\nstore: {{path: {node.store}}}\n", encoding="utf-8")
    with Children() as children:
        node.start(children)
        with pytest.raises(SwarmError, match=r"^node 1: ended with exit code 1: .*node-1\.db"):
            children.wait_for(lambda: [] if node.ready else [node.name], PATIENCE_S)
    assert no_children()


_PARENT = """
import sys
from rass_mav.lab.swarm.scenario import load_scenario
from rass_mav.lab.fleet.processes import run

if __name__ == "__main__":
    told = []
    def progress(step):
        if not told:
            told.append(step)
            print("flying", flush=True)
    run(load_scenario("udp-line", assignments=["nodes=4", "steps=100000"]), progress=progress)
"""


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_no_process_outlives_its_parent(number: signal.Signals, tmp_path: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", _PARENT],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={"PATH": "", "TMPDIR": str(tmp_path), "PYTHONPATH": str(Path(__file__).parents[3])},
    ) as parent:
        try:
            assert some(parent.stdout).readline() == b"flying\n"
            children = psutil.Process(parent.pid).children(recursive=True)
            assert len(children) == 5
            parent.send_signal(number)
            parent.wait(PATIENCE_S)
            _, alive = psutil.wait_procs(children, timeout=PATIENCE_S)
            assert alive == []
        finally:
            parent.kill()
    if number is not signal.SIGKILL:
        assert list(tmp_path.iterdir()) == []
    if number is signal.SIGTERM:
        assert parent.returncode == 128 + signal.SIGTERM


def test_what_makes_no_sense_is_refused_before_anything_starts(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=f"^nodes: expected at most {MAX_NODES} with transport udp, got 65$"):
        run(line("nodes=65"))
    (tmp_path / "mine").touch()
    with pytest.raises(ConfigError, match="expected a new or empty directory"):
        run(line(), keep=tmp_path)
    with pytest.raises(ConfigError, match=r"^radiation\.drift: expected"):
        run(line("radiation.drift=1e9"))

"""Real processes: a picture over four lossy hops, while each drone between is killed once."""

from __future__ import annotations

import json
import random
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from tests.environment import environment
from tests.extent import extents

from .app_nodes import ROOT, RunningNode, Tidy, free_ports, process

HOPS = 4
LOSS = 0.1
#: Faster than the nodes: what they lose, and not what the link carries, is tried here.
BYTES_S = 1e7


@contextmanager
def lossy_link(seed: int, bytes_s: float = BYTES_S, loss: float = LOSS) -> Iterator[tuple[str, str]]:
    """An emulated link until the end of the block: where its two ends are heard."""
    arguments = [sys.executable, "-m", "benchmarks.relay", "--bytes-s", str(bytes_s), "--delay", "0"]
    with subprocess.Popen(
        [*arguments, "--loss", str(loss), "--seed", str(seed)], cwd=ROOT, env=environment(),
        stdin=subprocess.PIPE, stdout=subprocess.PIPE,
    ) as relay:  # fmt: skip
        assert relay.stdout is not None
        ends = json.loads(relay.stdout.readline())
        left, right = (f"{host}:{port}" for host, port in (ends["left"], ends["right"]))
        yield left, right
        relay.communicate()


def lossy_line(directory: Path, links: list[tuple[str, str]], **node: float) -> list[RunningNode]:
    """The base, and drones that hear only those next to them. Not started. `node`: settings of each."""
    ids = range(1, len(links) + 2)
    nodes = []
    for node_id, port in zip(ids, free_ports(len(ids)), strict=True):
        peers = []
        if node_id > 1:
            peers.append({"id": node_id - 1, "address": links[node_id - 2][1]})
        if node_id <= len(links):
            peers.append({"id": node_id + 1, "address": links[node_id - 1][0]})
        link = {"listen": f"127.0.0.1:{port}", "peers": peers}
        role = {"role": "base" if node_id == 1 else "drone", **node}
        nodes.append(RunningNode(directory, node_id, node=role, links=[link]))
    return nodes


@pytest.mark.parametrize("size", extents(200_000, 6_000_000))
def test_a_picture_arrives_byte_for_byte(size: int, tmp_path: Path, tidy: Tidy) -> None:
    picture = random.Random(size).randbytes(size)
    (tmp_path / "photo.jpg").write_bytes(picture)
    with ExitStack() as stack:
        links = [stack.enter_context(lossy_link(seed)) for seed in range(HOPS)]
        nodes = [tidy(node).start() for node in lossy_line(tmp_path, links)]
        base, *between, source = nodes
        assert process(tmp_path, "put", "-c", source.config, "photo.jpg").returncode == 0

        def there() -> int:
            return len(base.listing())

        parts = -(-size // 32768)
        for number, relay in enumerate(between, 1):
            base.until(lambda number=number: there() >= parts * number // HOPS)  # type: ignore[misc]
            assert relay.signal(signal.SIGKILL) == -signal.SIGKILL
            relay.start()
        # And the manifest.
        base.until(lambda: there() > parts)
        said = process(tmp_path, "get", "-c", base.config, "photo.jpg", "-o", "got.jpg")
        assert said.returncode == 0, said.stderr
    assert (tmp_path / "got.jpg").read_bytes() == picture


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_a_receiver_that_ends_in_the_middle_of_a_part_is_sent_the_rest(
    number: signal.Signals, tmp_path: Path, tidy: Tidy
) -> None:
    """A part takes five seconds of this link."""
    part = random.Random(1).randbytes(32_000)
    chunks = -(-len(part) // 123)
    with lossy_link(1, bytes_s=8_000.0, loss=0.0) as link:
        nodes = lossy_line(tmp_path, [link], step_s=0.25)
        base, source = [tidy(node).start() for node in nodes]

        def sent() -> int:
            return int(source.status()["ledger"]["sent_data"])

        source.until(lambda: bool(source.status()["neighbours"]))
        id = source.ask("put", payload=part)["id"]
        source.until(lambda: sent() >= 0.8 * chunks)
        before = sent()
        assert base.signal(number) in (0, -number)
        assert not base.listing()
        base.start()
        base.until(lambda: len(base.listing()) == 1)
        # Besides the rest: what came since the last turn, and what was sent to a node that was off.
        assert sent() - before <= chunks - before + 0.5 * before
        assert base.content(id) == part

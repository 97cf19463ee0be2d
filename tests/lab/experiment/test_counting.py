"""Alg. 2 as written counts to infinity when the base vanishes; announcement numbers end that."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.lab.experiment.counting import COLUMNS, AsWritten, Ours, Router, observe
from tests.commands import json_output
from tests.some import some

LINE = [[1], [0, 2], [1, 3], [2]]


def line(nodes: int) -> list[list[int]]:
    return [[n for n in (i - 1, i + 1) if 0 <= n < nodes] for i in range(nodes)]


def test_alg_2_by_hand() -> None:
    """Four in a row. The base speaks at steps 0 to 4; what it says travels one hop a step."""
    router = AsWritten(LINE, forgets=True)
    believed = []
    for step in range(8):
        router.step(step < 5)
        believed.append(router.hops()[1:])
    assert believed == [
        [None, None, None], [1, None, None], [1, 2, None], [1, 2, 3], [1, 2, 3],
        # Step 5: the base's last word of step 4. Step 6: 1 hears only 2, which says 3.
        [1, 2, 3], [3, 2, 3], [3, 4, 3],
    ]  # fmt: skip
    assert router.next_hops() == [None, 2, 1, 2]


def test_entries_that_stay_point_to_the_base_for_ever() -> None:
    found = observe(AsWritten(LINE, forgets=False), 50, 10)
    assert found[-1].with_route == 3
    assert found[-1].highest == 3
    assert not any(sample.cycles for sample in found)


@given(st.integers(3, 12), st.integers(15, 40))
def test_while_the_base_is_there_all_agree(nodes: int, vanishes: int) -> None:
    neighbours = line(nodes)
    routers: list[Router] = [AsWritten(neighbours, forgets=f) for f in (True, False)]
    routers.append(Ours(neighbours))
    for router in routers:
        for _ in range(vanishes):
            router.step(True)
    distances = list(range(1, nodes))
    assert all(router.hops()[1:] == distances for router in routers)


@given(st.integers(3, 12), st.integers(15, 40))
def test_without_a_base_hop_counts_grow_by_one_a_step_but_ours_end(nodes: int, vanishes: int) -> None:
    steps = vanishes + 3 * nodes + 20
    written = observe(AsWritten(line(nodes), forgets=True), steps, vanishes)
    assert written[-1].with_route == nodes - 1
    assert all(sample.cycles for sample in written[vanishes + 2 :])
    assert some(written[-1].highest) >= steps - vanishes - 2
    ours = observe(Ours(line(nodes)), steps, vanishes)
    assert ours[-1].with_route == 0
    assert not any(sample.cycles for sample in ours)
    assert max(sample.highest or 0 for sample in ours) == nodes - 1


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    summary = json_output(capsys, "experiment", "counting-to-infinity", "--out", str(tmp_path), "--steps", "90")
    assert {path.name for path in tmp_path.iterdir()} == set(summary["files"])
    lines = (tmp_path / "counting.csv").read_text().splitlines()
    assert lines[0] == ",".join(COLUMNS)
    assert len(lines) == 1 + 2 * 3 * 90
    text = (tmp_path / "table.md").read_text(encoding="utf-8")
    assert "| grid | Alg. 2 as written, silent neighbours forgotten | never |" in text

"""How long a base takes to catch up: docs/how-to/capacity.md has what the mock swarm delivers."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.catch_up import CASES, PART_BYTES, READING_BYTES, Case, main, run

PAGE = Path(__file__).parents[3] / "docs/how-to/capacity.md"


def rows() -> list[list[str]]:
    lines = PAGE.read_text(encoding="utf-8").splitlines()
    return [line.strip("| ").split(" | ") for line in lines if line.startswith("| `")]


@pytest.mark.no_cover
@pytest.mark.parametrize(
    ("case", "row"), list(zip(CASES, rows(), strict=True)), ids=[f"{case.preset}-{case.bandwidth}" for case in CASES]
)
def test_readings_arrive_at_the_rate_that_the_page_shows(case: Case, row: list[str]) -> None:
    assert row[0].startswith(f"`{case.preset}`")
    found = run(case, 1, case.readings // 2, READING_BYTES)
    assert found.data == case.readings // 2
    assert found.rate == pytest.approx(float(row[2]), rel=0.1)


@pytest.mark.no_cover
def test_files_of_five_drones_arrive_although_few_chunks_fit_into_a_turn() -> None:
    """Over a slow radio a turn of one second holds one chunk of a node. Transfers are given up, and give way to others,
    for lack of progress: that is measured in the time that chunks take."""
    assert run(Case("sik-64k", 1.0, 20, 0, 0), 5, 4, PART_BYTES // 2).data == 20


@pytest.mark.soak
def test_the_page_has_the_whole_table(capsys: pytest.CaptureFixture[str]) -> None:
    main([])
    for line in capsys.readouterr().out.splitlines():
        assert line in PAGE.read_text(encoding="utf-8")

"""The simulated Wi-Fi beside ns-3 (tools/ns3/compare.py): our half, and the figures of ns-3 in
docs/evaluation/air.md."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tools.ns3.compare import CAPTURES, MACS, Cell, Outcome, main, ours, outcome, rows

PAGE = Path(__file__).parents[1] / "docs" / "evaluation" / "air.md"
#: How near the shares of the table are to each other, except for those that the page names.
NEAR = 0.02


def outcome_of(cell: Cell, seconds: float) -> Outcome:
    frames = cell.frames(seconds)
    return outcome((frames, ours(cell, frames)))


@pytest.mark.no_cover
@pytest.mark.parametrize("place", ["line of 3", "line of 5", "grid of 10 x 10"])
def test_less_is_lost_if_receivers_keep_the_first_frame_and_hardly_anything_if_it_is_repeated(place: str) -> None:
    received = {
        (mac, capture): outcome_of(Cell(place, 20.0, mac, capture), 2.0 if "grid" in place else 20.0)
        for mac in ("broadcast", "unicast")
        for capture in ("first", "none")
    }
    lost = {key: 1.0 - value.received for key, value in received.items()}
    assert lost["broadcast", "none"] > 1.5 * lost["broadcast", "first"] > 0.0
    assert lost["broadcast", "first"] > 10 * lost["unicast", "first"]
    assert lost["broadcast", "none"] > 5 * lost["unicast", "none"]
    assert received["unicast", "none"].p95_s > received["unicast", "first"].p95_s > 1.5e-3


def test_the_more_frames_the_more_are_lost() -> None:
    received = [outcome_of(Cell("line of 5", per_s, "broadcast", "none"), 20.0).received for per_s in (5.0, 20.0, 60.0)]
    assert received[0] > received[1] + 0.02 > received[2] + 0.04


def figures_of_ns3() -> dict[Cell, float]:
    """From the table of the page: what ns-3 received in each cell, 0..1."""
    text = PAGE.read_text(encoding="utf-8")
    found: dict[Cell, float] = {}
    for row in rows(MACS, CAPTURES):
        cell = row[0]
        place = cell.place if cell.per_s else f"{cell.place}, saturated"
        head = re.escape(f"| {cell.mac}, {cell.capture} | {place} |")
        # The first table has the shares.
        line = re.search(f"^{head}(.*)$", text, re.M)
        assert line, head
        shares = [float(share) for share in re.findall(r"/ ([\d.]+)", line[1])]
        found.update(zip(row, shares, strict=True))
    return found


@pytest.mark.no_cover
@pytest.mark.parametrize(
    ("cell", "seconds"),
    [
        (Cell("grid of 10 x 10", 40.0, "broadcast", "first"), 2.0),
        (Cell("grid of 10 x 10", 40.0, "broadcast", "none"), 2.0),
        (Cell("grid of 10 x 10", 20.0, "unicast", "first"), 2.0),
        (Cell("10 in range", None, "broadcast", "none", "wifi-6m"), 0.5),
    ],
    ids=str,
)
def test_our_half_is_still_as_near_to_ns3(cell: Cell, seconds: float) -> None:
    assert outcome_of(cell, seconds).received == pytest.approx(figures_of_ns3()[cell], abs=NEAR)


def test_our_half_runs_alone(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--ours", "--mac", "broadcast", "--capture", "first", "--seconds", "0.1"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert sum(line.startswith("| broadcast, first | line of 3 | ") for line in lines) == 2
    assert not any(" / " in line for line in lines)

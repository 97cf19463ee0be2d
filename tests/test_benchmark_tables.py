"""The tables that `python -m benchmarks` prints, and their places in docs/evaluation/performance.md."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from benchmarks.tables import ratios, spread, table

PAGE = Path(__file__).parents[1] / "docs" / "evaluation" / "performance.md"


def test_a_cell_has_the_least_the_median_and_the_most() -> None:
    assert spread([3000.0, 1000.0, 1500.0]) == "1,000 / 1,500 / 3,000"
    assert spread([0.25], 1) == "0.2 / 0.2 / 0.2"
    assert spread(ratios([1.0, 6.0], [2.0, 3.0]), 2) == "0.50 / 1.25 / 2.00"
    assert table(["a", "b"], [["1", "2"]]) == "| a | b |\n| --- | --- |\n| 1 | 2 |\n"


def test_the_page_has_a_place_for_each_part() -> None:
    pytest.importorskip("numpy", reason="numpy is not installed (extra ground)")
    pytest.importorskip("aiohttp", reason="aiohttp is not installed (extra ground)")
    from benchmarks.__main__ import PARTS, put

    text = PAGE.read_text(encoding="utf-8")
    places = re.findall(r"<!-- measured: (\w+) -->\n.*?<!-- end of measured -->\n", text, re.S)
    assert sorted(places) == sorted([*PARTS, "machine"])
    changed = put(text, "store", "new\n")
    assert "<!-- measured: store -->\nnew\n<!-- end of measured -->\n" in changed
    assert put(changed, "store", "newer\n").count("<!-- measured:") == len(places)
    with pytest.raises(ValueError, match="no <!-- measured: other -->"):
        put(text, "other", "")

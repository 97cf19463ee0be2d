"""Swarms on the air of a slow Wi-Fi, where two nodes that do not hear each other collide at a third."""

from __future__ import annotations

from functools import cache
from typing import Any

import pytest

from .worlds import run

pytestmark = pytest.mark.no_cover


@cache
def summary_of(seed: int, *without: str) -> dict[str, Any]:
    """The summary of a grid in which a tenth of the frames collides. Its invariants are checked after each step."""
    keys = {
        "nodes": 49, "steps": 60, "seed": seed, "radio": {"preset": "wifi-1m", "capture": "none"},
        "without": list(without), "data": {"interval_steps": 5, "until_step": 40},
    }  # fmt: skip
    return run(**keys).statistics.summary()


@pytest.mark.parametrize("seed", [1, pytest.param(3, marks=pytest.mark.soak)])
def test_lost_answers_do_not_multiply_the_load(seed: int) -> None:
    found = summary_of(seed)
    assert found["created"] == 384
    assert found["delivered"] >= 0.98 * found["created"]
    assert found["reliability"] >= 0.995
    assert found["altered"] == 0
    assert found["transmissions_per_datum"] <= 9
    assert 0.05 < found["air"]["collided"] < 0.2, "there are hidden nodes, and they do not feed each other"
    assert found["routing"]["loops"] == 0


def test_repetitions_at_a_fixed_time_cost_more() -> None:
    def sent(*without: str) -> float:
        return float(sum(summary_of(seed, *without)["transmissions_per_datum"] for seed in (1, 2)))

    assert sent("measured-retries") > sent()

"""How much a test does: little each time (`make test`), much when there are hours (`make soak`)."""

from __future__ import annotations

from typing import TypeVar

import pytest
from hypothesis import settings

T = TypeVar("T")

#: Examples of a property that names no number of its own, in the suite and in a soak.
EXAMPLES, SOAK_EXAMPLES = 25, 2000


def extents(short: T, long: T) -> list[pytest.ParameterSet]:
    """Values for `pytest.mark.parametrize`: the suite takes `short`, a soak `long`."""
    return [pytest.param(short, id="short"), pytest.param(long, id="long", marks=pytest.mark.soak)]


def seeds(short: int, long: int) -> list[pytest.ParameterSet]:
    """Likewise, where each seed is a test of its own: the first `short`, and in a soak the others of `long` too."""
    return [pytest.param(seed, marks=[] if seed < short else [pytest.mark.soak]) for seed in range(long)]


def examples(short: int, long: int | None = None) -> int:
    """`max_examples` of a property: what the suite tries, and a soak, by default 40 times as many."""
    soak = settings().max_examples == SOAK_EXAMPLES
    return short if not soak else 40 * short if long is None else long

"""What the benchmarks share: least, median and most of several repetitions, and tables in Markdown."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Sequence


def spread(values: Sequence[float], digits: int = 0) -> str:
    """Least, median and most, as a table shows them."""
    return " / ".join(f"{one:,.{digits}f}" for one in (min(values), statistics.median(values), max(values)))


def ratios(values: Sequence[float], others: Sequence[float]) -> list[float]:
    """Turn by turn, because other load on the computer affects the two of a turn alike."""
    return [value / other for value, other in zip(values, others, strict=True)]


def table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """In Markdown."""
    lines = ["| " + " | ".join(row) + " |" for row in (columns, ["---"] * len(columns), *rows)]
    return "\n".join(lines) + "\n"

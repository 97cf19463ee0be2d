"""CSV and Markdown files."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from rass_mav.errors import RassError, os_errors_as
from rass_mav.lab.experiment.runner import Result
from rass_mav.lab.experiment.statistics import Estimate

#: Columns of runs.csv that identify a row's run; the summary's scalars follow.
RUN_COLUMNS = ("world", "topology", "policy", "variant", "seed", "steps")


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> Path:
    """A CSV file with a header; None is an empty field. Raises `RassError` if it cannot be written."""
    with os_errors_as(RassError, path), path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(rows)
    return path


def write_text(path: Path, text: str) -> Path:
    """A text file. Raises `RassError` if it cannot be written."""
    with os_errors_as(RassError, path):
        path.write_text(text, encoding="utf-8")
    return path


def markdown(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = ["| " + " | ".join(row) + " |" for row in (columns, ["---"] * len(columns), *rows)]
    return "\n".join(lines) + "\n"


def flatten(values: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, object]]:
    """Scalars of nested objects, named by their path (`delay_steps.mean`)."""
    for key, value in values.items():
        if isinstance(value, dict):
            yield from flatten(value, f"{prefix}{key}.")
        elif not isinstance(value, list):
            yield prefix + key, value


def write_runs(path: Path, results: Sequence[Result]) -> Path:
    """runs.csv: a row a run, `RUN_COLUMNS`, then the scalars of the summary."""
    flat = [dict(flatten(result.summary)) for result in results]
    # Some runs have more columns than others: those with failures of robots, for example.
    columns = [key for key in dict.fromkeys(key for values in flat for key in values) if key not in RUN_COLUMNS]
    rows = [
        [r.world, r.topology, r.policy, r.variant, r.seed, r.steps, *(values.get(c) for c in columns)]
        for r, values in zip(results, flat, strict=True)
    ]
    return write_csv(path, [*RUN_COLUMNS, *columns], rows)


def triple(name: str) -> tuple[str, str, str]:
    """The columns of a mean and its confidence interval, as `figures_of` gives them."""
    return f"{name}_mean", f"{name}_low", f"{name}_high"


def cell(value: Estimate | float | None, digits: int = 2, *, sign: str = "") -> str:
    """A figure in a Markdown table; `sign`: the text before a mean that is not negative."""
    if value is None:
        return "n/a"
    if not isinstance(value, Estimate):
        return f"{value:.{digits}f}"
    return (sign if value.mean >= 0 else "") + value.text(digits)


def figures_of(value: Estimate | None, digits: int = 4) -> list[float | None]:
    """Mean and confidence interval for three columns of a CSV file."""
    if value is None:
        return [None, None, None]
    low, high = value.interval or (None, None)
    return [number if number is None else round(number, digits) for number in (value.mean, low, high)]

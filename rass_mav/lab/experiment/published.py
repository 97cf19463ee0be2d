"""The authors' published results: Table I of the paper, and their averaged raw results where the files are available.

Table I is in arXiv 2201.01349, section IV. The files come from the public repository MISTLab/RASS.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from rass_mav.errors import ConfigError, why

#: Delay in steps (the paper prints it as "transfer speed (hops)"; None: not applicable) and memory used in percent.
TABLE_1: dict[tuple[str, str], tuple[float | None, float]] = {
    ("grid", "rass"): (11.45, 1.35),
    ("grid", "hop-count"): (9.11, 0.61),
    ("grid", "stigmergy"): (None, 100.0),
    ("scale-free", "rass"): (11.44, 1.95),
    ("scale-free", "hop-count"): (6.85, 0.50),
    ("scale-free", "stigmergy"): (None, 100.0),
    ("lennard-jones", "rass"): (12.51, 1.69),
    ("lennard-jones", "hop-count"): (7.32, 0.51),
    ("lennard-jones", "stigmergy"): (None, 100.0),
    ("random-walk", "rass"): (12.68, 1.67),
    ("random-walk", "hop-count"): (7.76, 0.57),
    ("random-walk", "stigmergy"): (None, 100.0),
}


@dataclass
class AuthorsCurve:
    """Means over the authors' 30 runs, one entry for each of `step`."""

    step: list[int] = field(default_factory=list)
    reliability: list[float] = field(default_factory=list)
    """1 - lost / created."""
    swarm: list[float] = field(default_factory=list)
    """Items in all stores except the base's."""
    base: list[float] = field(default_factory=list)
    """Distinct items at the base."""


@dataclass
class Published:
    """The authors' results by (topology, policy); empty if no files were given."""

    curves: dict[tuple[str, str], AuthorsCurve] = field(default_factory=dict)
    delays: dict[tuple[str, str], dict[int, int]] = field(default_factory=dict)
    """Delay in steps -> data that arrived after it, in all runs together."""


def default_directory() -> Path | None:
    """shared/data/paper beside the project, if it exists. The product does not ship the files."""
    path = Path(__file__).parents[4] / "shared" / "data" / "paper"
    return path if (path / "curves.csv").is_file() else None


def load_published(directory: Path | None) -> Published:
    """Read curves.csv and delays.csv. Raises `ConfigError` that names the file; None: nothing."""
    published = Published()
    if directory is None:
        return published
    path = directory / "curves.csv"
    for key, row in _rows(path, ("step", "reliability_mean", "swarm_stored_mean", "base_stored_mean")):
        curve = published.curves.setdefault(key, AuthorsCurve())
        curve.step.append(int(row[0]))
        curve.reliability.append(row[1])
        curve.swarm.append(row[2])
        curve.base.append(row[3])
    for key, row in _rows(directory / "delays.csv", ("delay_steps", "count")):
        published.delays.setdefault(key, {})[int(row[0])] = int(row[1])
    return published


def _rows(path: Path, columns: tuple[str, ...]) -> Iterator[tuple[tuple[str, str], list[float]]]:
    try:
        with path.open(encoding="utf-8", newline="") as file:
            for row in csv.DictReader(file):
                yield (row["topology"], row["policy"]), [float(row[column]) for column in columns]
    except OSError as error:
        raise ConfigError(f"--reference-data: {path}: {why(error)}") from None
    except (KeyError, TypeError, ValueError) as error:
        expected = ", ".join(("topology", "policy", *columns))
        raise ConfigError(f"--reference-data: {path}: expected the columns {expected} ({error})") from None

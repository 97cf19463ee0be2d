"""`experiment`: the paper's experiments and ours, into a directory of tables and figures."""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from rass_mav.errors import ConfigError, RassError, os_errors_as

from .common import Subparsers, add_command, add_group, add_set, print_json, progress, say, start_logging

if TYPE_CHECKING:
    from rass_mav.experiment.runs import Extent, Result, Run

T = TypeVar("T")

_TOPOLOGIES = ("grid", "scale-free", "lennard-jones", "random-walk")
_VARIANTS = ("plain", "immediate", "mirror", "mirror-immediate", "copies-auto")


def register(subparsers: Subparsers) -> None:
    """Add the command with its experiments."""
    names = add_group(
        subparsers, "experiment", "name", help="run a named experiment: CSV, Markdown tables and PNG figures",
        description="Run a named experiment. The runs that it finished are kept, and the same command goes on.",
        example="rass-mav experiment paper --out results",
    )  # fmt: skip

    paper = _add(
        names, "paper", _paper, "the paper's simulations: its Table I and its figures",
        "rass-mav experiment paper --out results --runs 2 --topology grid",
    )  # fmt: skip
    _add_choices(paper, "--topology", _TOPOLOGIES, "four")
    paper.add_argument(
        "--world", choices=("paper", "reference", "both"), default="both",
        help="paper: the text's rules; reference: what the authors' code did (default: both)",
    )  # fmt: skip
    paper.add_argument(
        "--reference-data", metavar="DIR",
        help="the authors' curves.csv and delays.csv, to draw them in (default: shared/data/paper beside the project)",
    )  # fmt: skip

    _add(
        names, "five-drones", _five_drones, "the paper's physical experiment: reliability, whole and by drone",
        "rass-mav experiment five-drones --out results",
    )  # fmt: skip

    moving = _add(
        names, "moving-sources", _moving_sources, "what becomes of data when the sources of radiation move",
        "rass-mav experiment moving-sources --out results --drift 0.05 0.5",
    )  # fmt: skip
    moving.add_argument(
        "--drift", nargs="+", type=float, metavar="METRES", default=[0.0, 0.05, 0.2, 0.5],
        help="how far each source moves in a step (default: 0 0.05 0.2 0.5)",
    )  # fmt: skip
    moving.add_argument("--topology", choices=_TOPOLOGIES, default="grid", help="where the drones are (default: grid)")

    maxima = _add(
        names, "local-maxima", _local_maxima, "how much data sits where no neighbour is fitter, away from the base",
        "rass-mav experiment local-maxima --out results",
    )  # fmt: skip
    _add_choices(maxima, "--topology", _TOPOLOGIES, "four")

    policies = _add(
        names, "policies", _policies, "all policies, with and without mirrors and immediate forwarding; the ceiling",
        "rass-mav experiment policies --out results --runs 2 --topology grid",
    )  # fmt: skip
    _add_choices(policies, "--topology", (*_TOPOLOGIES, "islands"), "five")
    _add_choices(policies, "--variant", _VARIANTS, "five")
    policies.add_argument(
        "--failures", nargs="?", type=float, const=0.1, metavar="FRACTION",
        help="all runs once more, in which this part of the drones dies for good, 0 to 1 (0.1 if no number is given)",
    )  # fmt: skip

    hostile = _add(
        names, "hostile", _hostile, "attackers beside honest nodes: what arrives, is lost, heals; who notices",
        "rass-mav experiment hostile --out results --runs 3",
    )  # fmt: skip
    hostile.add_argument("--attacker", nargs="+", metavar="NAME", help="which (default: all; docs/hostile.md)")

    counting = add_command(
        names, "counting-to-infinity", _counting,
        help="what Alg. 2 as written does when the base vanishes, and what sequence numbers change",
        example="rass-mav experiment counting-to-infinity --out results",
    )  # fmt: skip
    _add_out(counting)
    counting.add_argument("--steps", type=int, default=200, metavar="N", help="(default: 200; the base vanishes at 60)")


def _add_out(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", required=True, metavar="DIR", help="where everything is written")


def _add_choices(parser: argparse.ArgumentParser, option: str, choices: Sequence[str], how_many: str) -> None:
    parser.add_argument(
        option, nargs="+", choices=choices, default=list(choices), help=f"which (default: all {how_many})"
    )


def _add(
    names: Subparsers, name: str, run: Callable[[argparse.Namespace], int], help: str, example: str
) -> argparse.ArgumentParser:
    """An experiment made of runs of the mock swarm."""
    parser = add_command(names, name, run, help=help, example=example)
    _add_out(parser)
    parser.add_argument("--runs", type=int, default=30, metavar="N", help="seeds 0 .. N - 1 (default: 30)")
    parser.add_argument("--steps", type=int, default=500, metavar="N", help="steps of Alg. 1 a run (default: 500)")
    parser.add_argument("--policy", nargs="+", metavar="NAME", help="which to compare (docs/experiments.md)")
    parser.add_argument(
        "--jobs", type=int, default=os.cpu_count() or 1, metavar="N", help="processes at a time (default: one a core)"
    )
    parser.add_argument("--dask", metavar="ADDRESS", help="use the workers of this Dask scheduler instead")
    add_set(parser)
    return parser


def _paper(options: argparse.Namespace) -> int:
    from rass_mav.experiment import paper
    from rass_mav.experiment.published import default_directory, load_published

    given = options.reference_data
    published = load_published(default_directory() if given is None else Path(given))
    worlds = paper.WORLDS if options.world == "both" else (options.world,)
    policies = _compared(options, paper.POLICIES, paper.ALL_POLICIES)
    planned = paper.plan(_extent(options), worlds, _distinct(options.topology), policies)
    return _runs(options, planned, lambda results, out: paper.report(results, out, published), "table1.md")


def _five_drones(options: argparse.Namespace) -> int:
    from rass_mav.experiment import five_drones

    planned = five_drones.plan(_extent(options), _compared(options, five_drones.POLICIES))
    return _runs(options, planned, five_drones.report)


def _moving_sources(options: argparse.Namespace) -> int:
    from rass_mav.experiment import moving_sources

    policies = _compared(options, moving_sources.POLICIES)
    planned = moving_sources.plan(_extent(options), _distinct(options.drift), options.topology, policies)
    return _runs(options, planned, moving_sources.report)


def _local_maxima(options: argparse.Namespace) -> int:
    from rass_mav.experiment import local_maxima

    policies = _compared(options, local_maxima.POLICIES)
    planned = local_maxima.plan(_extent(options), _distinct(options.topology), policies)
    return _runs(options, planned, local_maxima.report)


def _policies(options: argparse.Namespace) -> int:
    from rass_mav.experiment import policies

    planned = policies.plan(
        _extent(options), _distinct(options.topology), _compared(options, policies.POLICIES),
        _distinct(options.variant), die_fraction=options.failures,
    )  # fmt: skip
    return _runs(options, planned, policies.report)


def _hostile(options: argparse.Namespace) -> int:
    from rass_mav.experiment import hostile

    attackers = _distinct(options.attacker or hostile.ATTACKERS)
    for name in attackers:
        if name not in hostile.ATTACKERS:
            raise ConfigError(f"--attacker: expected some of {', '.join(hostile.ATTACKERS)}, got {name!r}")
    policies = _compared(options, hostile.POLICIES)
    planned = hostile.plan(_extent(options), attackers, policies, list(hostile.VARIANTS))
    return _runs(options, planned, hostile.report)


def _counting(options: argparse.Namespace) -> int:
    from rass_mav.experiment import counting

    _begin(options)
    if options.steps <= counting.VANISHES:
        raise ConfigError(f"--steps: expected more than {counting.VANISHES}, when the base vanishes")
    out = _directory(options.out)
    _told(options, out, counting.report(out, options.steps), {})
    return 0


def _begin(options: argparse.Namespace) -> None:
    from rass_mav.experiment.figures import need_matplotlib

    start_logging(options.verbose, "critical")
    need_matplotlib()


def _extent(options: argparse.Namespace) -> Extent:
    """How much is to be run. Raises `ConfigError`."""
    from rass_mav.experiment.runs import Extent

    _begin(options)
    for name in ("runs", "steps", "jobs"):
        if getattr(options, name) < 1:
            raise ConfigError(f"--{name}: expected 1 or more, got {getattr(options, name)}")
    return Extent(options.runs, options.steps, options.assignments)


def _runs(
    options: argparse.Namespace,
    planned: Sequence[Run],
    report: Callable[[Sequence[Result], Path], list[Path]],
    table: str = "table.md",
) -> int:
    """Do the runs and report on them. `table`: which of the files is shown."""
    from rass_mav.experiment.runner import run_all

    out = _directory(options.out)
    begin = time.perf_counter()
    show = partial(progress, unit="runs", quiet=options.json)
    outcome = run_all(planned, out / "runs", jobs=options.jobs, dask=options.dask, progress=show)
    wall = time.perf_counter() - begin
    counts = {"runs": len(outcome.results), "done": outcome.done, "reused": outcome.reused, "wall_s": round(wall, 3)}
    _told(options, out, report(outcome.results, out), counts, table)
    if not options.json:
        say(f"{outcome.done} runs done in {wall:.0f} s, {outcome.reused} had been done before")
    return 0


def _told(
    options: argparse.Namespace, out: Path, files: Sequence[Path], counts: dict[str, Any], table: str = "table.md"
) -> None:
    """What was written, and in words also the `table`."""
    names = [path.name for path in files]
    if options.json:
        print_json({"experiment": options.name, "out": str(out), **counts, "files": names})
    else:
        say((out / table).read_text(encoding="utf-8"))
        say(f"in {out}: {', '.join(names)}")


def _directory(path: str) -> Path:
    out = Path(path)
    with os_errors_as(RassError, f"--out {path}"):
        out.mkdir(parents=True, exist_ok=True)
    return out


def _compared(options: argparse.Namespace, default: Sequence[str], known: Sequence[str] = ()) -> list[str]:
    """The policies to compare, of those that are `known` (else of `default`). Raises `ConfigError`."""
    names = _distinct(options.policy or default)
    for name in names:
        if name not in (known or default):
            raise ConfigError(f"--policy: expected some of {', '.join(known or default)}, got {name!r}")
    return names


def _distinct(values: Sequence[T]) -> list[T]:
    """Each once, in the order given."""
    return list(dict.fromkeys(values))

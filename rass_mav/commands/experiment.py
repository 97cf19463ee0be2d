"""`experiment`: runs the paper's experiments and ours, and writes tables and figures to a directory."""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Collection, Sequence
from functools import partial
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any

from rass_mav.errors import ConfigError, RassError, os_errors_as

from .common import (
    Subparsers,
    add_command,
    add_group,
    add_set,
    keeping,
    lists,
    print_json,
    progress,
    say,
    start_logging,
    warn,
)

if TYPE_CHECKING:
    from rass_mav.lab.experiment.runs import Extent, Result, Run


def register(subparsers: Subparsers) -> None:
    """Add the command with its experiments."""
    names = add_group(
        subparsers, "experiment", "name", help="run a named experiment: CSV, Markdown tables and PNG figures",
        description="Run a named experiment. Finished runs are kept, and the same command continues from there.",
        example="rass-mav experiment paper --out results",
    )  # fmt: skip

    paper = _add(
        names, "paper", _paper, "the paper's simulations: its Table I and its figures",
        "rass-mav experiment paper --out results --runs 2 --topology grid", "ALL_POLICIES",
    )  # fmt: skip
    _add_names(paper, "--topology", "paper:TOPOLOGIES", "which topologies, all by default", nargs="+")
    paper.add_argument(
        "--world", choices=("paper", "reference", "both"), default="both",
        help="paper: the text's rules; reference: what the authors' code did (default: both)",
    )  # fmt: skip
    paper.add_argument(
        "--reference-data", metavar="DIR",
        help="folder with the authors' curves.csv and delays.csv, to draw them (default: shared/data/paper beside the "
        "project)",
    )  # fmt: skip

    _add(
        names, "five-drones", _five_drones, "the paper's physical experiment: reliability, in total and by drone",
        "rass-mav experiment five-drones --out results", "ALL_POLICIES",
    )  # fmt: skip

    moving = _add(
        names, "moving-sources", _moving_sources, "what becomes of data when the sources of radiation move",
        "rass-mav experiment moving-sources --out results --drift 0.05 0.5", "ALL_POLICIES",
    )  # fmt: skip
    moving.add_argument(
        "--drift", nargs="+", type=float, metavar="METRES", default=[0.0, 0.05, 0.2, 0.5],
        help="how far each source moves in a step (default: 0 0.05 0.2 0.5)",
    )  # fmt: skip
    _add_names(moving, "--topology", "paper:TOPOLOGIES", "where the drones are, grid by default", default="grid")

    maxima = _add(
        names, "local-maxima", _local_maxima, "how many data are where no neighbour is fitter, away from the base",
        "rass-mav experiment local-maxima --out results",
    )  # fmt: skip
    _add_names(maxima, "--topology", "paper:TOPOLOGIES", "which topologies, all by default", nargs="+")

    policies = _add(
        names, "policies", _policies, "all policies, with and without spare copies or immediate forwarding; ceiling",
        "rass-mav experiment policies --out results --runs 2 --topology grid",
    )  # fmt: skip
    _add_names(policies, "--topology", "policies:PLACES", "which topologies, all by default", nargs="+")
    _add_names(policies, "--variant", "policies:VARIANTS", "which variants, all by default", nargs="+")
    policies.add_argument(
        "--failures", nargs="?", type=float, const=0.1, metavar="FRACTION",
        help="also repeat all runs with this share of the drones dying permanently, 0 to 1 (0.1 without a number)",
    )  # fmt: skip

    ablation = _add(
        names, "ablation", _ablation, "what each part of the defaults is worth, where frames take time and where not",
        "rass-mav experiment ablation --out results --runs 2 --air none", policies=None,
    )  # fmt: skip
    _add_names(ablation, "--air", "ablation:ALL_AIRS", "on which airs (default: none wifi-6m wifi-1m)", nargs="+")
    _add_names(ablation, "--topology", "ablation:PLACES", "which topologies (default: grid random-walk)", nargs="+")
    _add_names(ablation, "--off", "ablation:SWITCHES", "what to switch off, each in runs of its own", nargs="+")

    baselines = _add(
        names, "baselines", _baselines, "our defaults and protocols that others have published, on several airs",
        "rass-mav experiment baselines --out results --runs 2 --place grid --air none", policies=None,
    )  # fmt: skip
    _add_names(baselines, "--air", "airs:AIRS", "on which airs, all by default", nargs="+")
    _add_names(baselines, "--place", "baselines:PLACES", "in which places, all by default", nargs="+")
    _add_names(baselines, "--baseline", "baselines:PROTOCOLS", "which protocols, all by default", nargs="+")
    baselines.add_argument(
        "--own-runs", type=int, metavar="N", help="runs of our defaults (default: as many as of the others)"
    )

    hostile = _add(
        names, "hostile", _hostile, "attackers beside honest nodes: without keys, with keys, with the link key",
        "rass-mav experiment hostile --out results --runs 3",
    )  # fmt: skip
    _add_names(hostile, "--attacker", "hostile:ATTACKERS", "which attackers, all by default", nargs="+")
    _add_names(hostile, "--place", "hostile:PLACES", "where the attacker is, in runs of their own", nargs="+")
    hostile.add_argument(
        "--leaves", type=int, metavar="STEP", help="the attacker is gone from then on (default: never)"
    )

    counting = add_command(
        names, "counting-to-infinity", _counting,
        help="what Alg. 2 as published does when the base vanishes, and what sequence numbers change",
        example="rass-mav experiment counting-to-infinity --out results",
    )  # fmt: skip
    _add_out(counting)
    counting.add_argument("--steps", type=int, default=200, metavar="N", help="(default: 200; the base vanishes at 60)")


def _add_out(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", required=True, metavar="DIR", help="directory for the results")


def _add_names(parser: argparse.ArgumentParser, option: str, known: str, help: str, **more: Any) -> None:
    """Add an option that takes names. `known`: their place in `rass_mav.lab.experiment`, as `module:NAME`."""
    action = parser.add_argument(option, metavar="NAME", help=help, **more)
    lists(action, lambda: resolve_name(f"rass_mav.lab.experiment.{known}"))


def _add(
    names: Subparsers,
    name: str,
    run: Callable[[argparse.Namespace], int],
    help: str,
    example: str,
    policies: str | None = "POLICIES",
) -> argparse.ArgumentParser:
    """Add an experiment that consists of runs of the mock swarm. `policies`: the name of its policies in its module;
    None: there is no choice."""
    parser = add_command(names, name, run, help=help, example=example)
    _add_out(parser)
    parser.add_argument("--runs", type=int, default=30, metavar="N", help="runs of each kind (default: 30)")
    parser.add_argument(
        "--first-seed", type=int, default=0, metavar="SEED", help="of the first run; the next has the next (default: 0)"
    )
    parser.add_argument("--steps", type=int, default=500, metavar="N", help="steps of Alg. 1 per run (default: 500)")
    if policies is not None:
        _add_names(parser, "--policy", f"{name.replace('-', '_')}:{policies}", "which to compare", nargs="+")
    parser.add_argument(
        "--jobs", type=int, default=os.cpu_count() or 1, metavar="N", help="processes at a time (default: one per core)"
    )
    parser.add_argument("--dask", metavar="ADDRESS", help="use the workers of this Dask scheduler instead")
    add_set(parser)
    return parser


def _paper(options: argparse.Namespace) -> int:
    from rass_mav.lab.experiment import paper
    from rass_mav.lab.experiment.published import default_directory, load_published

    given = options.reference_data
    published = load_published(default_directory() if given is None else Path(given))
    worlds = paper.WORLDS if options.world == "both" else (options.world,)
    policies = _chosen("--policy", options.policy or paper.POLICIES, paper.ALL_POLICIES)
    topologies = _chosen("--topology", options.topology, paper.TOPOLOGIES)
    planned = paper.plan(_extent(options), worlds, topologies, policies)
    return _runs(options, planned, lambda results, out: paper.report(results, out, published), "table1.md")


def _five_drones(options: argparse.Namespace) -> int:
    from rass_mav.lab.experiment import five_drones

    planned = five_drones.plan(
        _extent(options), _chosen("--policy", options.policy or five_drones.POLICIES, five_drones.ALL_POLICIES)
    )
    return _runs(options, planned, five_drones.report)


def _moving_sources(options: argparse.Namespace) -> int:
    from rass_mav.lab.experiment import moving_sources, paper

    policies = _chosen("--policy", options.policy or moving_sources.POLICIES, moving_sources.ALL_POLICIES)
    (topology,) = _chosen("--topology", [options.topology], paper.TOPOLOGIES)
    planned = moving_sources.plan(_extent(options), list(dict.fromkeys(options.drift)), topology, policies)
    return _runs(options, planned, moving_sources.report)


def _local_maxima(options: argparse.Namespace) -> int:
    from rass_mav.lab.experiment import local_maxima, paper

    policies = _chosen("--policy", options.policy, local_maxima.POLICIES)
    topologies = _chosen("--topology", options.topology, paper.TOPOLOGIES)
    planned = local_maxima.plan(_extent(options), topologies, policies)
    return _runs(options, planned, local_maxima.report)


def _policies(options: argparse.Namespace) -> int:
    from rass_mav.lab.experiment import policies

    planned = policies.plan(
        _extent(options), _chosen("--topology", options.topology, policies.PLACES),
        _chosen("--policy", options.policy, policies.POLICIES),
        _chosen("--variant", options.variant, policies.VARIANTS), die_fraction=options.failures,
    )  # fmt: skip
    return _runs(options, planned, policies.report)


def _ablation(options: argparse.Namespace) -> int:
    from rass_mav.lab.experiment import ablation

    planned = ablation.plan(
        _extent(options), _chosen("--air", options.air or ablation.USUAL_AIRS, ablation.ALL_AIRS),
        _chosen("--topology", options.topology or ablation.USUAL_PLACES, ablation.PLACES),
        _chosen("--off", options.off, ablation.SWITCHES),
    )  # fmt: skip
    return _runs(options, planned, ablation.report)


def _baselines(options: argparse.Namespace) -> int:
    from rass_mav.lab.baselines import PROTOCOLS
    from rass_mav.lab.experiment import baselines
    from rass_mav.lab.experiment.airs import AIRS

    extent = _extent(options)
    if options.own_runs is not None and options.own_runs < 1:
        raise ConfigError(f"--own-runs: expected 1 or more, got {options.own_runs}")
    planned = baselines.plan(
        extent, _chosen("--place", options.place, baselines.PLACES), _chosen("--air", options.air, AIRS),
        _chosen("--baseline", options.baseline, PROTOCOLS), own_runs=options.own_runs,
    )  # fmt: skip
    return _runs(options, planned, baselines.report)


def _hostile(options: argparse.Namespace) -> int:
    from rass_mav.lab.experiment import hostile

    attackers = _chosen("--attacker", options.attacker, hostile.ATTACKERS)
    policies = _chosen("--policy", options.policy, hostile.POLICIES)
    places = _chosen("--place", options.place, hostile.PLACES)
    planned = hostile.plan(_extent(options), attackers, policies, places, options.leaves)
    return _runs(options, planned, partial(hostile.report, leaves=options.leaves))


def _counting(options: argparse.Namespace) -> int:
    from rass_mav.lab.experiment import counting

    _begin(options)
    if options.steps <= counting.VANISHES:
        raise ConfigError(f"--steps: expected more than {counting.VANISHES}, when the base vanishes")
    out = _directory(options.out)
    _told(options, out, counting.report(out, options.steps), {})
    return 0


def _begin(options: argparse.Namespace) -> None:
    from rass_mav.lab.experiment.figures import need_matplotlib

    start_logging(options.verbose, "critical")
    need_matplotlib()


def _extent(options: argparse.Namespace) -> Extent:
    """How much to run. Raises `ConfigError`."""
    from rass_mav.lab.experiment.runs import Extent

    _begin(options)
    numbers = {name: getattr(options, name) for name in ("runs", "steps", "jobs")}
    if wrong := [f"--{name}: expected 1 or more, got {number}" for name, number in numbers.items() if number < 1]:
        raise ConfigError(*wrong)
    if options.first_seed < 0:
        raise ConfigError(f"--first-seed: expected 0 or more, got {options.first_seed}")
    return Extent(options.runs, options.steps, options.assignments, options.first_seed)


def _runs(
    options: argparse.Namespace,
    planned: Sequence[Run],
    report: Callable[[Sequence[Result], Path], list[Path]],
    table: str = "table.md",
) -> int:
    """Do the runs and report on them. `table`: the file to show."""
    from rass_mav.lab.experiment.runner import run_all

    out = _directory(options.out)
    begin = time.perf_counter()
    runs = out / "runs"

    def tell_outdated(count: int) -> None:
        warn(f"{runs}: other keys or other code gave {count} of the results there: these runs are done again")

    show = partial(progress, unit="runs", quiet=options.json)
    with keeping(
        lambda: f"finished runs: {len(list(runs.glob('*.json')))}, kept in {runs}; the same command continues"
    ):
        outcome = run_all(planned, runs, jobs=options.jobs, dask=options.dask, progress=show, outdated=tell_outdated)
    wall = time.perf_counter() - begin
    counts = {"runs": len(outcome.results), "done": outcome.done, "reused": outcome.reused, "wall_s": round(wall, 3)}
    _told(options, out, report(outcome.results, out), counts, table)
    if not options.json:
        say(f"{outcome.done} runs done in {wall:.0f} s, {outcome.reused} reused from before")
    return 0


def _told(
    options: argparse.Namespace, out: Path, files: Sequence[Path], counts: dict[str, Any], table: str = "table.md"
) -> None:
    """Print what was written, and for people also the `table`."""
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


def _chosen(option: str, given: Sequence[str] | None, known: Collection[str]) -> list[str]:
    """The given names, each once; None: all `known` names. Raises `ConfigError`."""
    names = list(dict.fromkeys(given or known))
    wrong = [f"{option}: expected some of {', '.join(known)}, got {name!r}" for name in names if name not in known]
    if wrong:
        raise ConfigError(*wrong)
    return names

"""`experiment`: runs the paper's experiments and ours, and writes tables and figures to a directory."""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, NamedTuple

from rass_mav.commands.common import (
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
from rass_mav.errors import ConfigError, RassError, os_errors_as

if TYPE_CHECKING:
    from rass_mav.lab.experiment.declaration import Experiment, Extent
    from rass_mav.lab.experiment.runner import Outcome, Run


class Own(NamedTuple):
    """An option of one experiment, and an argument of its `experiment`."""

    option: str
    keys: dict[str, Any]
    """For `add_argument`."""
    known: str = ""
    """Which names there are: their place in `rass_mav.lab.experiment`, as `module:NAME`."""


class Listed(NamedTuple):
    """An experiment of the mock swarm. A module in `rass_mav.lab.experiment` declares it: `experiment`."""

    help: str
    example: str
    """What follows `rass-mav experiment NAME --out results`."""
    choices: dict[str, str]
    """The help of the options that choose levels of its factors."""
    own: tuple[Own, ...] = ()


_POLICIES = {"--policy": "which to compare"}
_TOPOLOGIES = {"--topology": "topologies (default: all)"}
#: By name; that of its module has _ for -.
EXPERIMENTS = {
    "paper": Listed(
        "the paper's simulations: its Table I and its figures", "--runs 2 --topology grid", _POLICIES | _TOPOLOGIES,
        (
            Own("--world", {
                "choices": ("paper", "reference", "both"), "default": "both",
                "help": "paper: the text's rules; reference: what the authors' code did (default: both)",
            }),
            Own("--reference-data", {
                "metavar": "DIR", "help": "folder with the authors' results, curves.csv and delays.csv, which do not "
                "come with this program; without them their column is empty (n/a)",
            }),
        ),
    ),
    "five-drones": Listed("the paper's physical experiment: reliability, in total and by drone", "", _POLICIES),
    "moving-sources": Listed(
        "the fate of data when radiation sources move", "--drift 0.05 0.5", _POLICIES,
        (
            Own("--drift", {
                "nargs": "+", "type": float, "metavar": "METRES", "default": [0.0, 0.05, 0.2, 0.5],
                "help": "distance that each source moves per step (default: 0 0.05 0.2 0.5)",
            }),
            Own("--topology", {
                "metavar": "NAME", "default": "grid", "help": "topology (default: grid)",
            }, "declaration:TOPOLOGIES"),
        ),
    ),
    "local-maxima": Listed(
        "how many data are at nodes, away from the base, that have no fitter neighbour", "", _POLICIES | _TOPOLOGIES
    ),
    "policies": Listed(
        "all policies, with and without replicas or immediate forwarding; ceiling", "--runs 2 --topology grid",
        {**_POLICIES, **_TOPOLOGIES, "--variant": "variants (default: all)"},
        (
            Own("--failures", {
                "nargs": "?", "type": float, "const": 0.1, "metavar": "FRACTION",
                "help": "also repeat all runs with this share of the drones dying permanently, 0 to 1 (0.1 without a "
                "number)",
            }),
        ),
    ),
    "ablation": Listed(
        "the value of each mechanism of the defaults, with and without airtime", "--runs 2 --air none",
        {
            "--air": "media (default: none wifi-6m wifi-1m)",
            "--topology": "topologies (default: grid random-walk)",
            "--off": "mechanisms to switch off, each in separate runs",
        },
    ),
    "baselines": Listed(
        "our defaults against published protocols, on several media", "--runs 2 --place grid --air none",
        {
            "--air": "media (default: all)",
            "--place": "worlds (default: all)",
            "--baseline": "protocols (default: all)",
        },
        (
            Own("--own-runs", {
                "type": int, "metavar": "N", "help": "runs of our defaults (default: as many as of the others)",
            }),
        ),
    ),
    "hostile": Listed(
        "attackers beside honest nodes: without keys, with keys, with the link key", "--runs 3",
        {
            **_POLICIES,
            "--attacker": "attackers (default: all)",
            "--place": "positions of the attacker, each in separate runs",
        },
        (
            Own("--leaves", {
                "type": int, "metavar": "STEP", "help": "step at which the attacker leaves (default: never)",
            }),
        ),
    ),
    "sources": Listed(
        "how well sources are located from the data that arrived, and what is reported where no model fits",
        "--runs 2 --steps 300 --world 1",
        {
            "--world": "numbers of sources, or worlds that do not fit the model (default: all)",
            "--strength": "strengths of the sources (default: all)",
            "--dead": "shares of the drones that fail, in percent (default: all)",
        },
    ),
}  # fmt: skip


def register(subparsers: Subparsers) -> None:
    """Add the command with its experiments."""
    names = add_group(
        subparsers, "experiment", "name", help="run a named experiment: CSV, Markdown tables and PNG figures",
        description="Run a named experiment. Finished runs are kept; the same command continues where it stopped.",
        example="rass-mav experiment paper --out results",
    )  # fmt: skip
    files = "experiments have their own scenarios; to compare policies on yours: documentation, evaluation/simulation"
    subparsers.choices["experiment"].set_defaults(elsewhere=dict.fromkeys((".yaml", ".yml"), files))
    for name, listed in EXPERIMENTS.items():
        _add(names, name, listed)
    counting = add_command(
        names, "counting-to-infinity", _counting,
        help="how the published Alg. 2 behaves when the base vanishes, and what sequence numbers change",
        example="rass-mav experiment counting-to-infinity --out results",
    )  # fmt: skip
    _add_out(counting)
    counting.add_argument(
        "--steps",
        type=int,
        default=200,
        metavar="N",
        help="steps of the run; the base vanishes at step 60 (default: 200)",
    )


def _add(names: Subparsers, name: str, listed: Listed) -> None:
    """Add an experiment that consists of runs of the mock swarm."""
    example = f"rass-mav experiment {name} --out results {listed.example}".rstrip()
    parser = add_command(names, name, _run, help=listed.help, example=example)
    _add_out(parser)
    parser.add_argument("--runs", type=int, default=30, metavar="N", help="runs of each kind (default: 30)")
    parser.add_argument(
        "--first-seed",
        type=int,
        default=0,
        metavar="SEED",
        help="seed of the first run; each further run adds 1 (default: 0)",
    )
    parser.add_argument("--steps", type=int, default=500, metavar="N", help="steps of Alg. 1 per run (default: 500)")
    parser.add_argument(
        "--jobs", type=int, default=os.cpu_count() or 1, metavar="N", help="processes at a time (default: one per core)"
    )
    parser.add_argument("--dask", metavar="ADDRESS", help="use the workers of this Dask scheduler instead")
    add_set(parser)
    for option, help in listed.choices.items():
        action = parser.add_argument(option, metavar="NAME", nargs="+", help=help)
        lists(action, partial(_levels, name, option))
    for own in listed.own:
        action = parser.add_argument(own.option, **own.keys)
        if own.known:
            lists(action, partial(resolve_name, f"rass_mav.lab.experiment.{own.known}"))


def _add_out(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", required=True, metavar="DIR", help="directory for the results")


def _declared(name: str, **own: Any) -> Experiment:
    """`own`: the values of its own options. Raises `ConfigError`."""
    declared: Experiment = resolve_name(f"rass_mav.lab.experiment.{name.replace('-', '_')}:experiment")(**own)
    return declared


def _levels(name: str, option: str) -> Iterable[str]:
    """The names that an option of an experiment takes."""
    try:
        factors = _declared(name).factors
    except ConfigError:
        # The authors' results beside the project are damaged. Help is shown all the same.
        return ()
    return next(factor.levels for factor in factors if factor.option == option)


def argument(option: str) -> str:
    """Its name in Python."""
    return option.removeprefix("--").replace("-", "_")


def _run(options: argparse.Namespace) -> int:
    """Do the runs of an experiment and report on them."""
    from rass_mav.lab.experiment.declaration import choose

    extent = _extent(options)
    given = vars(options)
    own = [argument(each.option) for each in EXPERIMENTS[options.name].own]
    experiment = _declared(options.name, **{name: given[name] for name in own})
    chosen = {
        factor.name: choose(factor.option, given[argument(factor.option)], factor.levels)
        for factor in experiment.factors
        if factor.option
    }
    planned = experiment.plan(extent, chosen)
    out = _directory(options.out)
    outcome, wall = _done(options, [run for _, run in planned], out / "runs")
    files = experiment.report(experiment.groups(planned, outcome.results), out)
    counts = {"runs": len(outcome.results), "done": outcome.done, "reused": outcome.reused, "wall_s": round(wall, 3)}
    _told(options, out, files, counts, f"{experiment.table}.md")
    if not options.json:
        say(f"{outcome.done} runs done in {wall:.0f} s, {outcome.reused} reused")
    return 0


def _done(options: argparse.Namespace, planned: Sequence[Run], runs: Path) -> tuple[Outcome, float]:
    """The results of these runs, of which finished ones are in `runs`, and how long it took, seconds."""
    from rass_mav.lab.experiment.runner import run_all

    def tell_outdated(count: int) -> None:
        warn(f"{runs}: {count} results are from other keys or other code: those runs are repeated")

    begin = time.perf_counter()
    show = partial(progress, unit="runs", quiet=options.json)
    with keeping(
        lambda: f"finished runs: {len(list(runs.glob('*.json')))}, kept in {runs}; repeat the command to continue"
    ):
        outcome = run_all(planned, runs, jobs=options.jobs, dask=options.dask, progress=show, outdated=tell_outdated)
    return outcome, time.perf_counter() - begin


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
    from rass_mav.lab.experiment.declaration import Extent

    _begin(options)
    numbers = {name: getattr(options, name) for name in ("runs", "steps", "jobs")}
    if wrong := [f"--{name}: expected 1 or more, got {number}" for name, number in numbers.items() if number < 1]:
        raise ConfigError(*wrong)
    if options.first_seed < 0:
        raise ConfigError(f"--first-seed: expected 0 or more, got {options.first_seed}")
    return Extent(options.runs, options.steps, options.assignments, options.first_seed)


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

"""`swarm`: runs the mock swarm."""

from __future__ import annotations

import argparse
import contextlib
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from importlib import import_module
from math import inf
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from rass_mav.commands.common import (
    LINE_EVERY_S,
    Subparsers,
    add_command,
    add_set,
    answer,
    keeping,
    lists,
    progress,
    start_logging,
    warn,
)
from rass_mav.errors import ConfigError, RassError
from rass_mav.ground.commands.page import LISTEN

from .runs import kept_files, progress_of_steps, recorder, summary_lines

if TYPE_CHECKING:
    from rass_mav.lab.swarm.scenario import Scenario
    from rass_mav.lab.swarm.world import World

#: A pace of so much of the wanted one counts as that.
_ABOUT = 0.9
_NO_STATUSES = ("paper-", "reference-")


def register(subparsers: Subparsers) -> None:
    """Add the command."""
    parser = add_command(
        subparsers, "swarm", _swarm,
        help="run a mock swarm: real nodes and real MAVLink bytes, over a simulated radio",
        example="rass-mav swarm --nodes 100 --steps 500 --topology grid --seed 1",
    )  # fmt: skip
    scenario = parser.add_argument("scenario", metavar="SCENARIO", nargs="?", help="a YAML file, or one of these")
    lists(scenario, lambda: import_module("rass_mav.lab.swarm.scenario").shipped())
    parser.add_argument("--list", action="store_true", help="list the scenarios that ship with the package")
    parser.add_argument("--nodes", type=int, metavar="N", help="number of nodes, including the base")
    parser.add_argument("--steps", type=int, metavar="N", help="steps of Alg. 1")
    parser.add_argument("--seed", type=int, metavar="N", help="seed of all random choices")
    _add_name(parser, "--policy", "the storage policy")
    _add_name(parser, "--topology", "placement and movement of the nodes")
    parser.add_argument("--range", type=float, metavar="METRES", help="radio range")
    parser.add_argument("--arena", type=float, metavar="METRES", help="side of the arena")
    parser.add_argument("--loss", type=float, metavar="P", help="probability that a receiver loses a frame")
    parser.add_argument("--duplicate", type=float, metavar="P", help="probability that a receiver gets a frame twice")
    parser.add_argument("--reorder", type=float, metavar="P", help="probability that other frames overtake a frame")
    parser.add_argument("--capacity", type=int, metavar="ITEMS", help="data that a drone can hold")
    _add_name(parser, "--transport", "in virtual time, or as processes in real time")
    parser.add_argument("--record", type=Path, metavar="FILE.tlog", help="record every frame put on the air")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="udp: keep configurations, stores and logs in DIR")
    parser.add_argument(
        "--store",
        type=Path,
        metavar="FILE.db",
        help="save what arrives to a store, for report, export and page",
    )
    parser.add_argument(
        "--page", nargs="?", const=LISTEN, metavar="HOST:PORT",
        help=f"serve the mission's page at this address (default: {LISTEN}), until Ctrl-C",
    )  # fmt: skip
    parser.add_argument(
        "--pace", type=float, default=10.0, metavar="X",
        help="with --page: mission seconds per second (default: 10)",
    )  # fmt: skip
    # The command `page` has it.
    parser.set_defaults(elsewhere={"--listen": "--page HOST:PORT"})
    parser.add_argument("--check", action="store_true", help="check all invariants in full after every step")
    add_set(parser)


def _add_name(parser: argparse.ArgumentParser, option: str, help: str) -> None:
    """Add an option that accepts the same names as its key."""

    def names() -> list[str]:
        from rass_mav.config.typed import choices
        from rass_mav.lab.swarm.scenario import OPTION_KEYS, Scenario

        return choices(Scenario, OPTION_KEYS[option.removeprefix("--")])

    lists(parser.add_argument(option, metavar="NAME", help=help), names)


def _scenario(options: argparse.Namespace) -> Scenario:
    from rass_mav.lab.swarm.scenario import OPTION_KEYS, load_scenario

    keys = {key: getattr(options, name) for name, key in OPTION_KEYS.items() if getattr(options, name) is not None}
    name = _name(options)
    if options.page is not None and not name.startswith(_NO_STATUSES):
        # As real drones do. Where the paper's world is simulated they do not.
        keys["data.status_s"] = None
    return load_scenario(name, keys, options.assignments)


def _name(options: argparse.Namespace) -> str:
    """The scenario, as `load_scenario` takes it."""
    from rass_mav.lab.swarm.scenario import DEFAULT, DEFAULT_UDP

    name: str | None = options.scenario
    return name or (DEFAULT_UDP if options.transport == "udp" else DEFAULT)


def _swarm(options: argparse.Namespace) -> int:
    start_logging(options.verbose, "critical")
    if not 0.0 < options.pace < inf:
        raise ConfigError(f"--pace: expected a number above 0, got {options.pace:g}")
    if options.list:
        from rass_mav.lab.swarm.scenario import load_scenario, shipped

        titles = {name: load_scenario(name).title for name in shipped()}
        answer(options, {"scenarios": titles}, (f"{name:22} {title}" for name, title in titles.items()))
        return 0
    scenario = _scenario(options)
    if scenario.transport == "udp":
        summary = _in_real_time(scenario, options)
        answer(options, summary, summary_lines(summary, _unreached(scenario, summary)))
        return 0
    with ExitStack() as stack:
        summary = _in_virtual_time(scenario, options, stack)
        remarks = (_unlike_reality(scenario), _unreached(scenario, summary))
        answer(options, summary, summary_lines(summary, *remarks))
        sys.stdout.flush()
    return 0


def _unlike_reality(scenario: Scenario) -> str | None:
    """Says that radiation destroys data in this world, unless it does so at published doses only
    (docs/evaluation/simulation.md)."""
    from rass_mav.lab.swarm.scenario import RadiationSection

    radiation = scenario.radiation
    if not radiation.corruption or (radiation.law == "dose" and radiation.page_dose >= RadiationSection().page_dose):
        return None
    return "radiation destroys stored data here; doses of survey flights are about a million times too low for that"


def _unreached(scenario: Scenario, summary: dict[str, Any]) -> str | None:
    """Says that no drone can reach a base at the start."""
    if summary["reachable"]:
        return None
    return f"no drone has a route to a base at the start (radio.range_m: {scenario.radio.range_m:g})"


def _in_real_time(scenario: Scenario, options: argparse.Namespace) -> dict[str, Any]:
    from rass_mav.lab.fleet.processes import run
    from rass_mav.lab.swarm.surroundings import Surroundings

    if options.check:
        raise ConfigError("--check needs --transport loopback: processes cannot be checked at the same instant")
    if options.page is not None or options.store is not None:
        raise ConfigError("--page and --store need --transport loopback; --keep keeps the stores of processes")
    reached = _reached(scenario, Surroundings(scenario).graph.neighbours)
    with (
        keeping(lambda: kept_files(options.record, options.keep)),
        progress_of_steps(scenario.steps, quiet=options.json) as show,
    ):
        summary = run(scenario, keep=options.keep, record=options.record, progress=show)
    return {**summary, "reachable": reached}


def _reached(scenario: Scenario, neighbours: Sequence[Sequence[int]]) -> int:
    """How many drones can reach a base at the start. Warns if there are others."""
    from rass_mav.lab.medium.neighbours import reachable

    drones = scenario.nodes - scenario.bases
    reached = reachable(neighbours, scenario.bases)
    if reached < drones:
        warn(
            f"{scenario.nodes} nodes, {reached} can reach a base at the start: {drones - reached} drones cannot "
            f"(topology: {scenario.topology}, radio.range_m: {scenario.radio.range_m:g})"
        )
    return reached


def _in_virtual_time(scenario: Scenario, options: argparse.Namespace, stack: ExitStack) -> dict[str, Any]:
    """`stack`: what may outlive the swarm: its page."""
    from rass_mav.lab.swarm.invariants import check
    from rass_mav.lab.swarm.statistics import Stopwatch
    from rass_mav.lab.swarm.virtual import at_rest
    from rass_mav.lab.swarm.world import World

    with recorder(options.record, scenario.node.step_s) as record:
        world = World(scenario, record=record)
        reached = _reached(scenario, world.neighbours)
        _look_at_load(world)
        after = stack.enter_context(_harvested(world, scenario, options))
        stack.enter_context(at_rest())
        watch = Stopwatch()
        with (
            keeping(lambda: kept_files(options.record)),
            progress(scenario.steps, "steps", quiet=options.json) as advance,
        ):
            for _ in range(scenario.steps):
                world.step()
                if options.check:
                    check(world)
                after()
                advance(1)
        took = watch.figures(scenario.nodes * scenario.steps)
    return {**world.statistics.summary(), "reachable": reached, **took}


def _look_at_load(world: World) -> None:
    """Warns if the drones create less than the scenario's load, although each creates something in each step."""
    load, data, traffic = world.statistics.load, world.scenario.data, world.scenario.traffic
    if load is None or traffic.load is None or load.share >= traffic.load:
        return
    if traffic.picture_bytes:
        interval, most, whole = load.picture_interval_steps, f"picture of {traffic.picture_bytes}", "with measurements "
    else:
        interval, most, whole = load.interval_steps, f"measurement of {data.bytes}", ""
    if interval == 1:
        warn(
            f"traffic.load: {traffic.load:g} is more than a {most} bytes from each drone in each step, which "
            f"{whole}is a load of {load.share:g}"
        )


class Pace:
    """How fast a mission passes for those who watch it. All times are of `time.monotonic`, seconds."""

    def __init__(self, wanted: float, step_s: float, begun: float) -> None:
        """`wanted`: seconds of the mission in a second. `step_s`: the length of a step."""
        self._wanted, self._step_s = wanted, step_s
        self._begun = self._said = begun

    def wait(self, steps: int, now: float) -> float:
        """Seconds until the next step is due, after so many."""
        return max(0.0, self._begun + steps * self._step_s / self._wanted - now)

    def line(self, steps: int, now: float) -> str | None:
        """Every `LINE_EVERY_S`, how fast the mission really is, if it is slower than wanted."""
        if now - self._said < LINE_EVERY_S:
            return None
        self._said = now
        slow = self._real(steps, now) < self._wanted * _ABOUT
        return f"this computer is too slow: {self.closing(steps, now)}" if slow else None

    def closing(self, steps: int, now: float) -> str:
        """How fast it was."""
        took_s, real = now - self._begun, self._real(steps, now)
        passed = f"{steps * self._step_s:.0f} s of the mission took {took_s:.0f} s"
        return f"{passed}: a pace of {real:.1f} instead of {self._wanted:g}"

    def _real(self, steps: int, now: float) -> float:
        return steps * self._step_s / max(now - self._begun, 1e-9)


@contextlib.contextmanager
def _harvested(world: World, scenario: Scenario, options: argparse.Namespace) -> Iterator[Callable[[], None]]:
    """Write what arrives to a store, and show it, if that is wanted. Yields what to call after each step."""
    if options.store is None and options.page is None:
        yield lambda: None
        return
    from rass_mav.lab.fleet.children import orderly_end
    from rass_mav.lab.swarm.harvest import Harvest

    with ExitStack() as stack:
        stack.enter_context(orderly_end())
        path = options.store
        if path is None:
            # The file's name is the mission's on the page.
            path = Path(stack.enter_context(TemporaryDirectory(prefix="rass-mav-"))) / f"{Path(_name(options)).stem}.db"
        # Where nobody watches, the mission ends now; for those who watch it begins.
        began = time.time() - (scenario.steps * world.step_s if options.page is None else 0.0)
        harvest = stack.enter_context(contextlib.closing(Harvest(path, world, scenario.bases, began)))
        harvest.gather()
        if options.page is None:
            yield harvest.gather
            harvest.end()
            return
        page = stack.enter_context(_page(path, options))
        pace = Pace(options.pace, world.step_s, time.monotonic())

        def after() -> None:
            harvest.gather()
            time.sleep(pace.wait(world.t, time.monotonic()))
            if (line := pace.line(world.t, time.monotonic())) is not None:
                sys.stderr.write(line + "\n")

        yield after
        harvest.end()
        sys.stderr.write(pace.closing(world.t, time.monotonic()) + "\n")
        sys.stderr.write("all steps are done; the page stays up until Ctrl-C\n")
        with contextlib.suppress(KeyboardInterrupt):
            page.wait()


@contextlib.contextmanager
def _page(store: Path, options: argparse.Namespace) -> Iterator[subprocess.Popen[str]]:
    """The page of a store, in a process of its own: the swarm needs all of this one."""
    # It ends with this process, even if that is killed: then its stdin is closed.
    command = [sys.executable, "-m", "rass_mav.lab.fleet.tether", "page", str(store), "--listen", options.page]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as page:
        try:
            assert page.stdout is not None
            if not (said := page.stdout.readline()):
                raise RassError("--page: no page was served, for the reason above")
            sys.stderr.write(said)
            yield page
        finally:
            page.terminate()

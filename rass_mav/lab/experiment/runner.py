"""The runs of an experiment: what determines one, how it is done here or on several processes, and its results."""

from __future__ import annotations

import concurrent.futures
import contextlib
import functools
import hashlib
import logging
import multiprocessing
import os
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec

from rass_mav.config.loading import to_plain
from rass_mav.errors import ConfigError, RassError, installing, os_errors_as, why
from rass_mav.lab.baselines import PROTOCOLS
from rass_mav.lab.experiment.measures import MEASURES, Distance, DistanceMeasure, Series, SeriesMeasure, Watcher
from rass_mav.lab.swarm.scenario import Scenario
from rass_mav.lab.swarm.virtual import at_rest
from rass_mav.lab.swarm.world import World

#: Increase it when the form of a run's results changes.
FORMAT = 1

_PACKAGE = Path(__file__).parents[2]
#: What a run's outcome depends on: these packages with their data files, and this package's measuring modules.
_ROOMS = (
    "config", "core", "policy", "wire", "mavlink", "link", "store", "trust", "agent", "station", "app", "lab/swarm",
    "lab/medium", "lab/disk", "lab/hostile", "lab/scenarios", "lab/baselines", "ground/sources",
)  # fmt: skip
_MODULES = tuple(f"lab/experiment/{name}.py" for name in ("located", "measures", "oracle", "runner", "schedule"))


@functools.cache
def code_hash() -> str:
    """SHA-256 over the source files that a run's outcome depends on: with other code it is another run."""
    digest = hashlib.sha256()
    files = [path for room in _ROOMS for path in (_PACKAGE / room).rglob("*") if path.is_file()]
    files += [_PACKAGE / module for module in _MODULES]
    for path in sorted(files):
        if path.suffix != ".pyc":
            digest.update(path.relative_to(_PACKAGE).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


@dataclass(frozen=True)
class Run:
    """One run, in this process or another."""

    world: str
    """The experiment's name for its scenario: `paper`, `reference`, `five-drones`."""
    variant: str
    """Further distinction within its experiment, or empty."""
    scenario: Scenario
    """All keys, including the seed and the policy."""
    measures: tuple[str, ...] = ()
    """Names in `MEASURES`."""
    protocol: str = ""
    """What every node runs, a name in `PROTOCOLS`; empty: what the policy asks for."""
    code: str = ""
    """`code_hash` of the process that requested the run; empty: do not compare."""

    @property
    def policy(self) -> str:
        """The policy's name."""
        return self.scenario.policy.name

    @property
    def key(self) -> str:
        """64 hexadecimal digits for everything that determines the outcome."""
        what = [
            FORMAT, self.world, self.variant, to_plain(self.scenario), list(self.measures), self.protocol, self.code,
        ]  # fmt: skip
        return hashlib.sha256(msgspec.json.encode(what, order="sorted")).hexdigest()

    @property
    def name(self) -> str:
        """For people: what it is in its experiment."""
        parts = (self.world, self.scenario.topology, self.policy, self.variant, str(self.scenario.seed))
        return "_".join(part for part in parts if part)

    @property
    def file_name(self) -> str:
        """Where its outcome is kept: readable, and different for different keys."""
        return f"{self.name}_{self.key[:16]}.json"


class Result(msgspec.Struct):
    """The results of a run: one small JSON file."""

    key: str
    world: str
    topology: str
    policy: str
    variant: str
    seed: int
    steps: int
    summary: dict[str, Any]
    """As `swarm --json` prints it, without wall times."""
    series: Series
    delays: dict[int, int]
    """Steps from creation to first arrival -> how many data."""
    distances: dict[int, Distance]
    """By hops from the base at creation."""
    extra: dict[str, dict[str, Any]]
    """By the name of a measure."""


def execute(run: Run) -> Result:
    """Do a run. Raises `RassError` if the code of this process differs from that of the requesting one."""
    if run.code and run.code != code_hash():
        raise RassError("a worker has another version of rass_mav than this process: install the same one")
    world = World(run.scenario, participant=PROTOCOLS[run.protocol].participant if run.protocol else None)
    series, distances = SeriesMeasure(), DistanceMeasure()
    extra = {name: MEASURES[name]() for name in run.measures}
    watching: list[Watcher] = [series, distances, *extra.values()]

    def after(world: World) -> None:
        for measure in watching:
            measure.after(world)

    with at_rest():
        world.run(run.scenario.steps, after=after)
    return Result(
        run.key, run.world, run.scenario.topology, run.policy, run.variant, run.scenario.seed, run.scenario.steps,
        summary=world.statistics.summary(),
        series=series.series,
        delays=dict(sorted(Counter(world.ledger.delays()).items())),
        distances=distances.result(world),
        extra={name: measure.result() for name, measure in extra.items()},
    )  # fmt: skip


#: Called with the number of runs to do; shows how many are done.
Progress = Callable[[int], AbstractContextManager[Callable[[int], object]]]


#: A draft of this age is abandoned, seconds.
DRAFT_S = 3600.0


@dataclass(frozen=True)
class Outcome:
    """All results of an experiment."""

    results: list[Result]
    """In the order in which the runs were requested."""
    done: int
    """How many were done now."""
    reused: int
    """How many had been done before."""


class FinishedRuns:
    """Finished runs on disk, one JSON file each. A file is complete or missing, whenever the process is killed."""

    def __init__(self, directory: Path) -> None:
        """Creates the directory. Raises `RassError` if that fails."""
        self.directory = directory
        with os_errors_as(RassError, directory):
            directory.mkdir(parents=True, exist_ok=True)
            for draft in directory.glob("*.part"):
                # Writing one takes a moment: its process was killed.
                if time.time() - draft.stat().st_mtime > DRAFT_S:
                    draft.unlink(missing_ok=True)

    def outdated(self, missing: Sequence[Run]) -> int:
        """How many of these missing runs are here with other keys or of other code."""
        there = {path.stem.rpartition("_")[0] for path in self.directory.glob("*.json")}
        return sum(run.name in there for run in missing)

    def find(self, run: Run) -> Result | None:
        """The results of an earlier run; None if it was not finished, or its file cannot be read."""
        path = self.directory / run.file_name
        try:
            result = msgspec.json.decode(path.read_bytes(), type=Result)
        except (FileNotFoundError, msgspec.DecodeError):
            return None
        except OSError as error:
            raise RassError(f"{path}: {why(error)}") from None
        return result if result.key == run.key else None

    def keep(self, run: Run, result: Result) -> None:
        """Store a finished run. Raises `RassError` if it cannot be written."""
        path = self.directory / run.file_name
        # The same call may run twice at a time: each writes its own file, and both rename the same content.
        draft = path.with_suffix(f".{os.getpid()}.part")
        with os_errors_as(RassError, path):
            try:
                draft.write_bytes(msgspec.json.encode(result) + b"\n")
                draft.replace(path)
            finally:
                draft.unlink(missing_ok=True)


def run_all(
    runs: Sequence[Run],
    directory: Path,
    *,
    jobs: int = 1,
    dask: str | None = None,
    progress: Progress | None = None,
    outdated: Callable[[int], object] | None = None,
) -> Outcome:
    """Do those of `runs` that are not in `directory` yet.

    `jobs`: processes at a time, at least 1. `dask`: address of a Dask scheduler to use instead. `outdated` is called at
    the beginning with the number of results that are there, but are of other keys or other code. After an interruption
    the same call continues where it stopped; at most `jobs` unfinished runs are done again. Raises `RassError` if a run
    or a worker fails; finished runs stay.
    """
    archive = FinishedRuns(directory)
    code = code_hash()
    runs = [replace(run, code=code) for run in runs]
    found = {run.file_name: archive.find(run) for run in runs}
    waiting = list({run.file_name: run for run in runs if found[run.file_name] is None}.values())
    if outdated is not None and (old := archive.outdated(waiting)):
        outdated(old)
    show = progress or _silent
    # Closed at once when the user interrupts while a result is being written: workers then end.
    with show(len(waiting)) as advance, contextlib.closing(_execute_all(waiting, jobs, dask)) as finished:
        for run, result in finished:
            archive.keep(run, result)
            found[run.file_name] = result
            advance(1)
    results = [kept for run in runs if (kept := found[run.file_name]) is not None]
    return Outcome(results, len(waiting), len(found) - len(waiting))


@contextlib.contextmanager
def _silent(total: int) -> Iterator[Callable[[int], object]]:
    yield lambda done: None


def _execute_all(runs: Sequence[Run], jobs: int, dask: str | None) -> Generator[tuple[Run, Result], None, None]:
    """Each run with its result, as they get finished."""
    if dask is None and (jobs == 1 or len(runs) < 2):
        for run in runs:
            yield run, execute(run)
        return
    executor = _processes(min(jobs, len(runs))) if dask is None else _cluster(dask)
    with executor as pool:
        futures = {pool.submit(execute, run): run for run in runs}
        try:
            for future in concurrent.futures.as_completed(futures):
                yield futures[future], future.result()
        except BrokenProcessPool:
            raise RassError("a worker process died; finished runs are kept; repeat the command to continue") from None


@contextlib.contextmanager
def _processes(count: int) -> Iterator[concurrent.futures.Executor]:
    """Processes that are started from scratch (spawn): the same on every system, and nothing is inherited by
    accident."""
    context = multiprocessing.get_context("spawn")
    level = logging.getLogger().getEffectiveLevel()
    others = set(multiprocessing.active_children())
    with concurrent.futures.ProcessPoolExecutor(
        count, mp_context=context, initializer=_prepare_worker, initargs=(level,)
    ) as pool:
        try:
            yield pool
        except BaseException:
            # Runs that have begun are given up. The pool finds its workers gone and drops the rest; cancelling that
            # first would make the pool's own thread fail (Python 3.10 and 3.11).
            for child in set(multiprocessing.active_children()) - others:
                child.terminate()
            raise


def _prepare_worker(log_level: int) -> None:
    """A worker ends at once on Ctrl-C, without a traceback, and does not outlive a parent that was killed."""
    logging.basicConfig(level=log_level)
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    parent = multiprocessing.parent_process()

    def follow() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


@contextlib.contextmanager
def _cluster(address: str) -> Iterator[concurrent.futures.Executor]:
    """The workers of a Dask cluster; they need the same rass_mav. Raises `ConfigError`."""
    try:
        from distributed import Client
    except ImportError:
        raise ConfigError(f"--dask needs the package distributed: {installing('dask')}") from None
    try:
        client = Client(address, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ConfigError(f"--dask {address}: {error}") from None
    with client:
        pool = client.get_executor(pure=False)
        try:
            yield pool
        finally:
            # Does not wait: either all runs are done, or the others are given up.
            pool.shutdown(wait=False)

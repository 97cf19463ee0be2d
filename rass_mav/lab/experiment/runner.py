"""Does the runs of an experiment, on several processes or a cluster, and stores each finished one."""

from __future__ import annotations

import concurrent.futures
import contextlib
import logging
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec

from rass_mav.errors import ConfigError, RassError, installing, os_errors_as, why
from rass_mav.lab.experiment.runs import Result, Run, code_hash, execute

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
            raise RassError("a worker process died; finished runs are kept, the same command continues") from None


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
        raise ConfigError(f"--dask needs the package distributed: {installing('dask')} (make install has it)") from None
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

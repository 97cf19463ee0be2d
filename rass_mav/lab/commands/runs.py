"""Shared by the commands that run swarms: recordings, progress, and what is kept of an interrupted run."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path

from rass_mav.commands.common import progress
from rass_mav.errors import RassError, os_errors_as

#: The start of virtual time in recordings, 2020-01-01 00:00 UTC, so that the same run creates the same file.
VIRTUAL_START_S = 1_577_836_800.0


@contextlib.contextmanager
def recorder(
    path: Path | None, step_s: float, start_s: float = VIRTUAL_START_S
) -> Iterator[Callable[[bytes, int], None] | None]:
    """Write frames to a .tlog, with times from `start_s`, seconds since 1970."""
    if path is None:
        yield None
        return
    from rass_mav.lab.medium.tlog import TlogWriter

    with os_errors_as(RassError, path), path.open("wb") as file:
        writer = TlogWriter(file)
        yield lambda frame, step: writer.record(frame, start_s + step * step_s)


@contextlib.contextmanager
def progress_of_steps(steps: int, *, quiet: bool) -> Iterator[Callable[[int], None]]:
    """The same for a swarm in real time, which reports the number of finished steps."""
    done = 0
    with progress(steps, "steps", quiet=quiet) as advance:

        def reached(step: int) -> None:
            nonlocal done
            advance(step - done)
            done = step

        yield reached


def kept_files(record: Path | None, keep: Path | None = None) -> str:
    """What is kept of an interrupted run: `record`: a file of frames; `keep`: a directory."""
    parts = [f"the frames so far are in {record}"] if record is not None else []
    if keep is not None:
        parts.append(f"configurations, stores and logs so far are in {keep}")
    return "; ".join(parts) or "nothing is kept"

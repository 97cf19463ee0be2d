"""The estimate in a process of its own, so that it delays nobody and uses one core.

`python -m rass_mav.ground.sources.locator` reads a line of JSON with readings, writes a line of JSON with the estimate
and the processor time that it took, and so on until its standard input is closed.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from importlib.util import find_spec
from typing import Any

from rass_mav.errors import RassError, installing, why

from .readings import Sample, Samples

#: An estimate that takes longer is given up, seconds.
MOST_S = 120.0
#: How much lower its priority is than that of the program that starts it.
_NICE = 10


class SourcesError(RassError):
    """There is no estimate."""


def check_package() -> None:
    """Raises `SourcesError` if numpy is not installed."""
    if find_spec("numpy") is None:
        raise SourcesError(f"needs the Python package numpy: {installing('ground')}")


def estimate_of(samples: Samples) -> dict[str, Any]:
    """One estimate as plain values for JSON. Raises `SourcesError`."""
    locator = Locator()
    try:
        return locator.ask(*samples.main)[0]
    finally:
        locator.close()


def located(samples: Samples) -> dict[str, Any] | None:
    """The same for a report; None: there are no readings, or numpy is not installed."""
    try:
        return estimate_of(samples) if samples.main[1] else None
    except SourcesError:
        return None


class Locator:
    """A process that is asked for estimates, and started when it is needed. One thread at a time asks."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._lock = threading.Lock()
        self._asking = threading.Lock()
        self._closed = False

    @property
    def pid(self) -> int | None:
        """Of the process; None: it does not run."""
        return None if self._process is None else self._process.pid

    def ask(self, unit: str, samples: Sequence[Sample]) -> tuple[dict[str, Any], float]:
        """The estimate as plain values for JSON, and the processor time that it took, seconds. Raises `SourcesError` if
        the process cannot be started or has ended; the next call starts it again."""
        check_package()
        with self._asking:
            return self._answer(self._running(), unit, samples)

    def _answer(
        self, process: subprocess.Popen[bytes], unit: str, samples: Sequence[Sample]
    ) -> tuple[dict[str, Any], float]:
        assert process.stdin is not None
        assert process.stdout is not None
        late = threading.Timer(MOST_S, process.kill)
        late.start()
        line = b""
        try:
            process.stdin.write(json.dumps([unit, samples], allow_nan=False).encode() + b"\n")
            process.stdin.flush()
            line = process.stdout.readline()
        except OSError:
            pass  # it has ended
        finally:
            late.cancel()
        if not line.endswith(b"\n"):
            self._end()
            raise SourcesError("the process that locates sources has ended; it is started again")
        found, spent = json.loads(line)
        return found, spent

    def close(self) -> None:
        """End the process, whatever it does; whoever has asked gets an error."""
        with self._lock:
            self._closed = True
            if self._process is not None:
                self._process.kill()
        with self._asking:
            self._end()

    def _running(self) -> subprocess.Popen[bytes]:
        with self._lock:
            if self._closed:
                raise SourcesError("it is closed")
            if self._process is None:
                isolated = ["-I"] if sys.flags.isolated else []
                try:
                    # One thread: the others of the computer are the node's. Ctrl-C is for the program that asks.
                    self._process = subprocess.Popen(
                        [sys.executable, *isolated, "-m", "rass_mav.ground.sources.locator"],
                        stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True,
                        env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
                    )  # fmt: skip
                except OSError as error:
                    raise SourcesError(f"cannot start the process that locates sources: {why(error)}") from None
            return self._process

    def _end(self) -> None:
        with self._lock:
            process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.wait()
            for pipe in (process.stdin, process.stdout):
                assert pipe is not None
                with contextlib.suppress(OSError):
                    pipe.close()


def main() -> int:
    """Answer until standard input ends."""
    from .estimate import estimate

    with contextlib.suppress(OSError):
        os.nice(_NICE)
    for line in sys.stdin.buffer:
        begun = time.process_time()
        unit, samples = json.loads(line)
        found = estimate(unit, [Sample(*sample) for sample in samples])
        answer = found.plain(), time.process_time() - begun
        try:
            sys.stdout.buffer.write(json.dumps(answer, allow_nan=False).encode() + b"\n")
            sys.stdout.buffer.flush()
        except BrokenPipeError:
            return 0
    return 0


if __name__ == "__main__":
    sys.exit(main())

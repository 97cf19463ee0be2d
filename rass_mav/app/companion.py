"""The process that runs beside a base, seen from the node: it is started, listened to, and started again if it ends.

What it does can be slow, or hang: commands of others, a database. In a process of its own that costs the node nothing.
It reads the base's store like any other program. It gets the configuration on its standard input, and ends when that is
closed: so it never outlives its node for long, however that ends. What it reports comes back as JSON lines.
"""

from __future__ import annotations

import contextlib
import json
import logging
import subprocess
import sys
import threading
from importlib.util import find_spec
from typing import IO, Any

from rass_mav.config.loading import to_plain
from rass_mav.errors import ConfigError, MalformedError, installing, why

from .config import RunConfig, filled_in
from .jsonlines import load_line
from .outlets import NEEDS

log = logging.getLogger(__name__)

#: Seconds until a process that has ended is started again: at first, and at most.
AGAIN_S = 1.0
MOST_AGAIN_S = 60.0


class Companion:
    """Keeps the process running from `start` to `stop`, on a thread that only waits for it."""

    def __init__(self, config: RunConfig) -> None:
        """Raises `ConfigError` if a package or a token is missing for what the configuration says."""
        for name in NEEDS.keys() & set(config.outlets):
            module, extra = NEEDS[name]
            if find_spec(module) is None:
                raise ConfigError(f"{name}: needs the Python package {module}: {installing(extra)}")
        if config.page is not None:
            config.page.token()
        self._config = filled_in(config)
        self._thread = threading.Thread(target=self._supervise, name="companion", daemon=True)
        self._stopping = threading.Event()
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._reported: dict[str, Any] = {}
        self._ends = 0

    def start(self) -> None:
        """Start the process. Does nothing if it was started before."""
        if self._thread.ident is None:
            self._thread.start()

    def stop(self) -> None:
        """Let the process end, and wait for that: until the command that it runs has ended, or its time is over."""
        self._stopping.set()
        with self._lock:
            if self._process is not None:
                _close(self._process.stdin)
        if self._thread.ident is not None:
            self._thread.join()

    def report(self) -> dict[str, Any]:
        """For `status`: whether the process runs, how often it has ended, and what it last said."""
        process = self._process
        return {"pid": None if process is None else process.pid, "ends": self._ends, **self._reported}

    def _supervise(self) -> None:
        again_s = AGAIN_S
        while not self._stopping.is_set():
            try:
                heard = self._one_life()
            except OSError as error:
                log.error("cannot start the output process: %s", why(error))
                heard = False
            if self._stopping.is_set():
                return
            again_s = AGAIN_S if heard else min(2 * again_s, MOST_AGAIN_S)
            self._ends += 1
            log.error("the output process has ended; restarting it in %.0f s", again_s)
            self._stopping.wait(again_s)

    def _one_life(self) -> bool:
        """Run the process to its end. Returns whether it reported anything."""
        isolated = ["-I"] if sys.flags.isolated else []
        order = {"config": to_plain(self._config), "log": logging.getLogger().getEffectiveLevel()}
        heard = False
        with self._lock:
            if self._stopping.is_set():
                return heard
            # Ctrl-C on the terminal is for the node alone.
            process = self._process = subprocess.Popen(
                [sys.executable, *isolated, "-m", "rass_mav.ground.outputs.process"],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True,
            )  # fmt: skip
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            process.stdin.write(json.dumps(order).encode() + b"\n")
            process.stdin.flush()
            for line in process.stdout:
                self._reported = load_line(line)
                heard = True
        except (BrokenPipeError, ValueError, MalformedError):
            pass  # it has ended in the middle of something, or was told to end
        process.wait()
        with self._lock:
            self._process, self._reported = None, {}
            _close(process.stdin)
            process.stdout.close()
        return heard


def _close(pipe: IO[bytes] | None) -> None:
    """Close a pipe, whoever is at its other end."""
    assert pipe is not None
    with contextlib.suppress(BrokenPipeError):
        pipe.close()

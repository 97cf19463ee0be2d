"""Child processes that never outlive the block they were started in, and whose unexpected end is an error; and the
directories that a swarm of them needs."""

from __future__ import annotations

import contextlib
import itertools
import selectors
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Protocol

from rass_mav.errors import ConfigError, SwarmError, os_errors_as

#: How long a process may take to end after SIGTERM, seconds.
STOP_S = 20.0
# The time that a process which has closed its pipes gets to end, seconds.
_LAST_BREATH_S = 2.0
# How much of a dead child's stderr is reported: characters, and lines.
_TAIL_CHARACTERS = 4000
_TAIL_LINES = 5


class Child:
    """A child process. Its stdin is a pipe that closes when we end; its stderr is a file."""

    def __init__(self, name: str, arguments: list[str], log: Path) -> None:
        """`name`: for errors. `arguments`: of the Python interpreter. `log`: stderr is appended to it."""
        self.name = name
        self.log = log
        with log.open("ab") as stderr:
            # A session of its own: Ctrl-C on a terminal reaches the parent only, which ends the others in order.
            self._process = subprocess.Popen(
                [sys.executable, *arguments], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=stderr,
                bufsize=0, start_new_session=True,
            )  # fmt: skip
        self._lines: list[bytes] = []
        self._rest = b""

    @property
    def file(self) -> int:
        """File descriptor of its stdout."""
        assert self._process.stdout is not None
        return self._process.stdout.fileno()

    def tell(self, line: str) -> None:
        """Write a line to its stdin. Raises `SwarmError` if it is gone."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(line.encode("ascii") + b"\n")
        except BrokenPipeError:
            raise self.failed() from None

    def read(self) -> None:
        """Read what it has written on stdout; call it when there is something. Raises `SwarmError`: it has ended."""
        assert self._process.stdout is not None
        data = self._process.stdout.read(65536)
        if not data:
            raise self.failed()
        *lines, self._rest = (self._rest + data).split(b"\n")
        self._lines += lines

    def next_line(self) -> bytes | None:
        """The next complete line that was read, or None."""
        return self._lines.pop(0) if self._lines else None

    def wait_line(self, timeout_s: float) -> bytes:
        """Wait for the next line. Raises `SwarmError`: it has ended, or sends nothing."""
        until = time.monotonic() + timeout_s
        with selectors.DefaultSelector() as selector:
            selector.register(self.file, selectors.EVENT_READ)
            while True:
                line = self.next_line()
                if line is not None:
                    return line
                left = until - time.monotonic()
                if left <= 0:
                    raise SwarmError(f"{self.name}: sent nothing for {timeout_s:g} s{self._tail()}")
                if selector.select(left):
                    self.read()

    def kill(self) -> None:
        """SIGKILL, and wait until it is gone. Does no harm to a process that has ended."""
        self._process.kill()
        self._process.wait()
        self._close()

    def terminate(self) -> None:
        """SIGTERM; see `wait_stopped`."""
        self._process.terminate()

    def wait_stopped(self, timeout_s: float = STOP_S) -> None:
        """Wait until it has ended. Raises `SwarmError`: it does not, or it failed."""
        try:
            code = self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            raise SwarmError(f"{self.name}: did not end within {timeout_s:g} s of SIGTERM{self._tail()}") from None
        self._close()
        if code:
            raise self.failed()

    def failed(self, otherwise: str = "closed its output") -> SwarmError:
        """The error that describes how it ended, with the last lines of its stderr; `otherwise`, if it has not."""
        try:
            code = self._process.wait(_LAST_BREATH_S)
        except subprocess.TimeoutExpired:
            return SwarmError(f"{self.name}: {otherwise}{self._tail()}")
        try:
            how = f"killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        except ValueError:
            how = f"killed by signal {-code}"
        return SwarmError(f"{self.name}: {how}{self._tail()}")

    def note(self, line: str) -> None:
        """Add a line to its log: what it has said in another way than on stderr."""
        with self.log.open("a", encoding="utf-8") as log:
            log.write(f"{line}\n")

    def _tail(self) -> str:
        text = self.log.read_bytes()[-_TAIL_CHARACTERS:].decode(errors="replace")
        said = [line.strip() for line in text.splitlines() if line.strip()]
        # A line that is repeated many times counts once.
        lines = [line for line, _ in itertools.groupby(said)][-_TAIL_LINES:]
        return ": " + " | ".join(lines) if lines else ""

    def _close(self) -> None:
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            pipe.close()


class Readable(Protocol):
    """What the system can wait for: a socket, for example."""

    def fileno(self) -> int:
        """Its file descriptor."""


class Children:
    """All child processes of a swarm. Leaving the block kills those that are left."""

    def __init__(self) -> None:
        self._all: dict[Child, Callable[[], None]] = {}
        self._watched: dict[Readable, Callable[[], object]] = {}

    def start(self, name: str, arguments: list[str], log: Path, heard: Callable[[], None] | None = None) -> Child:
        """See `Child`. `heard`: what `wait` calls when there is something on its stdout; None: its `read`."""
        child = Child(name, arguments, log)
        self._all[child] = heard or child.read
        return child

    def watch(self, file: Readable, ready: Callable[[], object]) -> None:
        """Let `wait` call `ready` when there is something to read from `file`, too."""
        self._watched[file] = ready

    def kill(self, child: Child) -> None:
        """SIGKILL for one."""
        child.kill()
        del self._all[child]

    def wait(self, until: float) -> None:
        """Until a time of `time.monotonic`, or until one of them writes something. Raises `SwarmError` if one ended."""
        with selectors.DefaultSelector() as selector:
            for child, heard in self._all.items():
                selector.register(child.file, selectors.EVENT_READ, heard)
            for file, ready in self._watched.items():
                selector.register(file, selectors.EVENT_READ, ready)
            for key, _ in selector.select(max(until - time.monotonic(), 0.0)):
                key.data()

    def wait_for(
        self, missing: Callable[[], list[str]], within_s: float, tick: Callable[[float], float] | None = None
    ) -> None:
        """Wait until nothing is `missing`. Raises `SwarmError` that names what still is.

        `tick` is called meanwhile with the present time of `time.monotonic`; it returns when to call it again.
        """
        deadline = time.monotonic() + within_s
        while names := missing():
            now = time.monotonic()
            if now > deadline:
                raise SwarmError(f"{', '.join(names)}: not ready within {within_s:g} s")
            self.wait(deadline if tick is None else min(deadline, tick(now)))

    def __enter__(self) -> Children:
        return self

    def __exit__(self, *raised: object) -> None:
        for child in self._all:
            child.kill()


@contextlib.contextmanager
def orderly_end() -> Iterator[None]:
    """Within the block, SIGTERM raises SystemExit, so that what has been started is also ended. Main thread only."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, _leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _leave(number: int, frame: FrameType | None) -> None:
    raise SystemExit(128 + number)


@contextlib.contextmanager
def workplace(keep: Path | None) -> Iterator[tuple[Path, Path, Children]]:
    """The directory for files, the one for control sockets, and the children.

    `keep`: a directory, new or empty; None: a temporary one. Raises `ConfigError`: it cannot be used.
    """
    if keep is not None:
        _prepare(keep)
    with contextlib.ExitStack() as stack:
        stack.enter_context(orderly_end())
        # Always a short path: that of a Unix socket may have at most 107 bytes.
        sockets = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="rass-")))
        children = stack.enter_context(Children())
        yield (keep or sockets).absolute(), sockets, children


def _prepare(directory: Path) -> None:
    with os_errors_as(ConfigError, directory):
        directory.mkdir(parents=True, exist_ok=True)
        used = any(directory.iterdir())
    if used:
        raise ConfigError(f"{directory}: expected a new or empty directory")

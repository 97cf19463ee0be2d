"""What holds for all tests."""

from __future__ import annotations

import asyncio
import gc
import inspect
import logging
import os
import signal
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from coverage import Coverage
from hypothesis import settings

from rass_mav.mavlink.dialect import common

from .app.app_nodes import RunningNode, Tidy
from .extent import EXAMPLES, SOAK_EXAMPLES
from .patience import PATIENCE_S
from .skips import pytest_make_collect_report as pytest_make_collect_report
from .skips import pytest_runtest_makereport as pytest_runtest_makereport
from .virtual import VirtualLoop, VirtualTime

#: The tests that take longest, by `--durations`; the first one takes longest.
DEAREST = Path(__file__).with_name("dearest.txt")

#: Through this variable coverage measures what a process starts.
_MEASURES = "COVERAGE_PROCESS_CONFIG"
_COVERAGE = pytest.StashKey[str | None]()

# How long an example takes says something about the machine and its load, not about the code.
settings.register_profile("suite", deadline=None, max_examples=EXAMPLES)
settings.register_profile("soak", deadline=None, max_examples=SOAK_EXAMPLES)
settings.load_profile("suite")


def pytest_configure(config: pytest.Config) -> None:
    """Put right what this process has inherited."""
    # A shell starts what it runs in the background without Ctrl-C, and children of ours would be without it too.
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    # pytest-cov measures an xdist worker from the start of its session. The measurement that a worker inherits as a
    # subprocess would take as long again, and would continue in tests with `no_cover`.
    if hasattr(config, "workerinput"):
        while (measurement := Coverage.current()) is not None:
            measurement.stop()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """What takes longest begins first, so that no long test is left when all others are done."""
    place = {name: number for number, name in enumerate(DEAREST.read_text(encoding="utf-8").split())}
    items.sort(key=lambda item: place.get(item.nodeid.partition("[")[0], len(place)))


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """A test that is a coroutine has an event loop of its own. What hangs is cut off."""
    if not inspect.iscoroutinefunction(pyfuncitem.obj):
        return None
    test = pyfuncitem.obj(**{name: pyfuncitem.funcargs[name] for name in inspect.signature(pyfuncitem.obj).parameters})

    async def limited() -> None:
        await asyncio.wait_for(test, PATIENCE_S)

    asyncio.run(limited())
    return True


def pytest_collection_finish() -> None:
    """Take what all tests share out of what each garbage collection looks through."""
    gc.collect()
    gc.freeze()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Coverage makes a process twice as slow: those that a test starts are measured only where it asks for that."""
    # Each time that a measurement goes on, coverage sets the variable again.
    coverage = item.config.stash[_COVERAGE] = os.environ.pop(_MEASURES, None) or item.config.stash.get(_COVERAGE, None)
    if coverage is not None and item.get_closest_marker("processes_measured") is not None:
        os.environ[_MEASURES] = coverage


@pytest.fixture(autouse=True)
def _logging_as_it_was() -> Iterator[None]:
    """Commands set up logging for their whole process. Here many of them share one."""
    root = logging.getLogger()
    level, handlers = root.level, root.handlers[:]
    yield
    root.setLevel(level)
    root.handlers[:] = handlers


_TEXTS = dict(common.enums)


@pytest.fixture(autouse=True)
def _dialect_as_it_was() -> Iterator[None]:
    """A node's command frees the dialect's texts, as if it had its process for itself."""
    yield
    if not common.enums:
        common.enums.update(_TEXTS)


@pytest.fixture
def virtual(monkeypatch: pytest.MonkeyPatch) -> VirtualTime:
    """For what waits while no other process takes part: it takes no time."""
    time = VirtualTime()
    monkeypatch.setattr("asyncio.events.new_event_loop", lambda: VirtualLoop(time))
    return time


@pytest.fixture
def tidy() -> Iterator[Tidy]:
    """Ends real nodes that a failing test has left running."""
    with ExitStack() as stack:

        def remember(node: RunningNode) -> RunningNode:
            stack.callback(node.end)
            return node

        yield remember

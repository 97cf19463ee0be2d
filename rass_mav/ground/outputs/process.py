"""`python -m rass_mav.ground.outputs.process`: a base's output process (`rass_mav.app.companion` starts it). It does
what the configuration says until its standard input is closed.

Each task runs on a thread of its own. What they report goes to the node, on standard output, as JSON lines.
"""

from __future__ import annotations

import contextlib
import logging
import select
import sys
import threading
from collections.abc import Callable
from typing import Any

from rass_mav.app.config import RunConfig
from rass_mav.app.jsonlines import dump_line, load_line
from rass_mav.commands.common import start_logging
from rass_mav.config.typed import build
from rass_mav.ground.archive import opener_of_node, title_of
from rass_mav.ground.attention.rules import RuleBook

from .task import Task

#: Seconds between two reports, at least.
REPORT_S = 0.5


def tasks_of(config: RunConfig) -> list[Task]:
    """What there is to do. Raises `KeysError`."""
    tasks: list[Task] = []
    opens = opener_of_node(config)
    if config.on_arrival is not None:
        from .hook_runner import HookRunner

        tasks.append(HookRunner(config.on_arrival, config.store_path, opens))
    if config.page is not None:
        from .site import Site

        rules, title = RuleBook.of(config), title_of(config)
        tasks.append(Site(config.page, config.socket_path, config.store_path, opens, rules, title))
    if config.metrics is not None:
        from .metrics import Metrics

        tasks.append(Metrics(config.metrics, config.socket_path, config.store_path, opens, RuleBook.of(config)))
    if config.postgres is not None:
        from .database_writer import DatabaseWriter

        tasks.append(DatabaseWriter(config.postgres, config.store_path, config.node_id, opens))
    if config.cot is not None:
        from .cot_sender import CotSender

        tasks.append(CotSender(config.cot, config.store_path, config.node_id, opens, RuleBook.of(config)))
    return tasks


def work(config: RunConfig) -> int:
    """Work until standard input ends. Returns the exit code: 1 if a task has hit a fault."""
    tasks = tasks_of(config)
    stopping = threading.Event()
    faults: list[threading.ExceptHookArgs] = []
    threading.excepthook = _excepthook(faults)
    threads = [threading.Thread(target=task.run, args=(stopping,), name=task.name, daemon=True) for task in tasks]
    for thread in threads:
        thread.start()
    said = b""
    while not faults:
        said = _say({task.name: task.report() for task in tasks}, said)
        if select.select([sys.stdin], [], [], REPORT_S)[0]:
            break  # the node says nothing more: it has closed the pipe, or is gone
    stopping.set()
    for thread, task in zip(threads, tasks, strict=True):
        thread.join(task.last_s)
    return 1 if faults else 0


def _excepthook(faults: list[threading.ExceptHookArgs]) -> Callable[[threading.ExceptHookArgs], None]:
    """A fault of one task ends the process: the node starts it again."""
    usual = threading.excepthook

    def note(fault: threading.ExceptHookArgs) -> None:
        usual(fault)
        faults.append(fault)

    return note


def _say(report: dict[str, Any], before: bytes) -> bytes:
    """Report to the node what has changed."""
    line = dump_line(report)
    if line != before:
        # If the node is gone, its end of standard input is closed too.
        with contextlib.suppress(BrokenPipeError):
            sys.stdout.buffer.write(line)
            sys.stdout.buffer.flush()
    return line


def main() -> int:
    """The first line of standard input is a JSON object: the configuration, and the level of the log."""
    order = load_line(sys.stdin.buffer.readline())
    start_logging(0, logging.getLevelName(order["log"]))
    return work(build(order["config"], RunConfig))


if __name__ == "__main__":
    sys.exit(main())

"""The process beside a base, for tests: of a real base, or one of its tasks alone."""

from __future__ import annotations

from collections.abc import Callable
from threading import Event
from typing import Any

from tests.app.app_nodes import RunningNode


class Until(Event):
    """An event that is set when something is so."""

    def __init__(self, condition: Callable[[], bool]) -> None:
        super().__init__()
        self._condition = condition

    def is_set(self) -> bool:
        if self._condition():
            self.set()
        return super().is_set()

    def wait(self, timeout: float | None = None) -> bool:
        return self.is_set()


def report(node: RunningNode, task: str) -> dict[str, Any]:
    """What a task says of itself in `status`; empty: it has not said anything yet."""
    found: dict[str, Any] = node.status()["outputs"].get(task, {})
    return found


def served(node: RunningNode, task: str) -> str:
    """Where a base serves its page (`page`) or its figures (`metrics`)."""
    key = {"page": "url", "metrics": "listen"}[task]
    node.until(lambda: report(node, task).get(key) is not None)
    return str(report(node, task)[key])

"""Real nodes that no test leaves behind."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest

from tests.app.app_nodes import RunningNode

#: Takes a node, and ends it after the test.
Tidy = Callable[[RunningNode], RunningNode]


@pytest.fixture
def tidy() -> Iterator[Tidy]:
    with ExitStack() as stack:

        def remember(node: RunningNode) -> RunningNode:
            stack.callback(node.end)
            return node

        yield remember

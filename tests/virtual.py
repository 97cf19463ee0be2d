"""An event loop on virtual time: where nothing is left to do, it is as late as what is due next.

Sockets are real: what is sent to one on this computer is there at once. Other processes and threads take real time, and
so do pseudo-terminals: this is not for them.
"""

from __future__ import annotations

import asyncio
import selectors
from asyncio.futures import Future
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

#: How long a turn of the loop takes, seconds.
TURN_S = 1e-6
#: What is due at a time, seconds, it does; it returns when something is due again.
Participant = Callable[[float], float]


class VirtualTime:
    """The time of all that takes part."""

    def __init__(self) -> None:
        self.now = 0.0
        self.participants: list[Participant] = []

    @contextmanager
    def with_participant(self, participant: Participant) -> Iterator[None]:
        self.participants.append(participant)
        yield
        self.participants.remove(participant)


class VirtualLoop(asyncio.SelectorEventLoop):
    """What would run in an executor runs at once, and raises at once what it raises."""

    def __init__(self, virtual: VirtualTime) -> None:
        super().__init__(_Jumps(virtual))
        self._virtual = virtual

    def time(self) -> float:
        return self._virtual.now

    def run_in_executor(self, executor: Any, func: Callable[..., Any], *args: Any) -> Any:  # type: ignore[override]
        future: Future[Any] = self.create_future()
        future.set_result(func(*args))
        return future


class _Jumps(selectors.DefaultSelector):
    def __init__(self, virtual: VirtualTime) -> None:
        super().__init__()
        self._virtual = virtual

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        virtual = self._virtual
        virtual.now += TURN_S
        due = [participant(virtual.now) for participant in virtual.participants]
        ready = super().select(0)
        if not ready and timeout != 0:
            if timeout is not None:
                due.append(virtual.now + timeout)
            virtual.now = min(due)
        return ready

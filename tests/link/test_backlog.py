"""A link without a budget: chunks give way to all else, and cost the interface no time."""

from __future__ import annotations

import pytest

from rass_mav.core.messages import BROADCAST, Urgency
from rass_mav.link.backlog import LEAST_BYTES, LOOK_S, MOST_BYTES, STUCK_S, WAITING_FRAME_BYTES, Backlog
from rass_mav.link.budget import MAX_WAITING
from tests.some import some

BULK, DATA = Urgency.BULK, Urgency.DATA


class Interface:
    """Sends a frame in so many seconds, in the order in which they were handed over."""

    def __init__(self, frame_s: float) -> None:
        self.frame_s = frame_s
        self.now = 0.0
        self.free_at = 0.0
        self.busy_s = 0.0
        self.stuck = 0
        self.backlog = Backlog(self.waiting, 0.0)

    def waiting(self) -> int:
        return self.stuck + WAITING_FRAME_BYTES * round(max(0.0, self.free_at - self.now) / self.frame_s + 0.499)

    def run(self, until: float) -> None:
        """Pop what may leave, whenever the backlog says so, while there are always more chunks."""
        for _ in range(100):
            self.backlog.push(b"chunk", 7, BULK, self.now)
        while True:
            while self.backlog.pop(self.now) is not None:
                self.backlog.push(b"chunk", 7, BULK, self.now)
                self.free_at = max(self.free_at, self.now) + self.frame_s
                self.busy_s += self.frame_s
            due = self.backlog.next_at(self.now)
            if due is None or due > until:
                break
            self.now = max(due, self.now + 1e-6)
        self.now = until


@pytest.mark.parametrize("frame_s", [0.0001, 0.0005, 0.002, 0.01])
def test_the_interface_is_busy_while_chunks_wait(frame_s: float) -> None:
    interface = Interface(frame_s)
    warm_s = 20 * LOOK_S
    interface.run(warm_s)
    before = interface.busy_s
    interface.run(warm_s + 100 * frame_s)
    assert interface.busy_s - before >= 0.98 * 100 * frame_s


@pytest.mark.parametrize("frame_s", [0.0001, 0.002, 0.01])
def test_what_is_urgent_waits_for_a_few_chunks_only(frame_s: float) -> None:
    interface = Interface(frame_s)
    interface.run(15 * LOOK_S)
    interface.backlog.push(b"datum", 7, DATA, interface.now)
    interface.run(interface.now)
    # Twice what it sends from one look to the next, and a frame.
    assert interface.free_at - interface.now <= 4 * LOOK_S + 2 * frame_s


@pytest.mark.parametrize("frame_s", [0.0005, 0.002])
def test_frames_that_never_leave_the_interface_do_not_hold_up_the_others(frame_s: float) -> None:
    """As those for a neighbour that has gone, whose hardware address the system asks for."""
    interface = Interface(frame_s)
    interface.run(20 * LOOK_S)
    interface.stuck = 5 * WAITING_FRAME_BYTES
    interface.run(interface.now + 2 * STUCK_S)
    before = interface.busy_s
    interface.run(interface.now + 1.0)
    assert interface.busy_s - before >= 0.95
    interface.backlog.push(b"datum", 7, DATA, interface.now)
    interface.run(interface.now)
    assert interface.free_at - interface.now <= 4 * LOOK_S + 2 * frame_s
    # The system has given up.
    interface.stuck = 0
    interface.run(interface.now + 0.2)
    interface.backlog.push(b"datum", 7, DATA, interface.now)
    interface.run(interface.now)
    assert interface.free_at - interface.now <= 4 * LOOK_S + 2 * frame_s


def test_everything_but_chunks_leaves_at_once_whatever_the_interface_holds() -> None:
    backlog = Backlog(lambda: 10 * MOST_BYTES, 0.0)
    backlog.push(b"chunk", 7, BULK, 0.0)
    backlog.push(b"datum", 7, DATA, 0.0)
    backlog.push(b"beacon", BROADCAST, Urgency.BEACON, 0.0)
    backlog.push(b"greeting", 7, DATA, 0.0, first=True)
    assert [backlog.pop(0.0), backlog.pop(0.0), backlog.pop(0.0), backlog.pop(0.0)] == [
        (b"greeting", 7, 0.0), (b"datum", 7, 0.0), (b"beacon", BROADCAST, 0.0), None
    ]  # fmt: skip
    due = some(backlog.next_at(0.0))
    assert 0.0 < due <= 2 * LOOK_S


def test_where_nothing_ever_waits_no_chunk_does() -> None:
    # As on the loopback.
    backlog = Backlog(lambda: 0, 0.0)
    for index in range(100):
        backlog.push(bytes([index]), 7, BULK, 0.0)
        assert backlog.pop(0.0) == (bytes([index]), 7, 0.0)
    assert backlog.next_at(0.0) is None


def test_chunks_for_nodes_that_are_no_longer_heard_and_beyond_the_bound_are_dropped() -> None:
    backlog = Backlog(lambda: LEAST_BYTES, 0.0)
    for index in range(MAX_WAITING[BULK] + 3):
        backlog.push(b"chunk", 7 + index % 2, BULK, 0.0)
    assert backlog.dropped == 3
    backlog.meet({8})
    assert backlog.dropped == 3 + MAX_WAITING[BULK] // 2
    backlog.meet(set())
    assert backlog.next_at(0.0) is None

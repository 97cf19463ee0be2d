"""The pacer: never more than the budget, beacons first, nothing without a bound."""

from __future__ import annotations

import random
from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.core.messages import BROADCAST, Urgency
from rass_mav.link.airtime import BEACON_BYTES, LEAST_THROTTLE, RADIO_STATUS_S, Pacer
from rass_mav.link.budget import FRAME_BYTES, MAX_WAITING, Budget, Queued


def pacer(budget: Budget, *, neighbours: int = 0) -> Pacer:
    made = Pacer(budget, random.Random(1), now=0.0, step_s=1.0)
    made.neighbours = neighbours
    return made


def drain(made: Pacer, until: float, now: float = 0.0) -> list[tuple[float, Queued]]:
    """What leaves, and when, if it is asked for whenever it says so."""
    left: list[tuple[float, Queued]] = []
    while True:
        while (queued := made.pop(now)) is not None:
            left.append((now, queued))
        due = made.next_at(now)
        if due is None or due > until:
            return left
        now = max(due, now + 1e-6)


budgets = st.builds(
    Budget,
    bytes_s=st.floats(50, 100_000),
    duty=st.floats(0.01, 1.0),
    beacons=st.floats(0.05, 0.9),
    burst_bytes=st.integers(FRAME_BYTES, 4096),
    burst_frames=st.integers(1, 10),
    frames_s=st.floats(1, 500),
    listen_s=st.sampled_from([0.0, 0.1]),
    packet_bytes=st.sampled_from([0, 254, 508]),
)
traffic = st.lists(
    st.tuples(st.sampled_from(list(Urgency)), st.integers(12, FRAME_BYTES), st.floats(0, 3)), min_size=1, max_size=60
)


@given(budgets, traffic, st.integers(0, 100))
def test_no_window_holds_more_than_the_burst_and_what_the_rate_gives(
    budget: Budget, frames: list[tuple[Urgency, int, float]], neighbours: int
) -> None:
    made = pacer(budget, neighbours=neighbours)
    left: list[tuple[float, Queued]] = []
    pushed = Counter[Urgency]()
    now = 0.0
    for urgency, size, gap in frames:
        left += drain(made, now + gap, now)
        now += gap
        made.push(bytes(size), BROADCAST, urgency, now)
        pushed[urgency] += 1
        assert pushed[urgency] - made.sent[urgency] - made.dropped[urgency] <= MAX_WAITING[urgency]
    left += drain(made, now + 30.0, now)
    rate = budget.bytes_s * budget.duty
    for first in range(len(left)):
        size = 0
        for last in range(first, len(left)):
            size += len(left[last][1].frame)
            seconds = left[last][0] - left[first][0]
            assert size <= max(budget.burst_bytes, FRAME_BYTES) + rate * seconds + 1
            assert last - first + 1 <= budget.burst_frames + budget.frames_s * seconds + 1e-3
    # Nothing vanishes: it left, waits, or was dropped and counted.
    assert len(left) + made.waiting + sum(made.dropped) == len(frames)
    assert sum(made.sent) == len(left)


def test_beacons_go_first_then_answers_then_data() -> None:
    made = pacer(Budget(bytes_s=1000.0, duty=1.0, burst_bytes=200, burst_frames=1))
    for urgency in (Urgency.DATA, Urgency.DATA, Urgency.ANSWER, Urgency.BEACON):
        made.push(bytes([urgency]) * 100, BROADCAST, urgency, 0.0)
    left = [queued.frame[0] for _, queued in drain(made, 10.0)]
    assert left == [Urgency.BEACON, Urgency.ANSWER, Urgency.DATA, Urgency.DATA]


def test_frames_of_one_moment_share_a_packet_and_the_next_packet_listens_first() -> None:
    def moments(packet_bytes: int) -> list[int]:
        made = pacer(
            Budget(1000.0, 1.0, burst_bytes=1000, burst_frames=9, listen_s=0.6, packet_bytes=packet_bytes)
        )  # fmt: skip
        for size in (150, 150, 150, 40, 100):
            made.push(bytes(size), BROADCAST, Urgency.ANSWER, 0.0)
        left = Counter(now for now, _ in drain(made, 10.0))
        return [left[now] for now in sorted(left)]

    assert moments(508) == [4, 1]
    assert moments(254) == [1, 1, 2, 1]
    assert moments(0) == [1, 1, 1, 1, 1]


def test_a_greeting_goes_before_what_waits_for_a_port_that_was_closed() -> None:
    made = pacer(Budget(bytes_s=1000.0, duty=1.0, burst_frames=1))
    made.push(b"value", BROADCAST, Urgency.VEHICLE, 0.0)
    made.push(b"heartbeat", BROADCAST, Urgency.VEHICLE, 0.1, first=True)
    assert [queued.frame for _, queued in drain(made, 10.0)] == [b"heartbeat", b"value"]


def test_only_the_newest_beacon_waits() -> None:
    made = pacer(Budget(bytes_s=100.0), neighbours=50)
    drain_at = 0.0
    for n in range(5):
        made.push(bytes([n]), BROADCAST, Urgency.BEACON, drain_at)
    [(_, queued)] = drain(made, 1.0)
    assert queued.frame == bytes([4])
    assert made.dropped[Urgency.BEACON] == 4


def test_what_has_waited_for_two_turns_is_dropped() -> None:
    made = pacer(Budget(bytes_s=100.0, duty=0.1))
    for n in range(20):
        made.push(bytes([n]) * 100, BROADCAST, Urgency.DATA, 0.0)
    turn_s, _ = made.pace()
    assert made.pop(2.5 * turn_s) is None
    assert made.waiting == 0
    assert made.dropped[Urgency.DATA] == 20


@given(st.integers(0, 500))
def test_beacons_of_all_take_at_most_their_part(neighbours: int) -> None:
    budget = Budget(bytes_s=5760.0)
    turn_s, items = pacer(budget, neighbours=neighbours).pace()
    assert items >= 1
    if turn_s < 120.0:
        assert (neighbours + 1) * BEACON_BYTES / turn_s <= budget.beacons * budget.duty * budget.bytes_s + 1e-6
    assert turn_s == int(turn_s)


def test_a_full_radio_slows_us_down_before_it_overflows() -> None:
    """A radio that drains 1000 bytes/s, with a buffer of 2000, while the budget would allow four times as much."""
    made = pacer(Budget(bytes_s=4000.0, duty=1.0, frames_s=1000.0))
    buffered, lost, now = 0.0, 0, 0.0
    while now < 60.0:
        while made.waiting < 20:
            made.push(bytes(145), BROADCAST, Urgency.DATA, now)
        while (queued := made.pop(now)) is not None:
            if buffered + len(queued.frame) > 2000:
                lost += 1
            else:
                buffered += len(queued.frame)
        buffered = max(0.0, buffered - 10.0)
        now += 0.01
        if round(now * 100) % 25 == 0:
            made.radio_status(int(100 * (1 - buffered / 2000)), now)
    assert lost == 0
    assert made.throttle < 1.0
    assert made.sent[Urgency.DATA] * 145 > 0.7 * 60 * 1000


def test_the_radios_word_is_bounded_and_forgotten() -> None:
    made = pacer(Budget(bytes_s=1000.0))
    for n in range(50):
        made.radio_status(1, n * 0.1)
    assert made.throttle == LEAST_THROTTLE
    for n in range(50):
        made.radio_status(100, 5.0 + n * 0.1)
    assert made.throttle == 1.0
    made.radio_status(1, 10.0)
    assert made.throttle == 0.5
    made.pop(10.0 + RADIO_STATUS_S + 1.0)
    assert made.throttle == 0.5 * 1.25


def test_from_the_floor_it_recovers_as_soon_as_no_more_come() -> None:
    made = pacer(Budget(bytes_s=1000.0))
    for n in range(50):
        made.radio_status(1, n * 0.1)
    assert made.throttle == LEAST_THROTTLE
    made.next_at(5.0 + RADIO_STATUS_S + 15.0)
    assert made.throttle == 1.0
    made.radio_status(1, 1e6)
    assert made.throttle == 0.5, "a long silence is no credit"


# -- chunks of large data ----------------------------------------------------------------------------------------------

#: A link for this node alone.
ALONE = Budget(bytes_s=5760.0, duty=1.0, beacons=0.05)


def bytes_of(left: list[tuple[float, Queued]], target: int) -> int:
    return sum(len(queued.frame) for _, queued in left if queued.target == target)


def test_chunks_take_what_the_rest_leaves() -> None:
    made = pacer(ALONE, neighbours=1)
    left: list[tuple[float, Queued]] = []
    for second in range(60):
        now = float(second)
        left += drain(made, now, now - 1.0)
        made.push(bytes(BEACON_BYTES), BROADCAST, Urgency.BEACON, now)
        made.push(bytes(40), BROADCAST, Urgency.ANSWER, now)
        while made.waiting < 100:
            made.push(bytes(145), 2, Urgency.BULK, now)
    assert sum(made.dropped) == 0
    assert made.sent[Urgency.BEACON] >= 59
    assert made.sent[Urgency.ANSWER] >= 59
    # 59 seconds of all that the link carries, without the bucket that was empty at first.
    assert bytes_of(left, 2) > 0.99 * (59 * 5760.0 - bytes_of(left, BROADCAST)) - FRAME_BYTES


def test_a_chunk_leaves_when_nothing_else_waits() -> None:
    made = pacer(Budget(bytes_s=1000.0, duty=1.0, burst_bytes=200, burst_frames=1))
    for urgency in reversed(Urgency):
        made.push(bytes([urgency]) * 100, BROADCAST, urgency, 0.0)
    assert [queued.frame[0] for _, queued in drain(made, 10.0)] == list(Urgency)


@pytest.mark.no_cover
@given(st.integers(12, FRAME_BYTES), st.sampled_from([Urgency.VEHICLE, Urgency.BEACON, Urgency.ANSWER, Urgency.DATA]))
def test_short_chunks_keep_no_long_frame_waiting(chunk: int, urgency: Urgency) -> None:
    """A full frame needs more tokens than a short chunk. They must not be taken away from it again and again."""
    made = pacer(Budget(bytes_s=1000.0, duty=1.0, burst_bytes=FRAME_BYTES, burst_frames=1), neighbours=10)
    for _ in range(400):
        made.push(bytes(chunk), 2, Urgency.BULK, 0.0)
    drain(made, 5.0)
    made.push(bytes(FRAME_BYTES), BROADCAST, urgency, 5.0)
    left = drain(made, 100.0, 5.0)
    if made.sent[Urgency.BULK] == 400 and len(left) == 1:
        return  # the chunks had left before
    at = next(now for now, queued in left if queued.target == BROADCAST)
    assert at <= 5.0 + (FRAME_BYTES + chunk) / 1000.0 + made.pace().turn_s


def test_beacons_are_on_time_beside_chunks() -> None:
    made = pacer(ALONE, neighbours=1)
    for _ in range(MAX_WAITING[Urgency.BULK]):
        made.push(bytes(145), 2, Urgency.BULK, 0.0)
    left: list[tuple[float, Queued]] = []
    for second in range(10):
        made.push(bytes(BEACON_BYTES), BROADCAST, Urgency.BEACON, float(second))
        left += drain(made, second + 0.999, float(second))
    late = [now % 1.0 for now, queued in left if queued.target == BROADCAST]
    assert len(late) == 10
    assert max(late) <= (145 + BEACON_BYTES) / 5760.0 + 1e-3


def test_a_datum_takes_the_place_of_a_chunk_when_its_own_part_is_used_up() -> None:
    made = pacer(ALONE, neighbours=20)
    for _ in range(50):
        made.push(bytes(145), 2, Urgency.BULK, 0.0)
        made.push(bytes(145), 3, Urgency.DATA, 0.0)
    left = drain(made, 10.0)
    assert [queued.target for _, queued in left] == [3] * 50 + [2] * 50
    # Without chunks it has only its part.
    made = pacer(ALONE, neighbours=20)
    for _ in range(50):
        made.push(bytes(145), 3, Urgency.DATA, 0.0)
    assert len(drain(made, 1.9)) * 145 <= 2 * FRAME_BYTES + 1.9 * made.data_rate


def test_nodes_that_hear_each_other_share_what_the_swarm_may_send() -> None:
    """Three nodes with chunks, and a swarm that may take a third of the air: each counts the others' frames."""
    budget = Budget(bytes_s=5760.0, duty=1 / 3, listen_s=0.1)
    nodes = [Pacer(budget, random.Random(seed), now=0.0, step_s=1.0) for seed in range(3)]
    ids = {1, 2, 3}
    for made in nodes:
        made.meet(ids)
    sent, now = [0, 0, 0], 0.0
    while now < 60.0:
        # The one that may first; its frame takes the air.
        for made in nodes:
            while made.waiting < 10:
                made.push(bytes(145), 1, Urgency.BULK, now)
        dues = [made.next_at(now) or 0.0 for made in nodes]
        first = dues.index(min(dues))
        now = max(now, dues[first]) + 1e-6
        if nodes[first].pop(now) is None:
            continue
        sent[first] += 145
        now += 145 / 5760.0
        for index, made in enumerate(nodes):
            if index != first:
                made.heard(now, 145)
    # No more than the swarm's share, though each also has a part of its own; and not much less.
    parts = sum(made.data_rate for made in nodes)
    assert 0.9 * budget.duty * 5760.0 < sum(sent) / 60.0 < budget.duty * 5760.0 + parts
    assert min(sent) > 0.8 * max(sent)


def test_a_full_queue_refuses_the_newest_chunk() -> None:
    made = pacer(ALONE)
    most = MAX_WAITING[Urgency.BULK]
    for n in range(most + 10):
        made.push(n.to_bytes(2, "big"), 2, Urgency.BULK, 0.0)
    assert made.dropped[Urgency.BULK] == 10
    left = drain(made, 1000.0)
    assert [int.from_bytes(queued.frame, "big") for _, queued in left] == list(range(most))


def test_chunks_grow_old_but_not_beyond_their_target() -> None:
    made = pacer(Budget(bytes_s=100.0, duty=0.1))
    for target in (2, 3, 2, 3):
        made.push(bytes([target]) * 100, target, Urgency.BULK, 0.0)
    made.meet({2, 3})
    made.pop(1.0)
    assert made.next_at(1e4) is not None
    assert made.waiting == 4
    made.meet({3, 4})
    assert made.dropped[Urgency.BULK] == 2
    assert [queued.target for _, queued in drain(made, 2e4, 1e4)] == [3, 3]


def test_forged_noise_costs_chunks_a_burst_and_no_more() -> None:
    made = pacer(Budget(bytes_s=1000.0, duty=1.0, listen_s=0.01), neighbours=1)
    made.push(bytes(145), 2, Urgency.BULK, 0.0)
    for _ in range(10_000):
        made.heard(0.5, 280)
    [(at, _)] = drain(made, 60.0, 0.5)
    assert at <= 0.5 + (512 + 145) / 1000.0 + 0.01

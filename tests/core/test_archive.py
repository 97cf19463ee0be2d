from __future__ import annotations

import random
import time
import tracemalloc

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.core.datum import DatumId, Fate
from rass_mav.core.messages import DeletionReport
from rass_mav.core.news.archive import (
    MAX_EPOCHS,
    MAX_LOST_OF_ONE,
    MAX_PAIRS,
    MAX_REPORTED_LOST,
    MAX_STORE_FAULTS,
    Archive,
)

from .build import loss, make_node

LAST = (1 << 32) - 1


def ids(*sequences: int, origin: int = 1) -> list[DatumId]:
    return [DatumId(origin, 5, s) for s in sequences]


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["add", "lose"]), st.integers(0, 1), st.integers(0, 40) | st.integers(LAST - 20, LAST)
        )
    )
)
def test_a_datum_has_arrived_or_was_told_lost_or_neither(operations: list[tuple[str, int, int]]) -> None:
    archive = Archive()
    arrived: set[DatumId] = set()
    lost: set[DatumId] = set()
    for operation, origin, sequence in operations:
        id = DatumId(origin, 5, sequence)
        if operation == "add":
            assert archive.add(id) == (id not in arrived)
            arrived.add(id)
            # It turned up all the same.
            lost.discard(id)
        else:
            assert archive.lose(id, Fate.CORRUPTED) == (id not in arrived | lost)
            if id not in arrived:
                lost.add(id)
    every = [DatumId(origin, 5, s) for origin in range(2) for s in [*range(45), *range(LAST - 25, LAST + 1)]]
    assert {id for id in every if id in archive} == arrived
    assert {id for id in every if archive.is_lost(id)} == lost
    assert archive.reported_lost == len(lost)
    assert set(archive) == {(id.origin, 5) for id in arrived | lost}
    for pair in archive:
        assert archive.end(pair) == max((id.sequence + 1 for id in arrived if id[:2] == pair), default=0)
    # A base that starts again knows the same.
    again = Archive(arrived, [(id, Fate.CORRUPTED) for id in lost])
    assert {id for id in every if id in again} == arrived
    assert {id for id in every if again.is_lost(id)} == lost


def test_epochs_are_told_apart() -> None:
    assert DatumId(1, 6, 0) not in Archive(ids(0))
    assert (1, 5, 0) not in Archive(ids(0))


def test_words_about_stores_are_no_losses_of_data() -> None:
    archive = Archive(ids(0))
    assert archive.lose(ids(7)[0], Fate.UNKNOWN)
    assert not archive.lose(ids(7)[0], Fate.UNKNOWN)
    assert not archive.is_lost(ids(7)[0])
    assert archive.lose(ids(0)[0], Fate.DAMAGED)
    assert (archive.reported_lost, len(archive.store_faults)) == (0, 2)
    for sequence in range(2 * MAX_STORE_FAULTS):
        archive.lose(DatumId(9, 9, sequence), Fate.UNKNOWN)
    assert len(archive.store_faults) == MAX_STORE_FAULTS


def test_losses_are_bounded_by_origin_and_in_all() -> None:
    archive = Archive()
    taken = sum(archive.lose(DatumId(1, s % 9, 2 * s), Fate.CORRUPTED) for s in range(2 * MAX_LOST_OF_ONE))
    assert taken == MAX_LOST_OF_ONE
    taken = sum(archive.lose(DatumId(2, epoch, 0), Fate.CORRUPTED) for epoch in range(1000))
    assert taken == MAX_EPOCHS
    # An epoch of which something has arrived is none of these.
    archive.add(DatumId(2, 2000, 0))
    assert archive.lose(DatumId(2, 2000, 1), Fate.CORRUPTED)
    for origin in range(3, 3 + 2 * MAX_PAIRS):
        archive.lose(DatumId(origin, 5, 0), Fate.CORRUPTED)
    assert len(archive) <= MAX_PAIRS + 1
    for origin in range(3, 50):
        for sequence in range(MAX_LOST_OF_ONE):
            archive.lose(DatumId(origin, 5, sequence), Fate.CORRUPTED)
    assert archive.reported_lost == MAX_REPORTED_LOST


# Its bound is of processor time, which tracing would triple.
@pytest.mark.no_cover
def test_a_flood_of_loss_notes_neither_fills_a_base_nor_keeps_it() -> None:
    base = make_node(0, base=True)
    rng = random.Random(1)
    flood = [
        DeletionReport(
            7, 0, tuple([loss(n, DatumId(rng.getrandbits(15), n % 9, rng.getrandbits(32)), 1) for n in range(6)])
        )
        for _ in range(10_000)
    ]
    tracemalloc.start()
    for note in flood[:5000]:
        base.receive(note, 0.0)
    used, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert used < 10 << 20
    assert len(list(base.store.losses())) <= MAX_REPORTED_LOST
    # It is full now: what else comes costs little time and no room.
    began = time.process_time()
    for note in flood[5000:]:
        base.receive(note, 0.0)
    # 200,000 of them in about a second; a loaded computer gets more.
    assert time.process_time() - began < 30_000 * 25e-6
    assert len(list(base.store.losses())) <= MAX_REPORTED_LOST

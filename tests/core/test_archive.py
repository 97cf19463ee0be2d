from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from rass_mav.core.datum import DatumId, Fate
from rass_mav.core.news.archive import Archive, SequenceSet
from rass_mav.core.news.arrivals import has_arrived, is_told_lost


def ids(*sequences: int, origin: int = 1) -> list[DatumId]:
    return [DatumId(origin, 5, s) for s in sequences]


@given(st.lists(st.integers(0, 30)))
def test_a_sequence_set_is_a_set(numbers: list[int]) -> None:
    compact = SequenceSet()
    plain: set[int] = set()
    for number in numbers:
        assert compact.add(number) == (number not in plain)
        plain.add(number)
        assert {n for n in range(40) if n in compact} == plain
        assert compact.closed not in compact.beyond


@given(st.lists(st.tuples(st.sampled_from(["add", "lose"]), st.integers(0, 1), st.integers(0, 40))))
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
            assert archive.lose(id) == (id not in arrived | lost)
            if id not in arrived:
                lost.add(id)
    every = [DatumId(origin, 5, sequence) for origin in range(2) for sequence in range(45)]
    assert {id for id in every if id in archive} == arrived
    assert {id for id in every if archive.is_lost(id)} == lost
    assert archive.told_lost == len(lost)
    assert set(archive) == {(id.origin, 5) for id in arrived | lost}
    # A base that starts again knows the same.
    again = Archive(arrived, [(id, Fate.CORRUPTED) for id in lost])
    assert {id for id in every if id in again} == arrived
    assert {id for id in every if again.is_lost(id)} == lost
    for pair in archive:
        assert archive.known(pair) == again.known(pair)


def test_what_a_base_tells_of_its_archive() -> None:
    archive = Archive(ids(0, 1, 2, 4, 7), [(id, Fate.EXPIRED) for id in ids(3, 9)])
    known = archive.known((1, 5))
    assert [s for s in range(20) if has_arrived(known, s)] == [0, 1, 2, 4, 7]
    assert [s for s in range(20) if is_told_lost(known, s)] == [3, 9]


def test_a_loss_closes_the_hole_in_the_index() -> None:
    archive = Archive(ids(0, *range(2, 5000)))
    assert archive.lose(ids(1)[0])
    assert archive._origins[1, 5].settled.beyond == set()


def test_epochs_are_told_apart() -> None:
    assert DatumId(1, 6, 0) not in Archive(ids(0))
    assert (1, 5, 0) not in Archive(ids(0))

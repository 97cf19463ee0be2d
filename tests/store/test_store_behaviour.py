"""What holds for every store."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import pytest

from rass_mav.core.datum import TERMS, USUAL, DatumId, Fate, Terms, make_datum
from rass_mav.core.store import MAX_PARTIALS, PartialKey, Store, StoredInfo, key_of
from rass_mav.errors import StoreFullError
from rass_mav.store.memory import MemoryStore
from rass_mav.store.quota import BESIDE_BYTES, MOST_BESIDE_BYTES, MOST_PARTIAL_BYTES, ROW_OVERHEAD
from rass_mav.store.sqlite import SqliteStore
from tests.some import some

from .store_helpers import EPOCH, commit, datum, open_store, payload

Make = Callable[..., Store]


@pytest.fixture(params=["memory", "sqlite"])
def make(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Make]:
    opened: list[MemoryStore | SqliteStore] = []

    def make(quota_bytes: int | None = None) -> Store:
        if request.param == "memory":
            opened.append(MemoryStore(EPOCH, quota_bytes=quota_bytes))
        else:
            opened.append(open_store(tmp_path / "node.db", quota_bytes=quota_bytes))
        return opened[-1]

    yield make
    for store in opened:
        store.close()


@pytest.fixture
def store(make: Make) -> Store:
    return make()


def test_a_new_store_is_empty(store: Store) -> None:
    assert store.epoch == EPOCH
    assert [*store.held(), *store.ids(), *store.losses()] == []
    assert store.counters() == {}
    assert store.get_meta("announcement") is None
    assert store.get(DatumId(7, EPOCH, 0)) is None
    assert store.take(force=True) is None


def test_sequence_numbers_have_no_holes(store: Store) -> None:
    numbers = []
    for _ in range(5):
        numbers.append(store.next_sequence())
        commit(store)
    assert numbers == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("committed", [False, True])
def test_what_is_put_is_there_at_once(store: Store, committed: bool) -> None:
    first, second = datum(1), datum(2, 3000)
    store.put(first)
    store.put(second)
    if committed:
        commit(store)
    assert store.get(first.id) == first
    assert store.get(second.id) == second
    assert store.get(second.id).intact  # type: ignore[union-attr]
    assert list(store.held()) == [
        StoredInfo(first.id, 1, 1.5, 0, first.crc, 50),
        StoredInfo(second.id, 1, 1.5, 0, second.crc, 3000),
    ]
    assert sorted(store.ids()) == [first.id, second.id]


@pytest.mark.parametrize("committed", [False, True])
def test_a_replaced_datum_is_the_latest(store: Store, committed: bool) -> None:
    first, second = datum(1), datum(2)
    store.put(first)
    store.put(second)
    if committed:
        commit(store)
    store.put(first._replace(hops=4))
    if committed:
        commit(store)
    assert [(info.id, info.hops) for info in store.held()] == [(second.id, 0), (first.id, 4)]
    assert store.get(first.id) == first._replace(hops=4)


@pytest.mark.parametrize("committed", [False, True])
def test_what_is_removed_is_gone_at_once(store: Store, committed: bool) -> None:
    store.put(datum(1))
    store.put(datum(2))
    if committed:
        commit(store)
    store.remove(datum(1).id, Fate.PASSED_ON)
    assert store.get(datum(1).id) is None
    assert [info.id for info in store.held()] == list(store.ids()) == [datum(2).id]
    commit(store)
    assert store.get(datum(1).id) is None
    store.remove(datum(1).id, Fate.CORRUPTED)
    assert list(store.losses()) == []


def test_only_corrupted_and_expired_data_are_noted_as_losses(store: Store) -> None:
    for number, fate in enumerate(Fate):
        store.put(datum(number))
        store.remove(datum(number).id, fate)
    losses = {fate: id for id, fate in store.losses()}
    assert set(losses) == {Fate.CORRUPTED, Fate.EXPIRED}
    commit(store)
    assert {fate: id for id, fate in store.losses()} == losses


def test_the_first_fate_that_is_told_of_a_loss_stays(store: Store) -> None:
    id = DatumId(9, 1, 5)
    store.lose(id, Fate.OVERFLOW)
    store.lose(id, Fate.EXPIRED)
    commit(store)
    store.lose(id, Fate.CORRUPTED)
    assert list(store.losses()) == [(id, Fate.OVERFLOW)]
    commit(store)
    assert list(store.losses()) == [(id, Fate.OVERFLOW)]


def test_a_proof_stays_beside_its_loss(store: Store) -> None:
    ids = [DatumId(9, 1, sequence) for sequence in range(3)]
    store.lose(ids[0], Fate.OVERFLOW, b"\x00\xff proof")
    store.lose(ids[1], Fate.CORRUPTED)
    for _ in range(2):
        assert dict(store.losses()) == {ids[0]: Fate.OVERFLOW, ids[1]: Fate.CORRUPTED}
        assert store.proofs() == {ids[0]: b"\x00\xff proof"}
        commit(store)
    store.lose(ids[1], Fate.CORRUPTED, b"later")
    store.found(ids[0])
    assert store.proofs() == {}


def test_a_loss_that_is_found_is_none_until_it_is_lost_again(store: Store) -> None:
    id = DatumId(9, 1, 5)
    store.lose(id, Fate.OVERFLOW)
    store.found(id)
    assert list(store.losses()) == []
    store.lose(id, Fate.EXPIRED)
    commit(store)
    store.found(id)
    assert list(store.losses()) == []
    store.lose(id, Fate.CORRUPTED)
    assert list(store.losses()) == [(id, Fate.CORRUPTED)]
    commit(store)
    assert list(store.losses()) == [(id, Fate.CORRUPTED)]
    store.found(DatumId(9, 1, 6))
    assert list(store.losses()) == [(id, Fate.CORRUPTED)]


def test_counters_add_up_and_numbers_are_set(store: Store) -> None:
    store.count("delivered")
    commit(store)
    store.count("delivered", 41)
    store.count("overflow", 3)
    store.set_meta("announcement", 65535)
    store.set_meta("announcement", -1)
    assert store.counters() == {"delivered": 42, "overflow": 3}
    assert store.get_meta("announcement") == -1


def test_what_is_handed_out_does_not_change_the_store(store: Store) -> None:
    store.put(datum(1))
    store.count("delivered")
    store.counters()["delivered"] = 7
    for id in store.ids():
        store.remove(id, Fate.PASSED_ON)
    assert store.counters() == {"delivered": 1}


def test_the_store_may_change_while_it_is_listed(store: Store) -> None:
    for number in range(20):
        store.put(datum(number))
        if number == 10:
            commit(store)
    for info in store.held():
        store.remove(info.id, Fate.PASSED_ON)
    assert list(store.ids()) == []


def test_there_is_room_for_what_can_be_put_and_for_nothing_else(make: Make) -> None:
    store = make(3 * (100 + ROW_OVERHEAD))
    for number in range(3):
        assert store.room_for(100)
        store.put(datum(number, 100))
    assert not store.room_for(0)
    commit(store)
    store.remove(datum(0).id, Fate.PASSED_ON)
    for size in (0, 99, 100, 101, 1000):
        if store.room_for(size):
            store.put(datum(9, size))
            store.remove(datum(9).id, Fate.PASSED_ON)
        else:
            with pytest.raises(StoreFullError):
                store.put(datum(9, size))
    assert store.room_for(100)
    assert not store.room_for(101)


def test_without_a_quota_there_is_room(store: Store) -> None:
    assert store.room_for(1 << 20)


def test_over_the_quota_nothing_changes(make: Make) -> None:
    store = make(2 * (100 + ROW_OVERHEAD))
    store.put(datum(1, 100))
    store.put(datum(2, 100))
    for refused in (datum(3, 0), datum(2, 101)):
        with pytest.raises(StoreFullError, match="quota"):
            store.put(refused)
    assert store.get(datum(3).id) is None
    assert [store.get(info.id) for info in store.held()] == [datum(1, 100), datum(2, 100)]
    commit(store)
    store.put(datum(2, 99))
    store.remove(datum(1).id, Fate.PASSED_ON)
    store.put(datum(3, 101))
    with pytest.raises(StoreFullError):
        store.put(datum(4, 0))


# -- what has not come whole -------------------------------------------------------------------------------------------


def assembled(pieces: Iterable[tuple[int, bytes]], size: int) -> bytes:
    """The payload with zeros where nothing has come."""
    content = bytearray(size)
    for offset, data in pieces:
        content[offset : offset + len(data)] = data
    return bytes(content)


@pytest.mark.parametrize("committed", [False, True])
def test_pieces_are_there_at_once_and_again_and_again(store: Store, committed: bool) -> None:
    one = datum(1, 20_000)
    key = key_of(one)
    assert store.partial(key) == []
    for start, stop in ((3000, 6000), (0, 1000), (6000, 20_000), (900, 1500)):
        store.keep_partial(key, start, one.payload[start:stop])
        if committed:
            commit(store, force=False)
        for offset, data in store.partial(key):
            assert data == one.payload[offset : offset + len(data)]
    assert assembled(store.partial(key), 20_000) == one.payload[:1500] + bytes(1500) + one.payload[3000:]
    assert not store.unwritten
    assert [*store.held(), *store.losses()] == []
    assert store.used_bytes == 0
    store.forget_partial(key)
    assert store.partial(key) == []
    store.keep_partial(key, 0, b"new")
    if committed:
        commit(store, force=False)
    assert store.partial(key) == [(0, b"new")]
    store.forget_partial(key_of(datum(2)))


@pytest.mark.parametrize("committed", [False, True])
def test_what_has_come_whole_is_no_partial_any_more(store: Store, committed: bool) -> None:
    one = datum(1, 20_000)
    key = key_of(one)
    store.keep_partial(key, 0, one.payload[:5000])
    if committed:
        commit(store, force=False)
    store.put(one)
    store.keep_partial(key, 5000, one.payload[5000:7000])
    commit(store)
    assert store.get(one.id) == one
    store.remove(one.id, Fate.PASSED_ON)
    commit(store)
    assert store.partial(key) == []


@pytest.mark.parametrize("committed", [False, True])
def test_partials_are_bounded_and_the_one_that_is_idle_for_longest_goes(store: Store, committed: bool) -> None:
    data = [datum(number, 20_000) for number in range(MAX_PARTIALS + 1)]
    for one in data[:-1]:
        store.keep_partial(key_of(one), 0, b"first")
        if committed:
            commit(store, force=False)
    store.keep_partial(key_of(data[0]), 5, b"second")
    store.keep_partial(key_of(data[-1]), 0, b"first")
    commit(store, force=False)
    assert [one.id.sequence for one in data if not store.partial(key_of(one))] == [1]
    large = [PartialKey(datum(number).id, 7, MOST_BESIDE_BYTES) for number in range(20, 25)]
    for key in large:
        store.keep_partial(key, 0, b"first")
        commit(store, force=False)
    there = [key for key in [*map(key_of, data), *large] if store.partial(key)]
    assert there == large[1:]
    assert sum(key.size for key in there) == MOST_PARTIAL_BYTES


def test_of_small_data_nothing_is_kept(store: Store) -> None:
    small = datum(1, BESIDE_BYTES - 1)
    store.keep_partial(key_of(small), 0, small.payload[:1000])
    assert store.partial(key_of(small)) == []
    assert store.take(force=True) is None


def test_a_flipped_bit_is_found_by_the_checksum_and_flips_back() -> None:
    store = MemoryStore(1)
    for number in range(3):
        store.put(datum(number))
    for bit in (0, 9, 399):
        store.flip_bit(datum(1).id, bit)
        flipped = some(store.get(datum(1).id))
        assert not flipped.intact
        assert flipped.crc == datum(1).crc
        difference = int.from_bytes(flipped.payload, "little") ^ int.from_bytes(datum(1).payload, "little")
        assert difference == 1 << bit
        store.flip_bit(datum(1).id, bit)
        assert store.get(datum(1).id) == datum(1)
    assert [info.id.sequence for info in store.held()] == [0, 1, 2]


@pytest.mark.parametrize("bit", [-1, 400])
def test_a_bit_that_the_payload_does_not_have(bit: int) -> None:
    store = MemoryStore(1)
    store.put(datum(1))
    with pytest.raises(IndexError):
        store.flip_bit(datum(1).id, bit)
    with pytest.raises(KeyError):
        store.flip_bit(datum(2).id, 0)


def test_used_bytes_follow_what_is_stored() -> None:
    store = MemoryStore(1, quota_bytes=1000)
    store.put(datum(1, 10))
    store.put(datum(1, 30))
    store.put(datum(2, 5))
    assert store.used_bytes == 35 + 2 * ROW_OVERHEAD
    store.remove(datum(1).id, Fate.EXPIRED)
    assert store.used_bytes == 5 + ROW_OVERHEAD


def test_an_epoch_has_32_bits() -> None:
    with pytest.raises(ValueError, match="32 bits"):
        MemoryStore(1 << 32)


SEQUENCE_MARK = [Terms(9, 3600), Terms(0), USUAL, Terms(ttl_s=1), USUAL]


@pytest.mark.parametrize("size", [4, 50, 3000, BESIDE_BYTES, 70_000])
def test_a_store_that_is_opened_again_tells_them(tmp_path: Path, size: int) -> None:
    # The last one is cut off: too short for terms, whatever its kind says.
    contents = [terms.pack() + payload(number, size) for number, terms in enumerate(SEQUENCE_MARK[:-1])] + [b"\x09"]
    kinds = [TERMS, TERMS, 1, TERMS, TERMS]
    data = [
        make_datum(DatumId(7, EPOCH, number), kind, 1.5, content)
        for number, (kind, content) in enumerate(zip(kinds, contents, strict=True))
    ]
    with open_store(tmp_path / "node.db") as store:
        for datum in data:
            store.put(datum)
        assert [info.terms for info in store.held()] == SEQUENCE_MARK, "while they wait for the disk"
        commit(store)
        assert [info.terms for info in store.held()] == SEQUENCE_MARK
    with open_store(tmp_path / "node.db") as store:
        assert not store.report.created
        assert [(info.id, info.terms) for info in store.held()] == [
            (datum.id, terms) for datum, terms in zip(data, SEQUENCE_MARK, strict=True)
        ]
        assert [store.get(datum.id) for datum in data] == data

"""What only the memory store does."""

from __future__ import annotations

import pytest

from rass_mav.core.datum import Fate
from rass_mav.store.memory import MemoryStore
from rass_mav.store.quota import ROW_OVERHEAD
from tests.some import some

from .store_helpers import datum


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

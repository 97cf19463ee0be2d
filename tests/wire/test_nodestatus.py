"""The payload of a status: it fits one frame, and what was meant is read."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.core.messages import INLINE_BYTES
from rass_mav.errors import MalformedError
from rass_mav.wire.nodestatus import MOST_NEIGHBOURS, MOST_ORIGINS, NodeStatus, decode_status, encode_status

SAID = NodeStatus(12, 3, 4, 33, 0.25, 2, 81, (47.3769, 8.5417), {7: 1.0, 9: 0.5}, {7: 2, 3: 1})
GOLDEN = "01010c000300040021000040025128243d1c285c1705020700ff090080020700020003000100"

#: The same node, whose data go to node 9.
TOWARDS_9 = "01050c000300040021000040025128243d1c285c1705020900800700ff020700020003000100"

counts = st.integers(0, 65535)
ids = st.integers(0, 65534)


def test_the_bytes_are_these() -> None:
    assert encode_status(SAID).hex() == GOLDEN
    back = decode_status(bytes.fromhex(GOLDEN))
    assert back._replace(risk=SAID.risk, neighbours=SAID.neighbours) == SAID
    assert back.risk == pytest.approx(0.25, abs=1e-4)
    assert back.neighbours == pytest.approx({7: 1.0, 9: 0.5}, abs=0.01)


def test_the_next_hop_is_the_first_of_the_neighbours() -> None:
    said = SAID._replace(next_hop=9)
    assert encode_status(said).hex() == TOWARDS_9
    assert len(TOWARDS_9) == len(GOLDEN), "it takes a flag and no bytes"
    assert decode_status(bytes.fromhex(TOWARDS_9)).next_hop == 9
    assert decode_status(bytes.fromhex(GOLDEN)).next_hop is None


def test_the_next_hop_is_told_even_if_ten_others_are_heard_better() -> None:
    heard = {id: 1.0 - id / 100 for id in range(20)}
    read = decode_status(encode_status(SAID._replace(neighbours=heard, next_hop=15)))
    assert list(read.neighbours) == [15, *range(MOST_NEIGHBOURS - 1)]
    assert read.next_hop == 15


def test_a_flag_without_neighbours_tells_no_next_hop() -> None:
    payload = encode_status(SAID._replace(neighbours={}, next_hop=7))
    assert decode_status(payload).next_hop is None
    assert decode_status(payload[:1] + b"\5" + payload[2:]).next_hop is None


@given(
    held=counts, alone=counts, spares=counts, free=st.none() | st.integers(0, 65534), risk=st.floats(0, 1),
    hops=st.none() | st.integers(0, 254), battery=st.none() | st.integers(0, 100),
    place=st.none() | st.tuples(st.floats(-90, 90), st.floats(-180, 180)),
    neighbours=st.dictionaries(ids, st.floats(0, 1), max_size=MOST_NEIGHBOURS + 5),
    alone_by_origin=st.dictionaries(ids, st.integers(1, 65535), max_size=MOST_ORIGINS + 5), base=st.booleans(),
    next_hop=st.none() | ids, link_key=st.none() | st.integers(0, 2**32 - 1),
)  # fmt: skip
def test_what_is_said_is_read_and_fits_one_frame(**fields: object) -> None:
    said = NodeStatus(**fields)  # type: ignore[arg-type]
    payload = encode_status(said)
    assert len(payload) <= INLINE_BYTES
    read = decode_status(payload + b"later")
    for name in ("held", "alone", "spares", "free", "hops", "battery", "base", "link_key"):
        assert getattr(read, name) == getattr(said, name)
    assert read.next_hop == (said.next_hop if said.next_hop in said.neighbours else None)
    assert len(read.neighbours) == min(len(said.neighbours), MOST_NEIGHBOURS)
    assert read.alone_by_origin.items() <= said.alone_by_origin.items()
    assert len(read.alone_by_origin) == min(len(said.alone_by_origin), MOST_ORIGINS)
    left_out = [count for origin, count in said.alone_by_origin.items() if origin not in read.alone_by_origin]
    assert max(left_out, default=0) <= min(read.alone_by_origin.values(), default=0)
    assert (read.place is None) is (said.place is None)
    if said.place is not None:
        assert read.place == pytest.approx(said.place, abs=1e-7)


@given(st.binary(max_size=200))
def test_anything_parses_or_is_malformed(payload: bytes) -> None:
    try:
        read = decode_status(payload)
    except MalformedError:
        return
    assert 0.0 <= read.risk <= 1.0
    assert read.battery is None or 0 <= read.battery <= 100
    assert read.next_hop is None or read.next_hop in read.neighbours


def test_a_cut_one_is_malformed_wherever_it_is_cut() -> None:
    whole = bytes.fromhex(GOLDEN)
    for end in range(len(whole)):
        with pytest.raises(MalformedError):
            decode_status(whole[:end])
    with pytest.raises(MalformedError, match="version 9"):
        decode_status(b"\x09" + whole[1:])


def test_counts_beyond_the_field_stay_at_its_end() -> None:
    read = decode_status(encode_status(SAID._replace(held=70_000, alone=70_000, free=70_000)))
    assert (read.held, read.alone, read.free) == (65535, 65535, 65534)


def test_where_there_is_less_space_the_less_important_is_left_out() -> None:
    neighbours = {id: 1.0 - id / 20 for id in range(1, 11)}
    origins = {id: 100 - id for id in range(1, 10)}
    status = NodeStatus(5, 2, 1, None, 0.5, 2, 80, None, neighbours, origins, next_hop=9)
    assert len(encode_status(status)) == 90
    short = encode_status(status, 81)
    assert len(short) == 80
    read = decode_status(short)
    assert list(read.neighbours) == [9, 1, 2, 3, 4, 5, 6, 7]
    assert list(read.alone_by_origin) == [1, 2, 3, 4, 5, 6, 7, 8]
    assert read.next_hop == 9

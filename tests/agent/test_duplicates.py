"""Copies and echoes."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from rass_mav.app.duplicates import MAX_REMEMBERED, WINDOW_S, Duplicates
from rass_mav.mavlink.frames import Frame, FrameReader, FrameWriter
from rass_mav.mavlink.messages import TUNNEL
from rass_mav.mavlink.signing import Signer


def frame(payload: bytes, sequence: int = 0, system_id: int = 1) -> Frame:
    return Frame(TUNNEL, sequence, system_id, 191, payload, False)


def test_a_copy_is_known_and_the_same_words_said_again_are_not() -> None:
    duplicates = Duplicates()
    assert duplicates.is_new(frame(b"a", 0), 0.0)
    assert not duplicates.is_new(frame(b"a", 0), 0.1)
    assert duplicates.is_new(frame(b"a", 1), 0.2)
    assert duplicates.is_new(frame(b"a", 0, system_id=2), 0.2)
    assert (duplicates.heard_twice, duplicates.echoes) == (1, 0)


def test_what_goes_round_for_ever_is_never_new_again() -> None:
    duplicates = Duplicates()
    assert duplicates.is_new(frame(b"a"), 0.0)
    for n in range(1, 1000):
        assert not duplicates.is_new(frame(b"a"), n * 0.9 * WINDOW_S)
    assert duplicates.is_new(frame(b"a"), 1000 * WINDOW_S)


def test_own_frames_that_come_back_are_echoes() -> None:
    for signer in (None, Signer(bytes(32), 1, 1000)):
        duplicates = Duplicates()
        said = FrameWriter(7, 191, signer).tunnel(b"mine\0\0", payload_type=33200)
        duplicates.sent(said, 0.0)
        [heard] = FrameReader().feed(said)
        assert not duplicates.is_new(heard, 0.1)
        assert not duplicates.is_new(heard, 0.2)
        assert (duplicates.heard_twice, duplicates.echoes) == (0, 2)


@given(st.lists(st.integers(0, 5000), max_size=300))
def test_memory_is_bounded(numbers: list[int]) -> None:
    duplicates = Duplicates()
    for n in [*range(MAX_REMEMBERED), *numbers]:
        duplicates.is_new(frame(n.to_bytes(4, "big")), 0.0)
    assert len(duplicates) <= MAX_REMEMBERED

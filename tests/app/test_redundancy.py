"""Files of which some data may be lost: any K of N of each stripe give them back."""

from __future__ import annotations

import random
import sys
from collections.abc import Iterator
from hashlib import sha256

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.app.redundancy import parse_redundancy, restored, shares_of
from rass_mav.errors import ConfigError, RassError
from rass_mav.wire.file import PLAIN, Cut, cut_file


def shares(content: bytes, cut: Cut, piece: int = 1000) -> dict[int, bytes]:
    def pieces() -> Iterator[bytes]:
        for at in range(0, len(content), piece):
            yield content[at : at + piece]

    stream = b"".join(shares_of(pieces(), cut))
    assert len(stream) == cut.total()
    return {index: stream[cut.offset(index) : cut.offset(index) + cut.size(index)] for index in cut.indexes()}


def cut_of(content: bytes, most: int, redundancy: tuple[int, int]) -> Cut:
    return cut_file(len(content), len(content), sha256(content).digest(), PLAIN, most, redundancy)


@given(st.binary(min_size=1, max_size=400), st.integers(1, 60), st.integers(1, 6), st.integers(1, 6), st.randoms())
def test_any_k_of_n_give_a_stripe_back(content: bytes, most: int, k: int, more: int, rng: random.Random) -> None:
    cut = cut_of(content, most, (k, k + more))
    found = b""
    kept = set()
    for stripe in range(cut.stripes):
        there = {i % cut.shares: i for i in shares(content, cut, 7) if i // cut.shares == stripe}
        zeros = k - min(k, cut.parts - stripe * k)
        chosen = rng.sample(sorted(there), k - zeros)
        kept |= {there[place] for place in chosen}
        data = shares(content, cut)
        parts = restored({place: data[there[place]] for place in chosen}, stripe, cut)
        assert parts is not None
        found += parts
        assert restored({place: data[there[place]] for place in chosen[1:]}, stripe, cut) is None
    assert found == content
    assert cut.enough(kept) == cut.parts
    assert cut.enough(sorted(kept)[1:]) == cut.parts - 1


def test_a_file_fills_its_stripes() -> None:
    cut = cut_of(bytes(6_000_000), 1 << 15, (8, 12))
    assert cut.parts % 8 == 0
    assert cut.data() == cut.parts * 12 // 8


def test_a_wrong_redundancy_says_what_was_expected() -> None:
    assert parse_redundancy("8/12") == (8, 12)
    for text in ("8", "12/8", "8/8", "0/4", "-1/4", "8/65", "a/b", ""):
        with pytest.raises(ConfigError, match="--redundancy: expected K/N"):
            parse_redundancy(text)


def test_without_its_package_redundancy_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    content = bytes(range(100))
    cut = cut_of(content, 10, (5, 8))
    data = shares(content, cut)
    monkeypatch.setitem(sys.modules, "zfec", None)
    with pytest.raises(RassError, match=r"zfec.*'\.\[redundancy\]'"):
        parse_redundancy("8/12")
    # Where all parts are there, nothing has to be computed.
    assert restored({place: data[place] for place in range(5)}, 0, cut) == content[:50]
    with pytest.raises(RassError, match="zfec"):
        restored({place: data[place] for place in range(1, 6)}, 0, cut)

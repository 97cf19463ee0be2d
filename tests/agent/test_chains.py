"""Hash chains: every true element is taken, and no other, in whatever order they come."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from rass_mav.trust.chains import HOPS, LENGTH, NUMBERS, Chain, OwnChain, hashed, place

SALT, SEED = b"saltsalt", b"seedseed"
OWN = OwnChain(1, 2, 3, 0xFFF0, SEED, SALT)
#: All elements, by place.
TRUE = [SEED]
while len(TRUE) <= LENGTH:
    TRUE.append(hashed(SALT, TRUE[-1], 1))

places = st.builds(place, st.integers(0, NUMBERS - 1), st.integers(0, 255))


def test_a_base_shows_the_elements_without_a_hop() -> None:
    assert OWN.anchor.element == TRUE[LENGTH]
    # The numbers go round.
    assert [OWN.element((0xFFF0 + index) & 0xFFFF) for index in range(NUMBERS)] == [
        TRUE[place(index, 0)] for index in range(NUMBERS)
    ]
    assert OWN.element(0xFFEF) is OWN.element((0xFFF0 + NUMBERS) & 0xFFFF) is None


def test_more_hops_and_earlier_numbers_are_later_in_the_chain() -> None:
    assert place(NUMBERS - 1, 0) == 0
    for index in range(NUMBERS):
        ways = [place(index, hops) for hops in range(HOPS)]
        assert ways == list(range(ways[0], ways[0] + HOPS))
        assert {place(index, hops) for hops in range(HOPS - 1, 255)} == {ways[-1]}
    assert [place(index, 0) for index in range(NUMBERS)] == list(range(LENGTH - HOPS, -1, -HOPS))


@given(st.lists(st.tuples(places, st.none() | st.binary(min_size=8, max_size=8)), min_size=1, max_size=20))
def test_exactly_the_true_elements_are_taken(claims: list[tuple[int, bytes | None]]) -> None:
    chain = Chain(OWN.anchor, SALT)
    newest = LENGTH
    for at, claim in claims:
        element = TRUE[at] if claim is None else claim
        assert chain.cost(at) == max(0, newest - at)
        assert chain.verify(at, element) == (element == TRUE[at])
        if element == TRUE[at]:
            newest = min(newest, at)
        assert chain.newest == newest
        later = min(newest + 7, LENGTH)
        assert chain.element(later) == TRUE[later]


@given(places, places)
def test_an_element_is_good_for_its_own_place_only(at: int, other: int) -> None:
    chain = Chain(OWN.anchor, SALT)
    assert chain.verify(other, TRUE[at]) == (at == other)


def test_an_element_of_another_chain_is_none() -> None:
    assert not Chain(OWN.anchor, b"tlastlas").verify(0, SEED)


def test_what_a_chain_remembers_is_bounded() -> None:
    chain = Chain(OWN.anchor, SALT)
    assert chain.verify(0, SEED)
    for _ in range(2):
        assert [chain.element(at) for at in range(LENGTH)] == TRUE[:LENGTH]
    assert len(chain.elements) <= 700

"""Which numbers a base announces: each is on disk first, and nobody makes it run round the circle."""

from __future__ import annotations

import itertools

from hypothesis import given
from hypothesis import strategies as st

from rass_mav.core.messages import BEACON_BASE, BEACON_WANTED, NO_ROUTE, Beacon
from rass_mav.core.routes.announcements import (
    ANNOUNCEMENTS_CLAIMED,
    JUMP_TURNS,
    MOST_JUMP,
    Announcements,
    following,
    newer,
)
from tests.some import some

from .build import beacon, make_node
from .durable import DurableStore


def first_said(store: DurableStore) -> tuple[Announcements, int]:
    announcements = Announcements(store, 0)
    store.commit()
    number = some(announcements.turn(None))
    return announcements, number


def test_nothing_is_announced_before_the_first_number_is_on_disk() -> None:
    store = DurableStore(epoch=1)
    announcements = Announcements(store, 1)
    assert [announcements.turn(None) for _ in range(3)] == [None] * 3
    store.commit()
    assert announcements.turn(None) == 1
    assert announcements.turn(None) == 2


def test_the_beacon_of_a_base_says_no_route_until_then() -> None:
    store = DurableStore(epoch=1)
    store.set_meta("something", 1)
    under_way = store.take()
    base = make_node(0, base=True, store=store)
    [silent, *_] = base.step(0.0)
    assert isinstance(silent, Beacon)
    assert (silent.flags, silent.hops) == (BEACON_BASE, NO_ROUTE)
    assert under_way is not None
    store.write(under_way)
    store.commit()
    [said, *_] = base.step(1.0)
    assert isinstance(said, Beacon)
    assert (said.base, said.base_life, said.hops) == (0, base.store.life, 0)


def test_a_number_asked_for_far_ahead_is_said_once_it_is_on_disk() -> None:
    store = DurableStore(epoch=1)
    announcements, number = first_said(store)
    far = number + 30001
    assert announcements.turn(far) == number
    assert announcements.turn(None) == number
    store.commit()
    assert announcements.turn(None) == far
    assert newer(first_said(store.crashed())[1], far)


def test_numbers_are_left_out_seldom_and_never_half_of_the_circle() -> None:
    store = DurableStore(epoch=1)
    announcements, number = first_said(store)
    went, jumps = 0, []
    for turn in range(10 * JUMP_TURNS):
        said = announcements.turn((number + 0x7FFF) & 0xFFFF)
        store.commit()
        assert said is not None
        ahead = (said - number) & 0xFFFF
        assert ahead <= MOST_JUMP
        if ahead > 1:
            jumps.append(turn)
        went += ahead
        number = said
    assert jumps
    assert all(b - a >= JUMP_TURNS - 1 for a, b in itertools.pairwise(jumps))
    assert went <= (len(jumps) * MOST_JUMP) + 10 * JUMP_TURNS


EVENTS = st.sampled_from(["", "", "commit", "crash"])


@given(st.lists(st.tuples(st.none() | st.integers(0, 0xFFFF), EVENTS), max_size=200))
def test_a_restarted_base_goes_on_after_all_that_it_has_said(turns: list[tuple[int | None, str]]) -> None:
    store = DurableStore(epoch=1)
    announcements = Announcements(store, 2)
    last: int | None = None
    fresh = False
    for asked, event in turns:
        if asked is not None and last is not None and (asked - last) & 0xFFFF > 0x8000:
            asked = None
        said = announcements.turn(asked)
        if said is not None:
            claimed = store.disk.meta["announcement"]
            assert (claimed - said) & 0xFFFF <= MOST_JUMP + ANNOUNCEMENTS_CLAIMED
            assert last is None or newer(said, last) or (said == last and not fresh)
            last, fresh = said, False
        if event == "commit":
            store.commit()
        elif event == "crash":
            store, fresh = store.crashed(), True
            announcements = Announcements(store, 2)


def test_a_base_follows_what_others_say_in_its_name_of_its_own_life() -> None:
    base = make_node(0, base=True)
    [said, *_] = base.step(0.0)
    assert isinstance(said, Beacon)
    other = beacon(1, 1)._replace(base=0, base_life=said.life, hops=3)
    for number, life in ((said.route_number, said.life), (30000, said.life ^ 1), (said.route_number - 1, said.life)):
        base.receive(other._replace(route_number=number & 0xFFFF, base_life=life, number=other.number + 1), 1.0)
        assert base.routing.requested is None
    base.receive(other._replace(route_number=30000, number=9), 1.0)
    base.step(1.0)
    base.store.commit()  # type: ignore[attr-defined]
    base.step(2.0)
    assert base.routing.number == 30001


def test_many_requests_in_a_turn_are_one() -> None:
    base = make_node(0, base=True, seq_period=0)
    base.step(0.0)
    number = base.routing.number
    for n in range(200):
        wanted = following(base.routing.number)
        base.receive(beacon(1, n, flags=BEACON_WANTED, wanted=(0, wanted)), 0.5)
    base.step(1.0)
    assert base.routing.number == following(number)


# -- numbers on a circle -----------------------------------------------------------------------------------------------

numbers = st.integers(0, 0xFFFF)


@given(numbers, st.integers(1, 0x7FFF))
def test_up_to_half_the_circle_ahead_is_newer_across_the_wrap(a: int, ahead: int) -> None:
    b = (a + ahead) & 0xFFFF
    assert newer(b, a)
    assert not newer(a, b)


@given(numbers)
def test_equal_and_opposite_numbers_are_not_newer_either_way(a: int) -> None:
    opposite = (a + 0x8000) & 0xFFFF
    assert not newer(a, a)
    assert not newer(a, opposite)
    assert not newer(opposite, a)


@given(numbers)
def test_the_following_number_is_newer(a: int) -> None:
    assert newer(following(a), a)
    assert 0 <= following(a) <= 0xFFFF

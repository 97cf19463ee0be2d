from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.config.typed import build
from rass_mav.core.datum import DatumId
from rass_mav.core.messages import NO_ROUTE, UNBOUNDED_FREE, Beacon
from rass_mav.core.policy import POTENTIAL_BASE, POTENTIAL_ONE, Policy, View
from rass_mav.core.routes.neighbours import Neighbour
from rass_mav.errors import ConfigError
from rass_mav.policy.settings import PolicySettings, kinds

IDS = [DatumId(1, 1, n) for n in range(20)]


def neighbour(id: int, potential: int, *, tag: int, free: int = 50, hops: int = NO_ROUTE) -> Neighbour:
    return Neighbour(Beacon(id, 1, 0, 0, 0, 0, 0, hops, 0, 0, 0, free, tag, potential, 0), 0.0)


def view(*neighbours: Neighbour, potential: int, budget: int = 10, risk: float = 0.0, seed: int = 0) -> View:
    return View(neighbours, None, 3, potential, risk, budget, lambda neighbour: iter(IDS), random.Random(seed))


@pytest.mark.parametrize(
    ("name", "hops", "risk", "fitness"),
    [("rass", 2, 0.3, 0.2), ("rass-literal", 2, 0.3, 1 / 20.3), ("hop-count", 2, 0.3, 0.5), ("rass", 1, 0.2, 1 / 3)],
)
def test_eq_3_by_hand(name: str, hops: int, risk: float, fitness: float) -> None:
    policy = PolicySettings(name=name).make()
    assert policy.potential(hops, risk, 1) == round(fitness * POTENTIAL_ONE)
    assert policy.potential(hops, risk, 0) == 0


def test_without_a_route_any_route_is_fitter() -> None:
    policy = PolicySettings(name="hop-count").make()
    assert 0 < policy.potential(NO_ROUTE, 0.0, 1) < policy.potential(250, 0.0, 1)


@given(
    st.sampled_from(["rass", "rass-literal", "hop-count"]), st.integers(0, 255), st.floats(0, 1), st.integers(1, 65535)
)
def test_a_drone_with_room_is_fitter_than_a_full_one_and_less_than_a_base(
    name: str, hops: int, risk: float, free: int
) -> None:
    assert 0 < PolicySettings(name=name).make().potential(hops, risk, free) < POTENTIAL_BASE


def test_huge_weights_do_not_make_a_node_look_full() -> None:
    assert PolicySettings(name="rass", alpha=1e9).make().potential(200, 1.0, 1) > 0


@pytest.mark.parametrize(("threshold", "moves"), [(1.0, True), (1.49, True), (1.5, False), (2.0, False)])
def test_eq_4_needs_a_neighbour_above_t_times_the_own_fitness(threshold: float, moves: bool) -> None:
    policy = PolicySettings(name="rass", threshold=threshold).make()
    plan = policy.plan(view(neighbour(2, 300, tag=policy.tag), potential=200))
    assert bool(plan) == moves


def test_an_equal_neighbour_gets_nothing() -> None:
    policy = PolicySettings(name="rass").make()
    own = policy.potential(1, 0.2, 50)
    assert policy.plan(view(neighbour(2, own, tag=policy.tag), potential=own)) == []


def test_all_goes_to_the_fittest_oldest_first_within_budget_and_room() -> None:
    policy = PolicySettings(name="rass").make()
    around = neighbour(2, 300, tag=policy.tag), neighbour(3, 400, tag=policy.tag, free=4)
    plan = policy.plan(view(*around, potential=100))
    assert [(t.id, t.neighbour) for t in plan] == [(id, 3) for id in IDS[:4]]
    base = neighbour(0, POTENTIAL_BASE, tag=policy.tag, free=UNBOUNDED_FREE)
    assert len(policy.plan(view(base, potential=100, budget=7))) == 7


def test_equals_are_chosen_among_by_the_generator() -> None:
    policy = PolicySettings(name="rass").make()
    around = [neighbour(n, 300, tag=policy.tag) for n in range(2, 6)]
    chosen = {policy.plan(view(*around, potential=1, seed=seed))[0].neighbour for seed in range(60)}
    assert chosen == {2, 3, 4, 5}


def test_another_policys_numbers_are_not_believed_but_its_hops_are() -> None:
    policy = PolicySettings(name="rass").make()
    own = policy.potential(3, 0.1, 50)
    boasts = neighbour(2, POTENTIAL_BASE - 1, tag=policy.tag ^ 1, hops=4)
    closer = neighbour(3, 1, tag=policy.tag ^ 1, hops=2)
    assert policy.plan(view(boasts, potential=own, risk=0.1)) == []
    assert policy.plan(view(boasts, closer, potential=own, risk=0.1))[0].neighbour == 3
    full = neighbour(4, 0, tag=policy.tag ^ 1, hops=1)
    assert policy.plan(view(full, potential=own, risk=0.1)) == []


def test_tags_tell_weights_apart() -> None:
    assert len({PolicySettings(name=name).make().tag for name in kinds()}) == len(kinds())
    assert PolicySettings(name="rass").make().tag != PolicySettings(name="rass", alpha=2.0).make().tag
    # T is one's own business: it does not change what a potential means.
    assert PolicySettings(name="rass").make().tag == PolicySettings(name="rass", threshold=2.0).make().tag


def test_under_stigmergy_nothing_is_handed_over() -> None:
    policy: Policy = PolicySettings(name="stigmergy").make()
    assert policy.plan(view(neighbour(2, 1, tag=policy.tag), potential=1, budget=15)) == []


def test_wrong_configurations_name_the_key() -> None:
    with pytest.raises(ConfigError, match=r"^name: expected one of hop-count, rass, .*, got 'ras'$"):
        build({"name": "ras"}, PolicySettings)
    with pytest.raises(ConfigError, match=r"^policy\.alpha"):
        PolicySettings(name="rass", alpha=0.0, beta=0.0).make()

"""Routes that the ground has vouched for: what a node takes from others, and what it shows."""

from __future__ import annotations

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rass_mav.core.messages import BEACON_BASE, NO_ROUTE, Beacon
from rass_mav.core.policy import POTENTIAL_BASE
from rass_mav.core.store import Store
from rass_mav.store.memory import MemoryStore
from rass_mav.trust.chains import HOPS, LENGTH, NUMBERS
from rass_mav.trust.route_proofs import HASHES_A_TURN, LAG, LAG_A_HOP, MAX_BASES, MOST_HASHES, RouteProofs
from rass_mav.wire.attestation import Anchor, Signed, body_of, decode_attestation

from .ground_net import BASE_ATTESTATION, DRONE_ATTESTATION, member

STREAM = (9, 191, 0)
LIFE = 0xBA5E


class Base:
    """A base's side, and everything that it has announced."""

    def __init__(self, store: Store | None = None, first: int = 100) -> None:
        self.store = MemoryStore(LIFE) if store is None else store
        self.announced = RouteProofs(1, BASE_ATTESTATION, self.store, random.Random(1))
        self.number = first
        self.anchors: list[Signed] = []

    def beacon(self, number: int | None = None) -> Beacon:
        """Its beacon with the next number."""
        if number is None:
            number = self.number = (self.number + 1) & 0xFFFF
        life = self.store.life
        beacon = self.announced.shown(
            Beacon(1, life, number, BEACON_BASE, 1, life, number, 0, 0, 0, 0, 0xFFFF, 7, POTENTIAL_BASE, 0)
        )
        self.sent()
        return beacon

    def sent(self) -> None:
        for payload in self.announced.turn()[0]:
            signed = decode_attestation(payload)
            assert isinstance(signed, Signed)
            self.anchors.append(signed)


class Drone:
    """A drone's side, with a node that hears what it lets pass."""

    def __init__(self, node_id: int = 7) -> None:
        self.node = member(node_id).node
        self.announced = RouteProofs(node_id, DRONE_ATTESTATION, MemoryStore(node_id), random.Random(node_id))
        self.id = node_id

    def learns(self, base: Base) -> None:
        for signed in base.anchors:
            assert DRONE_ATTESTATION.anchors(signed.body, signed.signature)
            if self.announced.is_news(signed, STREAM):
                self.announced.learn(signed, STREAM, None)

    def hears(self, beacon: Beacon, stream: tuple[int, int, int] = STREAM) -> Beacon:
        return self.announced.heard(beacon, stream, self.node)

    def takes(self, beacon: Beacon, stream: tuple[int, int, int] = STREAM) -> bool:
        heard = self.hears(beacon, stream)
        assert (heard.hops, heard.route_number) in ((beacon.hops, beacon.route_number), (NO_ROUTE, 0))
        return heard.hops != NO_ROUTE

    def relays(self, heard: Beacon, hops: int | None = None) -> Beacon:
        """The beacon of a drone whose next hop has sent `heard`."""
        own = heard._replace(
            sender=self.id, life=self.id, flags=0, potential=1 << 20, proof=b"",
            hops=heard.hops + 1 if hops is None else hops,
        )  # fmt: skip
        return self.announced.shown(own)


def test_a_route_goes_from_hop_to_hop() -> None:
    base, drones = Base(), [Drone(n) for n in range(2, 45)]
    beacon = base.beacon()
    assert len(beacon.proof) == 8
    for drone in drones:
        drone.learns(base)
        assert drone.hears(beacon)[:11] == beacon[:11]
        beacon = drone.relays(beacon)
    assert beacon.hops == 43, "it has passed the last hop count that chains tell apart"


def test_without_the_anchor_there_is_no_route_and_it_is_asked_for() -> None:
    base, drone = Base(), Drone()
    beacon = base.beacon()
    assert not drone.takes(beacon)
    source = (1, base.store.life)
    assert drone.announced.turn() == ([], (source,))
    assert drone.announced.turn() == ([], ())
    for _ in range(8):
        base.sent()
    base.anchors.clear()
    base.announced.asked(source, STREAM)
    for _ in range(4):
        base.sent()
    assert len(base.anchors) == 1
    drone.learns(base)
    assert drone.takes(beacon)


@pytest.mark.no_cover
@settings(max_examples=60)
@given(
    heard=st.lists(st.tuples(st.integers(0, 90), st.integers(0, 40)), min_size=1, max_size=6),
    claim=st.tuples(st.integers(0, 127), st.integers(0, 40)),
    source=st.integers(0, 5),
)
def test_nobody_claims_more_than_what_he_has_heard(
    heard: list[tuple[int, int]], claim: tuple[int, int], source: int
) -> None:
    """An attacker has heard some (number, hops), computes what he can from them, or shows them as they are."""
    base = Base(first=100)
    by_number = {index: base.beacon() for index in range(128)}
    attacker, victim = Drone(66), Drone(67)
    attacker.learns(base)
    victim.learns(base)
    taught = []
    for index, hops in sorted(heard, key=lambda one: (-one[0], one[1])):
        relay = Drone(50)
        relay.learns(base)
        assert relay.takes(by_number[index])
        told = relay.relays(by_number[index], hops or 1)
        if attacker.takes(told):
            taught.append((index, told))
    index, hops = claim
    honest = attacker.relays(by_number[index], hops or 1)
    copied = honest._replace(proof=taught[source % len(taught)][1].proof) if taught else honest
    for beacon in (honest, copied):
        if beacon.proof and victim.takes(beacon):
            least = min(min(told.hops, HOPS - 1) for at, told in taught if at >= index)
            newer = any(at > index for at, _ in taught)
            assert newer or min(beacon.hops, HOPS - 1) >= least


@pytest.mark.parametrize("change", [
    {"sender": 3}, {"life": 3}, {"flags": 0}, {"base": 2}, {"base_life": 2}, {"route_number": 102},
    {"route_number": 100}, {"proof": b""}, {"proof": bytes(8)}, {"hops": 1}, {"hops": 40},
])  # fmt: skip
def test_nobody_else_shows_the_beacon_of_a_base(change: dict[str, int | bytes]) -> None:
    base, drone = Base(), Drone()
    beacon = base.beacon()
    drone.learns(base)
    heard = drone.hears(beacon._replace(**change))  # type: ignore[arg-type]
    assert (heard.hops, heard.base, heard.base_life, heard.route_number) == (NO_ROUTE, 0, 0, 0)
    assert not heard.flags & BEACON_BASE
    assert drone.takes(beacon)


def test_an_old_way_is_worthless_when_newer_numbers_are_known() -> None:
    base, drone, thief = Base(), Drone(), Drone(8)
    old = base.beacon()
    thief.learns(base)
    assert thief.takes(old)
    near = thief.relays(old)
    for _ in range(LAG + LAG_A_HOP):
        now = base.beacon()
    drone.learns(base)
    assert drone.takes(near)
    assert drone.takes(now)
    assert drone.takes(near), "a slow neighbour"
    assert drone.takes(base.beacon())
    drone.announced.turn()
    assert not drone.takes(near)


def test_a_chain_is_followed_by_the_next_without_a_gap() -> None:
    base, drone = Base(first=0xFFFF - 3 * NUMBERS // 2), Drone()
    for _ in range(5 * NUMBERS):
        beacon = base.beacon()
        drone.learns(base)
        assert drone.takes(beacon)
        drone.announced.turn()
    assert len({signed.content for signed in base.anchors}) == 6


def test_a_base_that_starts_again_never_shows_a_chain_twice() -> None:
    base, drone = Base(), Drone()
    for restart in range(5):
        for _ in range(3):
            beacon = base.beacon()
            drone.learns(base)
            assert drone.takes(beacon), restart
        # Its number goes on after all that it has claimed.
        base = Base(base.store, base.number + 256)
        beacon = base.beacon()
        drone.learns(base)
        assert drone.takes(beacon)


def test_a_base_whose_disk_was_set_back_goes_on_after_what_it_hears() -> None:
    base, drone = Base(), Drone()
    image = MemoryStore(LIFE)
    assert image.life == base.store.life
    for _ in range(300):
        late = base.beacon()
    drone.learns(base)
    assert drone.takes(late)
    again = Base(image)
    assert not drone.takes(again.beacon())
    for signed in base.anchors:
        again.announced.learn(signed, STREAM, None)
    assert again.announced.heard(drone.relays(late), STREAM, None).hops == 1, "core takes the number from here"
    again.anchors.clear()
    beacon = again.beacon(late.route_number + 1)
    drone.learns(again)
    assert drone.takes(beacon)


@pytest.mark.no_cover
def test_a_drone_that_was_away_for_a_day() -> None:
    """At two steps a number, as under `survival`. It computes no more than one chain, and compares no old numbers."""
    base, drone = Base(), Drone()
    first = base.beacon()
    drone.learns(base)
    routing = drone.node.routing
    routing.hear(drone.hears(first), 1000.0)
    routing.hear(drone.hears(first._replace(number=first.number + 1)), 1001.0)
    routing.update(1001.0)
    assert routing.route is not None
    routing.announced(1001.0)
    for _ in range(43_200):
        beacon = base.beacon()
    before = drone.announced.hashes
    drone.announced.learn(base.anchors[-2], STREAM, None)
    drone.announced.learn(base.anchors[-1], STREAM, None)
    assert drone.takes(beacon)
    assert before - drone.announced.hashes <= LENGTH
    # The numbers are more than half of their circle apart.
    routing.hear(beacon, 90_000.0)
    routing.hear(beacon._replace(number=beacon.number + 1 & 0xFFFF), 90_001.0)
    routing.update(90_001.0)
    assert routing.route is not None
    assert routing.route.number == beacon.route_number


def test_what_false_claims_cost_is_bounded() -> None:
    base, drone = Base(), Drone()
    now = base.beacon()
    drone.learns(base)
    assert drone.takes(now)
    ahead = now._replace(route_number=now.route_number + NUMBERS - 10, proof=bytes(8))
    near = now._replace(route_number=now.route_number + 1, proof=bytes(8))
    for turn in range(20):
        before = drone.announced.hashes
        for _ in range(100):
            # A captured drone, under its own name, and under many.
            assert not drone.takes(ahead)
            assert not drone.takes(near, (turn, 1, 1))
        assert before - drone.announced.hashes <= 4 * LENGTH
        true = base.beacon()
        drone.learns(base)
        assert drone.takes(true, (200, 1, 1)), "what is true, from somebody else"
        drone.announced.turn()
    assert HASHES_A_TURN < MOST_HASHES


@pytest.mark.no_cover
def test_bases_are_bounded_and_anchors_that_are_not_signed_are_not_learnt() -> None:
    drone = Drone()
    for life in range(MAX_BASES + 5):
        body = body_of(Anchor(1, life, 0, 0, bytes(8)))
        drone.announced.learn(
            Signed(body[1], Anchor(1, life, 0, 0, bytes(8)), body, BASE_ATTESTATION.anchor(body)), STREAM, None
        )
    assert len(drone.announced.bases) == MAX_BASES
    for life in range(1000):
        drone.takes(Base().beacon()._replace(base_life=life, base=9, hops=3))
    assert len(drone.announced.turn()[1]) <= 4


@pytest.mark.parametrize(("hops", "potential", "least"), [
    (1, 1, 52429), (3, 1, 3 * 52429), (3, 1 << 20, 1 << 20), (NO_ROUTE, 1, 5242900),
])  # fmt: skip
def test_nobody_is_safer_than_without_risk(hops: int, potential: int, least: int) -> None:
    """`survival` adds up 0.05 a hop, in units of 2^-20; staying counts as a hundred hops."""
    base, drone, other = Base(), Drone(), Drone(8)
    beacon = base.beacon()
    for one in (drone, other):
        one.learns(base)
        assert one.takes(beacon)
    told = other.relays(beacon, hops)._replace(potential=potential, policy=drone.node.policy.tag)
    assert drone.hears(told).potential == least
    # Numbers of another policy mean nothing, but none says that its node is a base.
    assert drone.hears(told._replace(potential=POTENTIAL_BASE, policy=1)).potential == POTENTIAL_BASE - 1

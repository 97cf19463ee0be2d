"""Which routes in beacons the ground has vouched for, and what this node shows for its own.

docs/reference/protocol-keys.md ("Chains of announcements") has the rules. A beacon whose route is not shown
to be heard is heard as that of a node without a route.
"""

from __future__ import annotations

import random
from typing import TYPE_CHECKING

from rass_mav.core.gossip import Gossip
from rass_mav.core.messages import BEACON_BASE, NO_ROUTE, Beacon
from rass_mav.core.participant import Participant
from rass_mav.core.policy import POTENTIAL_BASE, Policy
from rass_mav.core.routes.announcements import following, newer
from rass_mav.core.store import Store
from rass_mav.mavlink.frames import Stream
from rass_mav.trust.chains import HOPS, LENGTH, NUMBERS, Chain, OwnChain, place
from rass_mav.trust.sessions import UNPROVEN
from rass_mav.trust.statement_signatures import in_turn
from rass_mav.wire.attestation import MAX_BASES_ASKED, Anchor, Signed, body_of

if TYPE_CHECKING:
    from rass_mav.trust.keys.attestation import Attestation

#: Bases whose chains are known, and chains of each: the last, the present and the next one.
MAX_BASES, MAX_CHAINS = 16, 3
#: A base announces its next chain when so many numbers of the last one are used.
AHEAD = NUMBERS // 2
# Tuned: python -m tools.sensitivity trust.route_proofs
#: A route may be so many numbers older than the newest one heard for each of its hops, and as many as for two more.
LAG_A_HOP = 2
LAG = 2 * LAG_A_HOP
#: Bound: Hashes that may be computed for newer numbers: at most, and more in each turn. A claim that takes more than
#: `SMALL` must leave half of them.
MOST_HASHES, HASHES_A_TURN, SMALL = 2 * LENGTH, 512, 4 * HOPS
#: Bound: False claims of one stream that are looked at in a turn, and of all streams together in which no node has
#: proved itself. A captured drone thus cannot use up what is computed in a turn.
MAX_FALSE, UNPROVEN_FALSE = 2, 1
#: Fact: Chains after which 16 bits do not tell any more which of two announcement numbers is the later one.
FAR = (1 << 13) // NUMBERS
#: Bound: How many serials of chains a base claims on disk at a time.
SERIALS_CLAIMED = 64
#: Turns from one anchor that leaves to the next, at least: the period of their gossip.
PERIOD = 2
#: Turns until an anchor is asked for again.
ASK_TURNS = 6
#: Bound: Anchors of bases that no neighbour announces: so many are relayed at once, and in the long run one in so many
#: turns. Others are sent when they are asked for.
UNNAMED_AT_ONCE, UNNAMED_TURNS = 4.0, 6
#: Bases whose anchors this node lacks, at most, and those that one stream has named.
MAX_LACKING, MAX_LACKING_OF_ONE = 64, 4
_KEY = "chain"

#: Node id and life of a base.
_Source = tuple[int, int]


class _Base:
    """What a node knows of the announcements of one base."""

    __slots__ = ("chains", "serial")

    def __init__(self) -> None:
        self.chains: dict[int, Chain] = {}
        """By serial, ascending."""
        self.serial: int | None = None
        """Of the newest chain from which an element was heard."""

    def lag(self, chain: Chain, number: int) -> int:
        """By how much an announcement number of a chain is behind the newest one heard; 0: it is not."""
        newest = None if self.serial is None or self.serial not in self.chains else self.chains[self.serial].number
        if newest is None or self.serial is None or chain.anchor.serial > self.serial:
            return 0
        behind = (newest - number) & 0xFFFF
        # In one chain the later number may be the lower one.
        return 0 if behind >= NUMBERS and chain.anchor.serial == self.serial else behind

    def chain_of(self, number: int) -> Chain | None:
        """The newest chain that has an announcement number."""
        for chain in reversed(self.chains.values()):
            if chain.index(number) is not None:
                return chain
        return None


class RouteProofs:
    """The chains of bases, those of this node included if it is one."""

    __slots__ = (
        "_attestation",
        "_begun",
        "_claimed",
        "_durable",
        "_false",
        "_lacking",
        "_node_id",
        "_own",
        "_rng",
        "_seen",
        "_serial",
        "_store",
        "_turns",
        "_unnamed",
        "bases",
        "gossip",
        "hashes",
        "refused",
    )  # fmt: skip

    def __init__(self, node_id: int, attestation: Attestation, store: Store, rng: random.Random) -> None:
        """`store`: of the node; at a base it keeps which chains have begun."""
        self._node_id = node_id
        self._attestation = attestation
        self._store = store
        self._rng = rng
        self._turns = 0
        self.bases: dict[_Source, _Base] = {}
        """The one heard last is the last."""
        self.gossip: Gossip[tuple[int, int, int], bytes] = Gossip(rng, period=PERIOD)
        """The anchors to send, by base, base life and serial."""
        self._lacking: dict[_Source, tuple[int, Stream]] = {}
        """Bases whose anchors are lacking, from which turn on they may be asked for, and who has named them first."""
        self._unnamed = UNNAMED_AT_ONCE
        """How many anchors of bases that no neighbour announces may be relayed now."""
        self.hashes = MOST_HASHES
        self._false: dict[Stream, int] = {}
        """False claims in this turn."""
        self._seen: set[tuple[_Source, int, int, bytes]] = set()
        """Claims that were found true in this turn."""
        self.refused = 0
        """Beacons whose routes the ground has not signed."""
        self._own: list[OwnChain] = []
        """At a base: the present chain, and the next one."""
        self._begun: list[bytes] = []
        """At a base: the anchors of chains that begin in this turn. They leave at once: no other node knows them."""
        self._serial = self._claimed = 0
        self._durable = 0
        """Chains with lower serials may begin: this is on disk."""
        if attestation.speaks:
            self._serial = self._claimed = store.get_meta(_KEY) or 0
            self._claim()

    # -- what comes in -------------------------------------------------------------------------------------------------

    def heard(self, beacon: Beacon, stream: Stream, node: Participant | None) -> Beacon:
        """A neighbour's beacon as core should hear it."""
        if beacon.sender == self._node_id:
            return beacon
        if beacon.hops != NO_ROUTE and not self._is_shown(beacon, stream, node):
            self.refused += 1
            beacon = beacon._replace(base=0, base_life=0, route_number=0, hops=NO_ROUTE)
        if node is None:
            return beacon
        flags, potential, wanted = beacon.flags, beacon.potential, beacon.wanted_number
        if node.base and newer(wanted, node.routing.number):
            # No node has heard a number that this base has not announced, if it is asked for one of its own.
            wanted = following(node.routing.number)
        if beacon.hops:
            flags &= ~BEACON_BASE
            potential = _bounded(beacon, node.policy)
        if potential != beacon.potential or wanted != beacon.wanted_number or flags != beacon.flags:
            beacon = beacon._replace(flags=flags, potential=potential, wanted_number=wanted)
        return beacon

    def _is_shown(self, beacon: Beacon, stream: Stream, node: Participant | None) -> bool:
        """Whether the sender has heard of its route, as far as hash chains show that."""
        source, number, hops = (beacon.base, beacon.base_life), beacon.route_number, beacon.hops
        if not beacon.proof:
            return False
        claim = (source, number, hops, beacon.proof)
        if hops and claim in self._seen:
            return True
        if not hops and (source != (beacon.sender, beacon.life) or not beacon.flags & BEACON_BASE):
            return False
        base = self.bases.get(source)
        chain = None if base is None else base.chain_of(number)
        if base is None or chain is None:
            if source not in self._lacking and len(self._lacking) < MAX_LACKING:
                of_one = sum(by == stream for _, by in self._lacking.values())
                if of_one < MAX_LACKING_OF_ONE:
                    self._lacking[source] = 0, stream
            return False
        index = chain.index(number)
        assert index is not None
        if base.lag(chain, number) > LAG + LAG_A_HOP * hops:
            # Its sender heard that when it was nearer.
            return False
        at = place(index, hops)
        cost = chain.cost(at)
        if cost and not self._affords(cost, stream):
            return False
        if not chain.verify(at, beacon.proof):
            self._false[stream] = self._false.get(stream, 0) + 1
            return False
        serial = chain.anchor.serial
        if base.serial is None or serial > base.serial:
            if node is not None and base.serial is not None and serial - base.serial >= FAR:
                node.routing.forget(*source)
            base.serial = serial
            self.bases[source] = self.bases.pop(source)
        self._seen.add(claim)
        return True

    def _affords(self, cost: int, stream: Stream) -> bool:
        most = UNPROVEN_FALSE if stream == UNPROVEN else MAX_FALSE
        if self._false.get(stream, 0) >= most or cost + (MOST_HASHES // 2 if cost > SMALL else 0) > self.hashes:
            return False
        self.hashes -= cost
        return True

    def is_news(self, signed: Signed, stream: Stream) -> bool:
        """Whether it is worth to verify an anchor that a quota holder brings."""
        assert isinstance(signed.content, Anchor)
        source, serial = signed.content[:2], signed.content.serial
        base = self.bases.get(source)
        if base is None:
            return True
        chain = base.chains.get(serial)
        if chain is None:
            return len(base.chains) < MAX_CHAINS or serial > min(base.chains)
        if chain.signed == signed.payload and stream != UNPROVEN:
            self.gossip.hear(signed.content[:3], stream)
        return False

    def learn(self, signed: Signed, stream: Stream, node: Participant | None) -> None:
        """An anchor whose signature is good, and which is news. It may be an old recording."""
        anchor = signed.content
        assert isinstance(anchor, Anchor)
        source, serial = anchor[:2], anchor.serial
        named = _named(node) | {(self._node_id, self._store.life)}
        if not self._add(anchor, signed.payload, named):
            return
        # A sender of old ones does not make all nodes relay them.
        if source not in named and self._unnamed >= 1.0:
            self._unnamed -= 1.0
            named.add(source)
        if source in named:
            self.gossip.add(anchor[:3], signed.payload, stream, self._turns)
        if self._attestation.speaks and source == (self._node_id, self._store.life) and serial >= self._serial:
            # The disk was set back.
            self._own.clear()
            self._serial = serial + 1
            self._claim()

    def _add(self, anchor: Anchor, signed: bytes, named: set[_Source]) -> bool:
        """Whether there is space for an anchor."""
        source = anchor[:2]
        base = self.bases.get(source)
        if base is None:
            if len(self.bases) >= MAX_BASES:
                useless = next((other for other in self.bases if other not in named), None)
                if useless is None:
                    return False
                del self.bases[useless]
            base = self.bases[source] = _Base()
        base.chains[anchor.serial] = Chain(anchor, self._attestation.chain_salt(*anchor[:3]), signed)
        base.chains = dict(sorted(base.chains.items())[-MAX_CHAINS:])
        self._lacking.pop(source, None)
        return True

    def asked(self, source: _Source, stream: Stream) -> None:
        """A neighbour lacks the anchors of a base."""
        base = self.bases.get(source)
        for chain in () if base is None else list(base.chains.values())[-2:]:
            self.gossip.add(chain.anchor[:3], chain.signed, stream, self._turns)

    # -- what goes out -------------------------------------------------------------------------------------------------

    def turn(self) -> tuple[list[bytes], tuple[_Source, ...]]:
        """Once a turn. Returns the anchors to send, as TUNNEL payloads, and the bases to ask for."""
        self._turns += 1
        self.hashes = min(MOST_HASHES, self.hashes + HASHES_A_TURN)
        self._unnamed = min(UNNAMED_AT_ONCE, self._unnamed + 1 / UNNAMED_TURNS)
        self._false.clear()
        self._seen.clear()
        out = self._begun
        self._begun = []
        left = self.gossip.leave(self._turns)
        if left is not None:
            out.append(left[1])
        ready: dict[Stream, list[_Source]] = {}
        for source, (turn, stream) in self._lacking.items():
            if turn <= self._turns:
                ready.setdefault(stream, []).append(source)
        asked = tuple(in_turn(ready, MAX_BASES_ASKED, self._rng))
        for source in asked:
            self._lacking[source] = self._turns + ASK_TURNS, self._lacking[source][1]
        if len(self._lacking) >= MAX_LACKING:
            self._lacking.clear()
        return out, asked

    def shown(self, beacon: Beacon) -> Beacon:
        """This node's own beacon, with what shows that it has heard of its route."""
        if beacon.hops == NO_ROUTE:
            return beacon
        if not beacon.hops:
            element = self._own_element(beacon.route_number) if self._attestation.speaks else None
            return beacon if element is None else beacon._replace(proof=element)
        base = self.bases.get((beacon.base, beacon.base_life))
        chain = None if base is None else base.chain_of(beacon.route_number)
        index = None if chain is None else chain.index(beacon.route_number)
        if chain is None or index is None or (at := place(index, beacon.hops)) < chain.newest:
            return beacon
        return beacon._replace(proof=chain.element(at))

    # -- the chains of a base ------------------------------------------------------------------------------------------

    def _own_element(self, number: int) -> bytes | None:
        if self._store.meta_durable(_KEY):
            self._durable = self._claimed
        while self._own and self._own[0].element(number) is None:
            del self._own[0]
        if not self._own and not self._begin(number):
            return None
        last = self._own[-1].anchor.first
        if (number - last) & 0xFFFF >= AHEAD and len(self._own) == 1:
            self._begin((last + NUMBERS) & 0xFFFF)
        return self._own[0].element(number)

    def _begin(self, first: int) -> bool:
        """Begin a chain, if its serial is on disk: no two chains have one."""
        serial = self._serial
        if serial >= self._durable:
            return False
        self._serial = serial + 1
        if self._claimed - self._serial < SERIALS_CLAIMED // 2:
            self._claim()
        about = (self._node_id, self._store.life, serial)
        chain = OwnChain(*about, first, self._attestation.chain_seed(*about), self._attestation.chain_salt(*about))
        self._own.append(chain)
        body = body_of(chain.anchor)
        signed = body + self._attestation.anchor(body)
        self._add(chain.anchor, signed, {about[:2]})
        self._begun.append(signed)
        self.gossip.spend(self._turns)
        return True

    def _claim(self) -> None:
        self._claimed = self._serial + SERIALS_CLAIMED
        self._store.set_meta(_KEY, self._claimed)


def _named(node: Participant | None) -> set[_Source]:
    """The bases that a node uses, or that its neighbours announce."""
    if node is None:
        return set()
    beacons = (neighbour.beacon for neighbour in node.routing.neighbours.values())
    named = {(beacon.base, beacon.base_life) for beacon in beacons if beacon.hops != NO_ROUTE}
    return named if node.routing.route is None else named | {node.routing.route[:2]}


def _bounded(beacon: Beacon, policy: Policy) -> int:
    """A drone's potential, and no better than that of a node with as many hops, all of them without risk."""
    hops, potential = beacon.hops, beacon.potential
    if beacon.policy != policy.tag:
        return min(potential, POTENTIAL_BASE - 1)
    best = policy.potential(hops, 0.0, 1)
    costs = policy.costs
    if costs is None:
        return min(potential, best)
    return max(potential, int(costs.hold * best) if hops == NO_ROUTE else hops * best)

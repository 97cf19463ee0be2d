"""The attackers, by the names that a scenario gives them, and its section `hostile`."""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Iterable
from typing import Annotated

from rass_mav.config.sections import Count, Meta, Section
from rass_mav.core.datum import REASONS, Datum, DatumId, Fate, make_datum
from rass_mav.core.exchange import mark
from rass_mav.core.messages import (
    BEACON_BASE,
    BEACON_WANTED,
    NO_ROUTE,
    Beacon,
    Committed,
    Data,
    DeletionEntry,
    DeletionReport,
    Handover,
    Message,
    Offer,
    Receipt,
    ReceiptEntry,
)
from rass_mav.core.news.deletion_reports import PROVEN_NOTES_IN_FRAME
from rass_mav.core.news.statements import make_receipt, note_crc
from rass_mav.core.policy import POTENTIAL_BASE
from rass_mav.mavlink.frames import Stream
from rass_mav.mavlink.signing import MAX_TIMESTAMP
from rass_mav.wire.attestation import Anchor, Ask, StatementSignature, body_of, encode_ask
from rass_mav.wire.codec import VERSION
from rass_mav.wire.introduction import CERTIFICATE_BYTES, Introduction, encode_introduction

from .attacker import MAX_REMEMBERED, Attacker, Disguised, Transmission

_AHEAD = 30000
#: A timestamp that no node reaches.
_FAR_AHEAD = 1 << 47


class Sinkhole(Attacker):
    """Claims to be one hop from the base and fitter than any node, confirms every hand-over, and drops the data."""

    def overhear(self, message: Message, payload: bytes, now: float) -> Iterable[Transmission]:
        super().overhear(message, payload, now)
        return self.take(message)

    def turn(self, now: float) -> Iterable[Transmission]:
        base, best = self.base(), 1 if self.costs else POTENTIAL_BASE - 1
        return (
            () if base is None else (self.beacon(base, hops=1, risk=0, free=0xFFFE, potential=best, statements_hash=0),)
        )


class FalseBase(Sinkhole):
    """A sinkhole that claims to be a base itself."""

    def turn(self, now: float) -> Iterable[Transmission]:
        template = self.base()
        if template is None:
            return ()
        own = {"base": self.id, "base_life": self.id, "route_number": 1, "hops": 0}
        return (
            self.beacon(
                template, flags=BEACON_BASE, risk=0, free=0xFFFF, potential=POTENTIAL_BASE, **own, statements_hash=0
            ),
        )


class BlackHole(Sinkhole):
    """Announces what an honest node in its place would announce, confirms every hand-over, and drops the data."""

    def turn(self, now: float) -> Iterable[Transmission]:
        drones = [b for b in self.nodes() if b.hops < 250]
        nearest = min(drones, key=lambda b: (b.hops, b.sender), default=None)
        return () if nearest is None else (self.beacon(nearest, hops=nearest.hops + 1),)


class TwoFaced(Sinkhole):
    """Announces the route of the neighbour nearest to the base as its own, without risk, and confirms every hand-over.
    It hands on what the senders themselves have created, so that they see it arrive, and drops all other data."""

    def begin(self) -> None:
        self._passing: dict[int, Datum] = {}

    def overhear(self, message: Message, payload: bytes, now: float) -> Iterable[Transmission]:
        if isinstance(message, Committed) and message.target == self.id:
            for number, _ in message.committed:
                self._passing.pop(number, None)
        elif isinstance(message, Data) and message.target == self.id and not message.replica:
            for _, datum in message.handovers:
                if self.delivers(datum, message.sender) and len(self._passing) < MAX_REMEMBERED:
                    self._passing[self.rng.getrandbits(32) | 1] = datum
        return super().overhear(message, payload, now)

    def delivers(self, datum: Datum, custodian: int) -> bool:
        """Whether it hands on a datum that it has taken."""
        return datum.id.origin == custodian

    def turn(self, now: float) -> Iterable[Transmission]:
        nearest = min(self.nodes(), key=lambda b: (b.hops, b.sender), default=None)
        if nearest is None or nearest.hops == NO_ROUTE:
            return
        yield self.beacon(nearest, risk=0, free=0xFFFE)
        for number, datum in self._passing.items():
            yield Data(self.id, nearest.sender, (Handover(number, datum),))


class GreyHole(TwoFaced):
    """Announces the same, and hands on a little more than half of all data, whosever they are."""

    SHARE = 0.55

    def delivers(self, datum: Datum, custodian: int) -> bool:
        return self.rng.random() < self.SHARE


class CommittedForger(Attacker):
    """Answers every hand-over that it overhears in the receiver's name, before the receiver can."""

    def overhear(self, message: Message, payload: bytes, now: float) -> Iterable[Transmission]:
        super().overhear(message, payload, now)
        if isinstance(message, Data):
            content_hashes = self.content_hashes
            taken = tuple(
                (number, content_hashes.of(datum, replica=message.replica))
                for number, datum in message.handovers
                if number
            )
            return (Committed(message.target, message.sender, taken, ()),) if taken else ()
        if isinstance(message, Offer):
            return (Committed(message.target, message.sender, ((message.number, message.crc),), ()),)
        return ()


def relayed(data: Data, to: int, rng: random.Random) -> Iterable[Transmission]:
    """What the receiver of a hand-over would send next: the same data to another node. Its sender hears that."""
    handovers = [
        Handover((rng.getrandbits(16) | 1) << 16 | mark(number), datum.arrived())
        for number, datum in data.handovers
        if number and not data.replica
    ]
    return (Data(data.target, to, tuple(handovers)),) if handovers else ()


class RelayForger(Attacker):
    """Hands on what it overhears in the receiver's name, before that one has the datum."""

    def overhear(self, message: Message, payload: bytes, now: float) -> Iterable[Transmission]:
        super().overhear(message, payload, now)
        return relayed(message, self.id, self.rng) if isinstance(message, Data) else ()


class RelayLiar(BlackHole):
    """A black hole that confirms no hand-over: it hands the data on to a node that does not exist."""

    NOBODY = 0xFFFE

    def overhear(self, message: Message, payload: bytes, now: float) -> Iterable[Transmission]:
        taken = super().overhear(message, payload, now)
        if isinstance(message, Data) and message.target == self.id and not message.replica:
            return relayed(message, self.NOBODY, self.rng)
        return taken


class Copier(Attacker):
    """Hands over all that it overhears in its own name, to some other node."""

    def overhear(self, message: Message, payload: bytes, now: float) -> Iterable[Transmission]:
        super().overhear(message, payload, now)
        others = [beacon.sender for beacon in self.nodes()]
        if not isinstance(message, Data) or not others:
            return ()
        copies = tuple(Handover(self.rng.getrandbits(32) | 1, datum) for _, datum in message.handovers)
        return (Data(self.id, self.rng.choice(others), copies),)


class ReceiptForger(Attacker):
    """States in a base's name that the data it has overheard have arrived."""

    EACH_TURN = 8

    def begin(self) -> None:
        self._ids: deque[DatumId] = deque(maxlen=MAX_REMEMBERED)
        self._serial = 1 << 31

    def overhear(self, message: Message, payload: bytes, now: float) -> Iterable[Transmission]:
        super().overhear(message, payload, now)
        if isinstance(message, Data):
            self._ids.extend(datum.id for _, datum in message.handovers)
        return ()

    def turn(self, now: float) -> Iterable[Transmission]:
        base = self.base()
        while base is not None and self._ids:
            some = [self._ids.pop() for _ in range(min(self.EACH_TURN, len(self._ids)))]
            entries = [ReceiptEntry(*id, 1, 0, False) for id in dict.fromkeys(some)]
            self._serial += 1
            yield make_receipt(base.base, base.base_life, self._serial, entries)


class NumberSquatter(Attacker):
    """Hands over data under the numbers that nearby nodes are about to assign."""

    def begin(self) -> None:
        self._last: dict[tuple[int, int], int] = {}

    def overhear(self, message: Message, payload: bytes, now: float) -> Iterable[Transmission]:
        super().overhear(message, payload, now)
        for _, datum in message.handovers if isinstance(message, Data) else ():
            pair = datum.id[:2]
            if pair in self._last or len(self._last) < MAX_REMEMBERED:
                self._last[pair] = max(self._last.get(pair, 0), datum.id.sequence)
        return ()

    def turn(self, now: float) -> Iterable[Transmission]:
        if not self._last:
            return
        for node in self.nodes():
            (origin, epoch), last = self.rng.choice(list(self._last.items()))
            id = DatumId(origin, epoch, (last + self.rng.randint(1, 8)) & 0xFFFFFFFF)
            datum = make_datum(id, 0, now, self.rng.randbytes(20))
            yield Data(self.id, node.sender, (Handover(self.rng.getrandbits(32) | 1, datum),))


class RequestForger(Attacker):
    """Requests announcement numbers far from the base's present one."""

    def turn(self, now: float) -> Iterable[Transmission]:
        base = self.base()
        if base is None:
            return ()
        wanted = {"wanted_base": base.base, "wanted_number": (base.route_number + _AHEAD) & 0xFFFF}
        return (self.beacon(base, flags=BEACON_WANTED, hops=255, base=0, base_life=0, route_number=0, **wanted),)


class Impostor(Attacker):
    """Sends beacons in the base's name, with announcement numbers far ahead."""

    def turn(self, now: float) -> Iterable[Transmission]:
        base = self.base()
        if base is None:
            return ()
        number = (base.route_number + _AHEAD) & 0xFFFF
        return (
            self.beacon(
                base, sender=base.base, life=base.base_life, flags=BEACON_BASE, route_number=number, hops=0,
                potential=POTENTIAL_BASE, free=0xFFFF,
            ),
        )  # fmt: skip


class IdInventor(Attacker):
    """Sends beacons of nodes that do not exist, each twice: those of honest nodes around, under other ids."""

    EACH_TURN = 20

    def begin(self) -> None:
        self._again: list[Beacon] = []

    def turn(self, now: float) -> Iterable[Transmission]:
        for beacon in self._again:
            yield beacon._replace(number=(beacon.number + 1) & 0xFFFF)
        self._again = []
        drones = self.nodes()
        for _ in range(self.EACH_TURN if drones else 0):
            id, life = self.rng.randrange(1000, 65000), self.rng.getrandbits(32)
            self._again.append(self.beacon(self.rng.choice(drones), sender=id, life=life, turn=0xFFFF))
        yield from self._again


class Replayer(Attacker):
    """Repeats what it has overheard, some time later."""

    EACH_TURN = 20
    KEPT = 5000

    def begin(self) -> None:
        self._payloads: deque[bytes] = deque(maxlen=self.KEPT)

    def overhear(self, message: Message, payload: bytes, now: float) -> Iterable[Transmission]:
        self._payloads.append(payload)
        return ()

    def turn(self, now: float) -> Iterable[Transmission]:
        return self.rng.sample(self._payloads, min(self.EACH_TURN, len(self._payloads)))


class JunkCustody(Attacker):
    """Hands over data that no node created, as fast as it can."""

    EACH_TURN = 3

    def turn(self, now: float) -> Iterable[Transmission]:
        for node in self.nodes():
            for _ in range(self.EACH_TURN):
                id = DatumId(self.rng.randrange(1000, 65000), self.rng.getrandbits(32), self.rng.randrange(100))
                datum = make_datum(id, 0, now, self.rng.randbytes(20))
                yield Data(self.id, node.sender, (Handover(self.rng.getrandbits(32) | 1, datum),))


class Blamer(Attacker):
    """Hands over data that no node created, in the names of nodes around it, and as if these had made them."""

    EACH_TURN = 3

    def turn(self, now: float) -> Iterable[Transmission]:
        senders = list(self.beacons)
        for node in self.nodes():
            for _ in range(self.EACH_TURN):
                id = DatumId(self.rng.choice(senders), self.rng.getrandbits(32), self.rng.randrange(100))
                datum = make_datum(id, 0, now, self.rng.randbytes(20))
                yield Data(self.rng.choice(senders), node.sender, (Handover(self.rng.getrandbits(32) | 1, datum),))


class Crowd(Attacker):
    """Sends as a crowd of nodes that do not exist: each has a stream of its own, a beacon, and a false certificate."""

    EACH_TURN = 60
    KEPT = 400

    def begin(self) -> None:
        self._members: deque[tuple[Stream, Beacon]] = deque(maxlen=self.KEPT)

    def turn(self, now: float) -> Iterable[Transmission]:
        rng, drones = self.rng, self.nodes()
        for i in range(self.EACH_TURN if drones else 0):
            if i % 2 or not self._members:
                id, life = rng.randrange(1000, 65000), rng.getrandbits(32)
                stream = (rng.randrange(256), rng.randrange(256), rng.randrange(256))
                self._members.append((stream, self.beacon(rng.choice(drones), sender=id, life=life)))
            stream, beacon = rng.choice(self._members) if i % 2 == 0 else self._members[-1]
            yield Disguised(stream, beacon._replace(number=rng.getrandbits(16)))
            asked = (rng.choice(drones).sender,)
            introduction = Introduction(
                beacon.sender, rng.randbytes(CERTIFICATE_BYTES), asked, True, rng.getrandbits(64)
            )
            yield Disguised(stream, encode_introduction(introduction))


class Flooder(Attacker):
    """Sends all that a radio carries: deletion reports, and messages of every kind with random fields."""

    EACH_TURN = 100

    def turn(self, now: float) -> Iterable[Transmission]:
        rng = self.rng
        for _ in range(self.EACH_TURN):
            target = rng.choice(list(self.beacons) or [0])
            if rng.random() < 0.2:
                id = DatumId(rng.randrange(100), rng.getrandbits(32), rng.getrandbits(32))
                yield DeletionReport(self.id, target, (DeletionEntry(rng.getrandbits(32), id, 1, note_crc(id, 1)),))
                continue
            head = VERSION << 4 | rng.randrange(16)
            yield (
                bytes([head])
                + self.id.to_bytes(2, "little")
                + target.to_bytes(2, "little")
                + rng.randbytes(rng.randrange(100))
            )


class BitFlipper(Attacker):
    """Repeats at once what it overhears, with some bits flipped and a matching checksum."""

    SHARE = 0.3

    def overhear(self, message: Message, payload: bytes, now: float) -> Iterable[Transmission]:
        if self.rng.random() >= self.SHARE:
            return ()
        flipped = bytearray(payload)
        for _ in range(self.rng.randint(1, 3)):
            bit = self.rng.randrange(8 * len(flipped))
            flipped[bit >> 3] ^= 1 << (bit & 7)
        return (bytes(flipped),)


class RouteForger(Attacker):
    """Shows elements of hash chains that it has heard with routes that they do not fit: shorter, later, or its own."""

    EACH_TURN = 4

    def begin(self) -> None:
        self._heard: list[Beacon] = []

    def overhear(self, message: Message, payload: bytes, now: float) -> Iterable[Transmission]:
        super().overhear(message, payload, now)
        if isinstance(message, Beacon) and message.proof:
            self._heard.append(message)
            self._heard.sort(key=lambda beacon: beacon.hops)
            # The shortest ways, old or new, and some others.
            del self._heard[MAX_REMEMBERED:]
        return ()

    def turn(self, now: float) -> Iterable[Transmission]:
        base, best = self.base(), {"potential": 1 if self.costs else POTENTIAL_BASE - 1, "free": 0xFFFE, "risk": 0}
        if base is None or not self._heard:
            return
        for _ in range(self.EACH_TURN):
            old = self.rng.choice(self._heard)
            # One hop less, and a later number.
            yield self.beacon(old, hops=max(0, old.hops - 1), flags=BEACON_BASE if old.hops == 1 else 0, **best)
            yield self.beacon(old, route_number=base.route_number + self.rng.randint(1, 3) & 0xFFFF, **best)
            yield self.beacon(old, hops=0, flags=BEACON_BASE, base=self.id, base_life=self.id, **best)
            yield self.beacon(old, hops=0, flags=BEACON_BASE, **best)


class CopyStatusForger(ReceiptForger):
    """Forges receipts, and signatures of the ground for them and for hash chains. It asks for all that it knows."""

    def turn(self, now: float) -> Iterable[Transmission]:
        base, rng = self.base(), self.rng
        if base is None:
            return
        source = (base.base, base.base_life)
        for receipt in super().turn(now):
            assert isinstance(receipt, Receipt)
            yield receipt
            hashes = (rng.randbytes(8),)
            yield body_of(StatementSignature(*source, receipt.serial, rng.getrandbits(32), hashes)) + rng.randbytes(64)
            yield body_of(StatementSignature(*source, rng.randrange(100), 0, hashes)) + rng.randbytes(64)
            yield body_of(Anchor(*source, rng.randrange(100), base.route_number, hashes[0])) + rng.randbytes(64)
            yield encode_ask(Ask((source,), tuple((*source, rng.randrange(100)) for _ in range(9))))


class TimestampJumper(Attacker):
    """Sends four frames in each stream that it overhears, with timestamps so far ahead that no owner skips to them."""

    def begin(self) -> None:
        self._streams: dict[Stream, None] = {}

    def overhear(self, message: Message, payload: bytes, now: float) -> Iterable[Transmission]:
        if self.stream in self._streams or len(self._streams) >= MAX_REMEMBERED:
            return ()
        self._streams[self.stream] = None
        return [Disguised(self.stream, b"", _FAR_AHEAD + i) for i in range(4)]


class TimestampSquatter(TimestampJumper):
    """Uses the next timestamps of each stream that it overhears before their owner does."""

    LEADS: tuple[int, ...] = (1, 2, 3, 4)

    def overhear(self, message: Message, payload: bytes, now: float) -> Iterable[Transmission]:
        super().overhear(message, payload, now)
        return [Disguised(self.stream, b"", min(self.timestamp + lead, MAX_TIMESTAMP)) for lead in self.LEADS]


class TimestampOvertaker(TimestampSquatter):
    """Sends timestamps a little ahead, some beacons ahead, and too many beacons ahead, after each frame that it
    overhears. In each turn it sends one much farther ahead, and then one still farther, in each stream around it."""

    LEADS = (40, 3 << 16, 60 << 16, 70 << 16)

    def turn(self, now: float) -> Iterable[Transmission]:
        for stream in self._streams:
            yield Disguised(stream, b"", _FAR_AHEAD - 1)
            yield Disguised(stream, b"", _FAR_AHEAD + 1)


class Shadower(Attacker):
    """After each beacon that it overhears, sends another one with this number, for those who have missed it, and a
    later one, in the same node's name and without a route."""

    LEADS: tuple[int, ...] = (0, 31)

    def overhear(self, message: Message, payload: bytes, now: float) -> Iterable[Transmission]:
        super().overhear(message, payload, now)
        if not isinstance(message, Beacon):
            return ()
        again = message._replace(answers=())
        return [self.shadow(again._replace(number=(again.number + lead) & 0xFFFF)) for lead in self.LEADS]

    def shadow(self, later: Beacon) -> Transmission:
        """What it sends after a beacon, if this is the same one with a later number."""
        return later._replace(base=0, base_life=0, route_number=0, hops=NO_ROUTE)


class TurnShadower(Shadower):
    """The same, with a turn of hours, and as if no node was a base."""

    def shadow(self, later: Beacon) -> Transmission:
        return later._replace(turn=0xFFFF, flags=0)


class FitnessShadower(Shadower):
    """The same, with the worst fitness, one number ahead, and in the node's own stream."""

    LEADS = (0, 1)

    def shadow(self, later: Beacon) -> Transmission:
        unfit = later._replace(potential=0xFFFFFFFF if self.costs else 0, free=0, risk=0xFFFF)
        return Disguised(self.stream, unfit, min(self.timestamp + 1, MAX_TIMESTAMP))


class LossLiar(NumberSquatter):
    """Reports the numbers that nearby nodes are about to assign as lost, and their stores as damaged."""

    EACH_TURN = 5
    AHEAD = 200

    def turn(self, now: float) -> Iterable[Transmission]:
        rng, seen = self.rng, list(self._last.items())
        for node in self.beacons.values():
            for _ in range(self.EACH_TURN if seen else 0):
                (origin, epoch), last = rng.choice(seen)
                first = last + rng.randint(1, self.AHEAD)
                ids = [DatumId(origin, epoch, (first + i) & 0xFFFFFFFF) for i in range(PROVEN_NOTES_IN_FRAME - 1)]
                lies = [(id, rng.randint(1, 6)) for id in ids]
                lies.append((DatumId(node.sender, node.life, rng.randrange(1000)), REASONS[Fate.DAMAGED]))
                entries = [
                    DeletionEntry(rng.getrandbits(32) | 1, id, why, note_crc(id, why), self.seals.of_note(id, why))
                    for id, why in lies
                ]
                yield DeletionReport(self.id, node.sender, tuple(entries))


class NameChanger(Sinkhole):
    """A sinkhole that has a new name, and so no past, every few steps."""

    STEPS = 20

    def begin(self) -> None:
        self._turns = 0

    def turn(self, now: float) -> Iterable[Transmission]:
        if self._turns % self.STEPS == 0:
            self.id = self.rng.randrange(1000, 65000)
        self._turns += 1
        return super().turn(now)


#: By the names that `hostile: [{kind: ...}]` uses.
KINDS: dict[str, type[Attacker]] = {
    "sinkhole": Sinkhole,
    "false-base": FalseBase,
    "black-hole": BlackHole,
    "two-faced": TwoFaced,
    "grey-hole": GreyHole,
    "committed-forger": CommittedForger,
    "relay-forger": RelayForger,
    "relay-liar": RelayLiar,
    "copier": Copier,
    "receipt-forger": ReceiptForger,
    "number-squatter": NumberSquatter,
    "request-forger": RequestForger,
    "impostor": Impostor,
    "id-inventor": IdInventor,
    "replayer": Replayer,
    "junk-custody": JunkCustody,
    "blamer": Blamer,
    "crowd": Crowd,
    "flooder": Flooder,
    "bit-flipper": BitFlipper,
    "route-forger": RouteForger,
    "word-forger": CopyStatusForger,
    "timestamp-jumper": TimestampJumper,
    "timestamp-squatter": TimestampSquatter,
    "timestamp-overtaker": TimestampOvertaker,
    "shadower": Shadower,
    "turn-shadower": TurnShadower,
    "fitness-shadower": FitnessShadower,
    "loss-liar": LossLiar,
    "name-changer": NameChanger,
}


def kinds() -> dict[str, type[Attacker]]:
    """All attackers, by name."""
    return KINDS


class HostileSection(Section):
    """An attacker beside the honest nodes (docs/evaluation/attackers.md). For virtual time."""

    kind: Annotated[str, Meta(one_of=kinds)]
    """What it does (docs/evaluation/attackers.md)."""
    near: Annotated[int, Meta(ge=0)] = 0
    """Its place is that of this node: it hears, and is heard by, this node and its neighbours."""
    begin: Annotated[int, Meta(ge=0)] = 0
    """The first step in which it is present."""
    end: Count | None = None
    """The first step in which it is gone; null: it stays."""
    captured: bool = False
    """It has the swarm's link key, from a captured drone: nodes take its frames. Needs `keys`."""

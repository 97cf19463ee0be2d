"""A net of `Receipts` that hear each other's summaries and frames: the gossip alone, without data."""

from __future__ import annotations

import random
from collections.abc import Iterable

from rass_mav.core.datum import DatumId, Fate
from rass_mav.core.messages import Receipt, SequenceMark
from rass_mav.core.news.archive import Archive, Serials
from rass_mav.core.news.ranges import Ranges
from rass_mav.core.news.receipts import Receipts
from rass_mav.core.news.table import MAX_STATEMENTS
from rass_mav.core.routes.neighbours import Neighbour
from rass_mav.wire import decode, encode

from .build import beacon
from .durable import DurableStore

#: (hearer, speaker)
Link = tuple[int, int]


def line(nodes: int) -> set[Link]:
    return {(i, i + d) for i in range(nodes) for d in (-1, 1) if 0 <= i + d < nodes}


def grid(side: int) -> set[Link]:
    """Eight neighbours each."""
    at = [divmod(i, side) for i in range(side * side)]
    return {
        (i, j)
        for i, (x, y) in enumerate(at)
        for j, (u, v) in enumerate(at)
        if i != j and abs(x - u) <= 1 and abs(y - v) <= 1
    }


class Net:
    """Nodes 0 .. bases - 1 are bases. In each step all hear the others' summaries, then those whose turn it is
    speak."""

    def __init__(
        self,
        links: Iterable[Link],
        *,
        bases: int = 1,
        period: int = 4,
        bounds: Iterable[int] = (),
        loss: float = 0.0,
        seed: int = 0,
    ) -> None:
        self.links = set(links)
        self.bases = bases
        self.loss = loss
        self.rng = random.Random(seed)
        self.nodes = 1 + max(max(link) for link in self.links)
        self.archives = [Archive() for _ in range(bases)]
        self.serials = [Serials(DurableStore(1000 + i)) for i in range(bases)]
        limits = [*bounds, *[MAX_STATEMENTS] * self.nodes]
        self.period = period
        self.receipts = [self.start(i, limits[i]) for i in range(self.nodes)]
        self.t = 0
        self.frames: list[int] = []
        """Frames in each step."""

    def start(self, i: int, bound: int = MAX_STATEMENTS) -> Receipts:
        phase = self.rng.randrange(self.period)
        if i >= self.bases:
            return Receipts(self.rng, period=self.period, phase=phase, max_statements=bound)
        return Receipts(
            self.rng, (i, 1000 + i), archive=self.archives[i], serials=self.serials[i], period=self.period, phase=phase,
            max_statements=bound,
        )  # fmt: skip

    def arrive(self, *ids: DatumId, base: int = 0) -> None:
        for id in ids:
            if self.archives[base].add(id):
                self.receipts[base].arrived(id)

    def lose(self, *ids: DatumId, base: int = 0) -> None:
        for id in ids:
            if self.archives[base].lose(id, Fate.CORRUPTED):
                self.receipts[base].lost(id)

    def step(self) -> None:
        heard = [
            [
                Neighbour(beacon(j, self.t, life=j)._replace(statements_hash=self.receipts[j].statements_hash), 0.0)
                for j in sorted(j for i, j in self.links if i == hearer)
            ]
            for hearer in range(self.nodes)
        ]
        said: list[tuple[int, Receipt]] = []
        denied: list[tuple[int, SequenceMark]] = []
        for i, receipts in enumerate(self.receipts):
            for message in receipts.turn(self.t, heard[i]):
                [frame] = encode(message, 0.0)
                assert len(frame) <= 128
                parsed = decode(frame, 0.0)
                if isinstance(parsed, Receipt):
                    said.append((i, parsed))
                else:
                    assert isinstance(parsed, SequenceMark)
                    denied.append((i, parsed))
        for speaker, receipt in said:
            for hearer, other in sorted(self.links):
                if other == speaker and not (self.loss and self.rng.random() < self.loss):
                    self.receipts[hearer].learn(receipt)
        for speaker, given in denied:
            for hearer, other in sorted(self.links):
                if other == speaker:
                    self.receipts[hearer].deny(given)
        self.frames.append(len(said) + len(denied))
        self.t += 1

    def run(self, steps: int) -> int:
        """Frames sent meanwhile."""
        before = sum(self.frames)
        for _ in range(steps):
            self.step()
        return sum(self.frames) - before

    def agree(self) -> bool:
        known = [all_known(receipts) for receipts in self.receipts]
        return all(k == known[0] for k in known) and len({receipts.statements_hash for receipts in self.receipts}) == 1


def all_known(receipts: Receipts) -> dict[tuple[int, int], tuple[Ranges, Ranges]]:
    """What has arrived, and what was told lost, by origin and epoch."""
    found = {pair: receipts.statements.sum(pair) for pair in receipts.statements.pairs()}
    return {pair: (known.arrived, known.lost) for pair, known in found.items()}

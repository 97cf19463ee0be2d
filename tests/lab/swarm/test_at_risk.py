"""What a report says is lost if a drone fails, against the ledger of swarms in which that drone then fails."""

from __future__ import annotations

import random
from collections.abc import Iterator
from typing import Any, NamedTuple

import pytest

from rass_mav.core.datum import DatumId, Fate, Kind
from rass_mav.core.node import Node
from rass_mav.core.store import Store
from rass_mav.ground.entry import Entry
from rass_mav.ground.report import AtMost, Report
from rass_mav.lab.swarm.scenario import load_scenario
from rass_mav.lab.swarm.world import World
from rass_mav.wire.nodestatus import decode_status
from tests.some import some

NODES, STEPS, DEATHS = 36, 240, 5


class Death(NamedTuple):
    drone: int
    lost: set[DatumId]
    """Data of which the last copy was there, without those that the base had been told are lost."""
    at_risk: int
    at_most: AtMost
    """As the report said then."""
    missing: set[DatumId]
    """The same of data that were created before its last status, were somewhere, and had not arrived."""
    known: set[DatumId]
    """Those of them of which the base could know that they had been created."""
    word_s: float
    """When the drone had sent the status that this comes from."""


class Mortal:
    """A swarm in which some drones fail, each right after it has created a status."""

    def __init__(self, seed: int, **keys: object) -> None:
        self.world = World(
            load_scenario(
                "demo",
                # The part is so small that no drone dies by itself.
                {"nodes": NODES, "seed": seed, "data.status_s": 8.0, "failures.die_fraction": 1e-9, **keys},
            )
        )
        rng = random.Random(seed)
        self.victims = rng.sample(range(1, NODES), DEATHS)
        self.from_step = sorted(rng.sample(range(60, 180), DEATHS))
        self.deaths: list[Death] = []
        self.alone: dict[tuple[int, float], set[DatumId]] = {}
        """What each drone alone had at each of its statuses."""

    def run(self, monkeypatch: pytest.MonkeyPatch) -> None:
        put = Node.put

        def watched(node: Node, payload: bytes, now: float, kind: int = 0, *terms: Any) -> DatumId:
            if kind == Kind.STATUS:
                custody = node.holdings.custody
                self.alone[node.id, now] = {id for id, holding in custody.items() if holding.partner is None}
            return put(node, payload, now, kind, *terms)

        with monkeypatch.context() as watching:
            watching.setattr(Node, "put", watched)
            while self.victims and self.world.t < STEPS:
                self.world.run(1, after=self._kill)

    def _report(self) -> Report:
        """As the base would give it now."""
        report = Report()
        base = self.world.stores[0]
        report.take(entries(base))
        report.hear(base.losses())
        return report

    def _kill(self, world: World) -> None:
        if not self.victims or world.t < self.from_step[0]:
            return
        drone = self.victims[0]
        if any(id == drone and now >= (world.t - 1) * world.step_s - 1e-9 for id, now in self.alone):
            before, report = set(world.ledger.lost), self._report()
            world.crash(drone, None)
            died = {id for id, fate in world.ledger.lost.items() if fate is Fate.DIED}
            at_risk, word = report.at_risk(drone), report.drone(drone).last_status
            if at_risk is not None and word is not None:
                # Copies of some may be left. They count as lost already.
                before |= {id for id, _ in world.stores[0].losses()}
                born = {id for id, step in world.ledger.born.items() if step * world.step_s <= word.utc}
                missing = born - world.ledger.arrived.keys() - before
                known = {id for id in missing if id.sequence < _created(report, id)}
                at_most = report.at_most()[drone]
                self.deaths.append(Death(drone, died - before, at_risk, at_most, missing, known, word.utc))
            del self.victims[0], self.from_step[0]


def _created(report: Report, id: DatumId) -> int:
    """How many of an epoch the base knows of."""
    drone = report.drones.get(id.origin)
    return drone.epochs[id.epoch].known if drone is not None and id.epoch in drone.epochs else 0


def entries(store: Store) -> Iterator[Entry]:
    for info in store.held():
        datum = some(store.get(info.id))
        status = decode_status(datum.payload) if info.kind == Kind.STATUS else None
        yield Entry(0, info.id, info.crc, info.kind, info.size, info.hops, info.created, 0.0, False, 0.0, status=status)


@pytest.mark.no_cover
@pytest.mark.parametrize(
    ("mirror", "runs"),
    # Where there is one copy more is lost, and the count of it scatters.
    [
        pytest.param(False, 1, id="one copy"),
        pytest.param(False, 20, id="one copy, long", marks=pytest.mark.soak),
        pytest.param(True, 20, id="mirrored, long", marks=pytest.mark.soak),
    ],
)
def test_what_a_drone_alone_had_is_what_is_lost_with_it(
    mirror: bool, runs: int, monkeypatch: pytest.MonkeyPatch
) -> None:  # fmt: skip
    said = lost = deaths = 0
    for seed in range(1, runs + 1):
        # Links come and go, and now and then a drone is cut off with what it has.
        swarm = Mortal(seed, **{"topology": "random-walk", "radio.range_m": 1.8, "custody.replicas": mirror})
        swarm.run(monkeypatch)
        for drone, died, at_risk, at_most, missing, known, word_s in swarm.deaths:
            # Ages travel as milliseconds.
            _, had = min((abs(now - word_s), ids) for (id, now), ids in swarm.alone.items() if id == drone)
            assert len(died & had) <= at_risk <= len(had), "of what it held at its last word that arrived"
            said += at_risk
            old = {id for id in died if swarm.world.ledger.born[id] * swarm.world.step_s <= word_s}
            assert old <= missing
            assert len(known) <= at_most.data, "any of these can be what is lost"
            assert missing == known or at_most.drones_unknown
            lost += len(old)
            deaths += 1
    assert deaths > 2 * runs
    assert said or mirror, "some of them were alone with data"
    if runs > 1:
        # Few are not in its word: what came to it since, and copies that it counted on and that were gone too.
        assert max(said, lost) < deaths or 0.9 * lost <= said <= 1.1 * lost

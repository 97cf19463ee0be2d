"""What the estimate of sources says in a mock swarm, from what has arrived at the bases, and what is true."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from rass_mav.core.datum import DatumId, Kind
from rass_mav.ground.entry import Entry, Place
from rass_mav.ground.sources.readings import Sample, Samples
from rass_mav.lab.swarm.autopilot import to_arena
from rass_mav.lab.swarm.radiation import Source
from rass_mav.lab.swarm.world import World
from rass_mav.sensor.dose import TUBES
from rass_mav.wire.measurement import decode_measurement

if TYPE_CHECKING:
    from rass_mav.ground.sources.estimate import Estimate

#: The first look, seconds after the start; the other one is at the end.
FIRST_S = 60.0
#: A source has enough readings if so many counts of it were expected in all, and so many by a second drone, of those
#: readings in which it is expected to be at least half; and if they surround it: from one side it cannot be located.
ENOUGH, SECOND = 30.0, 10.0


class Located:
    """The estimates, and the truth, at both looks: `early` and `end`."""

    def __init__(self) -> None:
        self._samples = Samples()
        self._known: set[DatumId] = set()
        self._looks: dict[str, dict[str, Any]] = {}

    def after(self, world: World) -> None:
        """Read what has arrived, at the two steps that are of interest."""
        early = round(FIRST_S / world.step_s)
        if world.t not in (early, world.scenario.steps):
            return
        self._read(world)
        self._looks["early" if world.t == early else "end"] = self._look(world)

    def result(self) -> dict[str, Any]:
        """Places are metres east and north of the arena's centre."""
        return self._looks

    def _read(self, world: World) -> None:
        for store in world.stores[: world.scenario.bases]:
            for id in store.ids():
                datum = store.get(id)
                if id in self._known or datum is None or datum.kind != Kind.MEASUREMENT:
                    continue
                self._known.add(id)
                if id.origin >= world.scenario.bases:
                    self._samples.take(
                        Entry(
                            len(self._known), id, datum.crc, datum.kind, len(datum.payload), 0,
                            world.ledger.born[id] * world.step_s, 0.0, False, 0.0,
                            measurement=decode_measurement(datum.payload),
                        )
                    )  # fmt: skip

    def _look(self, world: World) -> dict[str, Any]:
        from rass_mav.ground.sources.estimate import estimate

        unit, samples = self._samples.main
        found = estimate(unit, samples)
        sources = world.surroundings.field.sources
        highest = max(samples, key=lambda sample: sample.value, default=None)
        return {
            "readings": len(samples),
            "verdict": found.verdict,
            "why": found.why,
            "true": [[round(value, 2) for value in source] for source in sources],
            "enough": enough(samples, sources, world),
            "found": _plain(found, sources),
            "naive": None if highest is None else list(to_arena(highest.latitude, highest.longitude)),
        }


def enough(samples: Sequence[Sample], sources: Sequence[Source], world: World) -> list[bool]:
    """Of each source whether it has enough readings."""
    about = world.scenario.radiation
    sensitivity = TUBES[about.tube].cpm_per_usvh / 60.0 * world.step_s
    by_source: list[Counter[int]] = [Counter() for _ in sources]
    directions: list[list[float]] = [[] for _ in sources]
    for sample in samples:
        x, y = to_arena(sample.latitude, sample.longitude)
        parts = [s / ((x - sx) ** 2 + (y - sy) ** 2 + about.height_m**2) for sx, sy, s in sources]
        half = (sum(parts) + about.background) / 2
        for k, part in enumerate(parts):
            if part >= half:
                by_source[k][sample.drone] += round(part * sensitivity * 1000)
                directions[k].append(math.atan2(y - sources[k].y, x - sources[k].x))
    result = []
    for by_drone, around in zip(by_source, directions, strict=True):
        most = [count / 1000 for _, count in by_drone.most_common()]
        result.append(sum(most) >= ENOUGH and sum(most[1:]) >= SECOND and _surround(around))
    return result


def _surround(directions: list[float]) -> bool:
    """Whether no half of the plane is without them. `directions`: radians, at least one."""
    ordered = sorted(directions)
    return max(b - a for a, b in pairwise([*ordered, ordered[0] + 2 * math.pi])) < math.pi


def _plain(found: Estimate, sources: Sequence[Source]) -> list[dict[str, Any]]:
    """The sources that were found, each with the true ones in its region."""
    plain = []
    for source in found.sources:
        x, y = to_arena(*source.place)
        rings = [[to_arena(*corner) for corner in ring] for ring in source.region]
        covers = [k for k, (sx, sy, _) in enumerate(sources) if any(inside(ring, sx, sy) for ring in rings)]
        plain.append(
            {
                "place": [round(x, 2), round(y, 2)], "strength": source.strength, "resolved": source.resolved,
                "area_m2": source.area_m2, "covers": covers, "why": source.why,
            }
        )  # fmt: skip
    return plain


def inside(ring: Sequence[Place], x: float, y: float) -> bool:
    """Whether a place is in a polygon."""
    inside = False
    for (x1, y1), (x2, y2) in pairwise(ring):
        if (y1 > y) != (y2 > y) and x < (x2 - x1) * (y - y1) / (y2 - y1) + x1:
            inside = not inside
    return inside


def matched(look: dict[str, Any]) -> list[tuple[int, dict[str, Any], float]]:
    """The resolved sources of a look, each with the true one that is nearest to it (by its number) and the distance, m;
    each true one at most once: the nearest pairs first."""
    pairs = sorted(
        (math.dist(found["place"], true[:2]), k, n)
        for n, found in enumerate(look["found"])
        if found["resolved"]
        for k, true in enumerate(look["true"])
    )
    taken: set[int] = set()
    used: set[int] = set()
    result = []
    for distance, k, n in pairs:
        if k not in taken and n not in used:
            taken.add(k)
            used.add(n)
            result.append((k, look["found"][n], distance))
    return result

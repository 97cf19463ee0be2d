"""From readings to sources: how many there are, where and how strong, or why that cannot be told
(docs/how-to/sources.md)."""

from __future__ import annotations

from collections.abc import Sequence
from math import exp, log
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np

from rass_mav.ground.entry import Place

from .counts import Ground, counts_of, gathered
from .fitness import Misfit, misfit
from .model import COMMON, OWN, ROUGHLY, Array, Counts, Fit, deviances, predict
from .motion import Motion, motion
from .outline import outlines
from .readings import Sample
from .region import CHI2, Region, covariance_of, region_of, widening
from .search import Grid, places, search

Verdict: TypeAlias = Literal["sources", "no source", "no fit", "too few readings"]

#: With fewer readings, or all in a smaller area (metres across), nothing is said.
LEAST_READINGS, LEAST_ACROSS_M = 30, 30.0
#: A region is worth flying to if it is at most so large, m^2: a circle of 56 m.
MOST_AREA_M2 = 10_000.0
#: A strength that may be so many times higher or lower is not known.
MOST_FACTOR = 100.0
#: By how much a source must lower the deviance without the drone that shows it most: one sensor alone may be broken.
SUPPORT = 9.0
#: Deviations that the model explains: in standard deviations of their sum, and of the test for length.
MOST_DEVIATION, MOST_LONG = 4.0, 14.0
#: A source that less probably moves rests; one that more probably moves is none that the model explains.
LEAST_MOVES, MOST_MOVES = 0.05, 0.9
#: From here on regions are wider, in proportion: by chance the test seldom says more.
USUAL_LONG = 6.0
#: If the readings do not fit, so many drones that deviate most are each tried to be left out.
DOUBTED = 2
#: With fewer drones none of them is doubted.
LEAST_JUDGES = 3


class Source(NamedTuple):
    """A source, or that there seems to be one."""

    place: Place
    """The best place: latitude and longitude, degrees."""
    strength: float
    """The reading 1 m from it, without the background."""
    strength_range: tuple[float, float] | None
    """With 95 %; None: it is hardly known at all."""
    region: list[list[Place]]
    """Where it is with 95 %: polygons, each closed and without holes. Empty: that cannot be told."""
    area_m2: float | None
    """Of the region; None: there is none."""
    resolved: bool
    """Whether the region can be relied on."""
    why: str
    """Why not; empty: it is."""
    drones: list[int]
    """Whose readings show it, by node id."""
    may_move: bool
    """Whether the readings leave that open: then the region is where it is if it rests, and where it is if it moves."""


class Estimate(NamedTuple):
    """What readings tell of sources."""

    verdict: Verdict
    why: str
    """For people: what does not fit, or what is missing; empty: nothing is."""
    unit: str
    """Of the readings; empty: unknown."""
    sources: list[Source]
    """The strongest first."""
    background: float | None
    """The reading without sources; None: it cannot be told from them."""
    height_m: float | None
    """Of the readings above the sources, metres; None: there is no source."""
    readings: int
    drones: int
    """How many were looked at."""
    doubtful: list[int]
    """A drone without whose readings those of the others fit, by node id: its sensor may be broken or forged."""
    until: float | None
    """When the last reading was taken, seconds since 1970."""

    def plain(self) -> dict[str, Any]:
        """As plain values for JSON."""
        return {**self._asdict(), "sources": [source._asdict() for source in self.sources]}


class _Found(NamedTuple):
    data: Counts
    fit: Fit
    covariance: Array
    """Of the parameters."""
    motions: list[Motion]
    """Of each source."""
    misfit: Misfit
    more: bool

    @property
    def trouble(self) -> str:
        """Why it is no explanation; empty: it is one."""
        if self.more:
            return "there would be more than five of them"
        if any(one.share > MOST_MOVES for one in self.motions):
            return "one seems to move"
        if self.misfit.long > MOST_LONG:
            return "one seems to be no point"
        if max(self.misfit.near, self.misfit.all) > MOST_DEVIATION:
            return "readings differ from it by more than chance"
        return ""


def estimate(unit: str, samples: Sequence[Sample]) -> Estimate:
    """The sources that explain readings of one unit. It takes about a second."""
    drones = len({sample.drone for sample in samples})
    until = max((sample.utc for sample in samples), default=None)
    nothing = Estimate("too few readings", "", unit, [], None, None, len(samples), drones, [], until)
    if len(samples) < LEAST_READINGS:
        return nothing._replace(why=f"{len(samples)} readings with a place have arrived, {LEAST_READINGS} are needed")
    single, one, ground = counts_of(samples)
    across = [float(np.ptp(np.quantile(axis, (0.02, 0.98)))) for axis in (single.x, single.y)]
    if max(across) < LEAST_ACROSS_M:
        return nothing._replace(why=f"all readings are from one place, {max(across):.0f} m across")
    found = _explain(single)
    told = nothing._replace(why="")
    if found.trouble:
        doubtful = _doubtful(single, found.fit)
        why = f"the readings fit no one to five fixed point sources: {found.trouble}"
        why += "".join(f"; without drone {id} they fit" for id in doubtful)
        return told._replace(verdict="no fit", why=why, doubtful=doubtful)
    # Where strong sources hide it, its logarithm may be anything.
    background = float(np.exp(found.fit.parameters[0])) * one if found.covariance[0, 0] < 1.0 else None
    if not found.fit.sources:
        return told._replace(verdict="no source", background=background)
    sources = _sources(found, one, ground)
    height = float(np.exp(found.fit.parameters[1]))
    return told._replace(verdict="sources", sources=sources, background=background, height_m=height)


def _doubtful(single: Counts, fit: Fit) -> list[int]:
    """One drone without which the others' readings fit; none: there is none, or nobody is left to judge it."""
    drones = np.unique(single.drone)
    if len(drones) < LEAST_JUDGES:
        return []
    mean = predict(single, fit.parameters)[0]
    off = deviances(single.counts, mean, np.full(len(mean), ROUGHLY))
    by_drone = {int(id): float(off[single.drone == id].sum()) for id in drones}
    suspects = sorted(by_drone, key=by_drone.__getitem__, reverse=True)[:DOUBTED]
    # Sources may have been invented to explain a sensor that always reads too much.
    highest = max(by_drone, key=lambda id: float(single.counts[single.drone == id].mean()))
    for id in dict.fromkeys((*suspects, highest)):
        if not _explain(single.only(single.drone != id)).trouble:
            return [id]
    return []


def _explain(single: Counts) -> _Found:
    data = gathered(single)
    fit, more = search(data)
    covariance = covariance_of(data, fit)
    motions = [motion(single, fit, k, covariance) for k in range(fit.sources)]
    return _Found(data, fit, covariance, motions, misfit(single, fit), more)


def _sources(found: _Found, one: float, ground: Ground) -> list[Source]:
    grid = places(found.data)
    sources = [_source(found, k, grid, one, ground) for k in range(found.fit.sources)]
    return sorted(sources, key=lambda source: -source.strength)


def _source(found: _Found, k: int, grid: Grid, one: float, ground: Ground) -> Source:
    data, fit, covariance = found.data, found.fit, found.covariance
    east, north, log_strength = fit.own(k)
    strength = float(np.exp(log_strength)) * one
    error = 1.96 * float(np.sqrt(covariance[COMMON + OWN * k + 2, COMMON + OWN * k + 2]))
    within = (strength * exp(-error), strength * exp(error)) if error < log(MOST_FACTOR) else None
    showing = _showing(data, fit, k)
    limit = CHI2 * widening(data, fit, k, covariance) * max(1.0, found.misfit.long / USUAL_LONG)
    may_move = found.motions[k].share > LEAST_MOVES
    region = region_of(data, fit, k, covariance, grid, limit, found.motions[k] if may_move else None)
    why = ""
    if sum(showing.values()) - max(showing.values()) < SUPPORT:
        id = max(showing, key=showing.__getitem__)
        why = f"only drone {id} shows it: fly another one there"
    elif not region.bounded:
        why = "it may be where no drone has measured"
    elif region.area > MOST_AREA_M2:
        why = f"it may be anywhere in {region.area / 1e4:.1f} ha"
    drawn = region.bounded and (not why or region.area > MOST_AREA_M2)
    return Source(
        ground.place(float(east), float(north)), strength, within,
        _polygons(region, ground) if drawn else [], region.area if drawn else None, not why, why,
        sorted(id for id, gain in showing.items() if gain > SUPPORT / 2), may_move,
    )  # fmt: skip


def _showing(data: Counts, fit: Fit, k: int) -> dict[int, float]:
    """By how much the source lowers the deviance of each drone's counts, all else being as it is: with a higher
    background in its place, drones that see no source would seem to show it."""
    first = COMMON + OWN * k
    other = predict(data, np.delete(fit.parameters, slice(first, first + OWN)))[0]
    gains = deviances(data.counts, other, fit.excess) - deviances(data.counts, fit.mean, fit.excess)
    return {int(id): float(gains[data.drone == id].sum()) for id in np.unique(data.drone)}


def _polygons(region: Region, ground: Ground) -> list[list[Place]]:
    return [
        [
            ground.place(region.east + column * region.side[0], region.north + row * region.side[1])
            for column, row in ring
        ]
        for ring in outlines(region.inside)
    ]

"""Which nodes hear each other, who notices that another sends, and how well: the graph of nodes within radio range.

Spatial hashing finds the distances. The plane is cut into square cells a little larger than the range, so the
neighbours of a node are in its own cell or in one of the eight around it. The cost of a rebuild grows with the number
of nodes times the number of neighbours each has, not with the square of the number of nodes.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterable, Iterator, Sequence

from .settings import RadioSection

#: A node's position (x, y) in metres; the arena's centre is the origin.
Position = tuple[float, float]

#: Two nodes hear each other at a distance of at most range + TOLERANCE_M: rounding must not separate nodes that are
#: exactly the range apart.
TOLERANCE_M = 1e-9

# Half of the eight cells around a cell. Checking only those, and the cell itself, visits each pair of cells once.
_FORWARD = ((0, 1), (1, -1), (1, 0), (1, 1))
_AROUND = tuple((i, j) for i in (-1, 0, 1) for j in (-1, 0, 1))


class Cells:
    """Points hashed into square cells, to which points can be added one at a time.

    `reach_m` is the largest distance that will be requested, > 0.
    """

    def __init__(self, reach_m: float) -> None:
        # The factor keeps the "own cell or next to it" rule true in spite of rounding in the division below.
        self._size = (reach_m + TOLERANCE_M) * 1.000001
        self._cells: dict[tuple[int, int], list[tuple[int, float, float]]] = {}

    def _key(self, x: float, y: float) -> tuple[int, int]:
        return math.floor(x / self._size), math.floor(y / self._size)

    def add(self, index: int, x: float, y: float) -> None:
        """Add the point with this index at (x, y) metres."""
        self._cells.setdefault(self._key(x, y), []).append((index, x, y))

    def near(self, x: float, y: float) -> Iterator[tuple[int, float]]:
        """Yield (index, squared distance in m^2) of all points within reach of (x, y), and of some beyond it."""
        cell_x, cell_y = self._key(x, y)
        for dx, dy in _AROUND:
            for index, px, py in self._cells.get((cell_x + dx, cell_y + dy), ()):
                yield index, (px - x) ** 2 + (py - y) ** 2

    def pairs(self) -> Iterator[tuple[list[tuple[int, float, float]], list[tuple[int, float, float]]]]:
        """Yield each pair of adjacent cells once, and each cell with itself (then both are the same list)."""
        cells = self._cells
        for (cell_x, cell_y), here in cells.items():
            yield here, here
            for dx, dy in _FORWARD:
                there = cells.get((cell_x + dx, cell_y + dy))
                if there is not None:
                    yield here, there


def segment_distance(point: Position, start: Position, end: Position) -> float:
    """Distance of a point from the straight line between two others, metres."""
    dx, dy = end[0] - start[0], end[1] - start[1]
    length2 = dx * dx + dy * dy
    along = ((point[0] - start[0]) * dx + (point[1] - start[1]) * dy) / length2 if length2 else 0.0
    along = min(max(along, 0.0), 1.0)
    return math.dist(point, (start[0] + along * dx, start[1] + along * dy))


class RangeGraph:
    """The graph whose edges join nodes at most `range_m` metres apart. Node ids are the indices into the positions."""

    neighbours: list[list[int]]
    """For each node the ids within range of it, ascending, itself left out."""

    def __init__(
        self, positions: Sequence[Position], range_m: float, cylinders: Sequence[Position] = (), cylinder_m: float = 0.0
    ) -> None:
        """Build the graph. `range_m` in metres, > 0 (`ValueError` otherwise).

        `cylinders`: centres of upright cylinders of radius `cylinder_m`, metres; no edge passes through one.
        """
        if not (math.isfinite(range_m) and range_m > 0):
            raise ValueError(f"range_m must be a finite number > 0, got {range_m!r}")
        self.range_m = range_m
        self._cylinders = cylinders
        self._cylinder_m = cylinder_m
        self.update(positions)

    def update(self, positions: Sequence[Position]) -> None:
        """Rebuild the graph for new positions of the nodes. Needed only when something moved."""
        cells = Cells(self.range_m)
        neighbours: list[list[int]] = [[] for _ in positions]
        for i, (x, y) in enumerate(positions):
            cells.add(i, x, y)
        limit = (self.range_m + TOLERANCE_M) ** 2
        for here, there in cells.pairs():
            same = here is there
            for place, (i, x, y) in enumerate(here):
                mine = neighbours[i]
                for j, px, py in here[place + 1 :] if same else there:
                    if (px - x) * (px - x) + (py - y) * (py - y) <= limit:
                        mine.append(j)
                        neighbours[j].append(i)
        for ids in neighbours:
            ids.sort()
        self.neighbours = neighbours
        for cylinder in self._cylinders:
            self._cast_shadow(positions, cylinder)

    def _cast_shadow(self, positions: Sequence[Position], cylinder: Position) -> None:
        radius = self._cylinder_m
        limit = self.range_m + radius
        # A node farther away has no edge that reaches the cylinder.
        near = [i for i, position in enumerate(positions) if math.dist(position, cylinder) <= limit]
        for i in near:
            self.neighbours[i] = [
                j for j in self.neighbours[i] if segment_distance(cylinder, positions[i], positions[j]) > radius
            ]

    def hops_from(self, bases: Iterable[int]) -> list[int | None]:
        """See `hops_from`."""
        return hops_from(self.neighbours, bases)


def hops_from(neighbours: Sequence[Sequence[int]], bases: Iterable[int]) -> list[int | None]:
    """Fewest hops from each node to the nearest of `bases` (0 for a base), None where there is no route.

    `neighbours`: for each node the ids in its range.
    """
    hops: list[int | None] = [None] * len(neighbours)
    wave = sorted(set(bases))
    for base in wave:
        hops[base] = 0
    distance = 0
    while wave:
        distance += 1
        following = []
        for i in wave:
            for j in neighbours[i]:
                if hops[j] is None:
                    hops[j] = distance
                    following.append(j)
        wave = following
    return hops


def reachable(neighbours: Sequence[Sequence[int]], bases: int) -> int:
    """How many drones have a route to a base, over any number of hops. Nodes 0 .. bases - 1 are bases."""
    return sum(hops is not None for hops in hops_from(neighbours, range(bases))) - bases


#: The steepness of a receiver's threshold: 1 dB above it 9 of 10 frames arrive, 1 dB below it 1 of 10.
_STEEPNESS = math.log(9.0)
#: Links that are worse than the threshold by this many standard deviations of the shadowing, and by this many dB
#: more, carry nothing.
_DEVIATIONS, _MARGIN_DB = 3.0, 3.0


class Reach:
    """The links of a step. Node ids, and those of attackers after them, are the indices."""

    def __init__(self, settings: RadioSection, seed: int) -> None:
        self._settings = settings
        self._seed = seed
        self._positions: Sequence[Position] = ()
        self._shadows: dict[tuple[int, int], float] = {}
        self.hearers: Sequence[Sequence[int]] = ()
        """For each sender the nodes that may hear it."""
        self.noticed: Sequence[Sequence[int]] = ()
        """For each sender the nodes that notice that it sends."""
        self.fades = settings.path_loss is not None
        """Whether frames get lost with the distance: ask `chance`."""

    def update(self, neighbours: Sequence[Sequence[int]], positions: Sequence[Position]) -> None:
        """The links of a new step. `neighbours`: the nodes within the range."""
        settings = self._settings
        self._positions = positions
        self.hearers = self.noticed = neighbours
        if settings.path_loss is not None:
            farther_db = _DEVIATIONS * settings.shadowing_db + _MARGIN_DB
            farthest_m = settings.range_m * 10.0 ** (farther_db / (10.0 * settings.path_loss))
            self.hearers = RangeGraph(positions, farthest_m).neighbours
        if settings.sense > 1.0:
            self.noticed = RangeGraph(positions, settings.sense * settings.range_m).neighbours

    def chance(self, sender: int, hearer: int, need_db: float = 0.0) -> float:
        """The probability that a frame arrives if no other is in the air. `need_db`: how much stronger it must arrive
        than at the range."""
        exponent = self._settings.path_loss
        assert exponent is not None
        distance_m = max(math.dist(self._positions[sender], self._positions[hearer]), 0.01)
        margin_db = 10.0 * exponent * math.log10(self._settings.range_m / distance_m) - need_db
        return 1.0 / (1.0 + math.exp(-_STEEPNESS * (self._shadow_db(sender, hearer) + margin_db)))

    def _shadow_db(self, a: int, b: int) -> float:
        deviation = self._settings.shadowing_db
        if not deviation:
            return 0.0
        link = (a, b) if a < b else (b, a)
        shadow = self._shadows.get(link)
        if shadow is None:
            shadow = self._shadows[link] = random.Random(f"{self._seed}:shadow:{link}").gauss(0.0, deviation)
        return shadow

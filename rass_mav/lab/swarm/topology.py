"""Where the nodes of a mock swarm are at the start.

The arena is a square of side A metres whose centre is the origin; node ids are the indices into the list of positions.
Robots placed at random, and robots that move, stay inside walls at +-(A/2 - 0.5 m). These layouts follow the experiment
in section IV of the paper (arXiv 2201.01349): 100 robots, an arena of 20 m by 20 m, a radio range of 3 m.
"""

from __future__ import annotations

import math
from random import Random

from rass_mav.errors import ConfigError
from rass_mav.lab.medium.neighbours import TOLERANCE_M, Cells, Position

#: Distance between the arena's edge and the walls that robots do not pass, metres.
WALL_MARGIN_M = 0.5
#: Robots placed at random are at least this far apart, metres.
MIN_SPACING_M = 0.3
#: In a scale-free layout, the chance to try a place near a well-connected robot, not one anywhere.
ATTACH_CHANCE = 0.1
#: How far from that robot the place is, as a fraction of the radio range: uniform between the two.
ATTACH_RANGE = (0.1, 0.98)
#: Pitch of a line as a fraction of the radio range: one hop reaches the next node and not the one after.
LINE_PITCH = 0.8

# Places tried for one robot. The default arena needs a handful; in a full one the attempt ends within a second.
_ATTEMPTS = 20_000


def wall_m(arena_m: float) -> float:
    """Distance of the walls from the centre of an arena of side `arena_m`, metres. `ConfigError` if none is left."""
    wall = arena_m / 2 - WALL_MARGIN_M
    if not (math.isfinite(wall) and wall > 0):
        raise ConfigError(f"arena_m: expected more than {2 * WALL_MARGIN_M:g} m, got {arena_m!r}")
    return wall


def grid(nodes: int, arena_m: float) -> list[Position]:
    """`nodes` on a square grid that fills the arena, column by column, node 0 in the corner (-, -).

    With side = ceil(sqrt(nodes)) and pitch = arena_m/side, node i is at x = -arena_m/2 + pitch (1/2 + i div side), y =
    -arena_m/2 + pitch (1/2 + i mod side), metres. Nodes hear those beside them only if the pitch is within range.
    """
    side = math.isqrt(nodes - 1) + 1
    pitch = arena_m / side
    first = -arena_m / 2 + pitch / 2
    return [(first + pitch * (i // side), first + pitch * (i % side)) for i in range(nodes)]


def line(nodes: int, pitch_m: float) -> list[Position]:
    """`nodes` along the x axis, `pitch_m` metres apart, the line's middle in the origin, node 0 at its left end."""
    first = -pitch_m * (nodes - 1) / 2
    return [(first + pitch_m * i, 0.0) for i in range(nodes)]


def scale_free(nodes: int, arena_m: float, range_m: float, rng: Random) -> list[Position]:
    """A connected layout in which well-connected robots attract more neighbours (preferential attachment).

    The first robot is anywhere inside the walls. For each next one places are tried until one is accepted. With chance
    0.1 a try is at 0.1 to 0.98 of the range, in a uniform direction, from a robot drawn in proportion to its degree + 1
    (the degree counts robots within range); otherwise it is uniform inside the walls. It is accepted inside the walls
    and with the nearest robot 0.3 m to `range_m` away. The latter keeps the graph connected. Finally the ids are
    shuffled, so a base may be anywhere.

    Raises `ConfigError` if a robot finds no place in 20,000 tries.
    """
    wall = _walls(arena_m, range_m)
    placing = _Placing(range_m)
    degrees: list[int] = []

    def propose() -> Position:
        if placing.positions and rng.random() < ATTACH_CHANCE:
            weights = [degree + 1 for degree in degrees]
            x, y = rng.choices(placing.positions, weights)[0]
            distance = range_m * rng.uniform(*ATTACH_RANGE)
            heading = rng.uniform(0.0, 2 * math.pi)
            return x + distance * math.cos(heading), y + distance * math.sin(heading)
        return rng.uniform(-wall, wall), rng.uniform(-wall, wall)

    while len(placing.positions) < nodes:
        for _ in range(_ATTEMPTS):
            x, y = propose()
            if abs(x) > wall or abs(y) > wall:
                continue
            heard = placing.take(x, y)
            if heard is not None:
                for j in heard:
                    degrees[j] += 1
                degrees.append(len(heard))
                break
        else:
            raise _no_room(nodes, arena_m, len(placing.positions))
    rng.shuffle(placing.positions)
    return placing.positions


def connected_uniform(nodes: int, arena_m: float, range_m: float, rng: Random) -> list[Position]:
    """Robots spread at random, yet connected, inside the walls: the start of the Lennard-Jones swarm.

    Grown robot by robot: each is placed uniformly at random among the places inside the walls whose nearest robot is
    0.3 m to `range_m` away. These places are found by rejection. Places are drawn from the smallest box that holds all
    within range of the robots placed so far; this gives the same distribution as drawing from the whole arena, and
    large arenas cost no more. Ids are in order of placement.

    Raises `ConfigError` if a robot finds no place in 20,000 tries.
    """
    wall = _walls(arena_m, range_m)
    placing = _Placing(range_m)
    placing.take(rng.uniform(-wall, wall), rng.uniform(-wall, wall))
    while len(placing.positions) < nodes:
        xs = [x for x, _ in placing.positions]
        ys = [y for _, y in placing.positions]
        left, right = max(min(xs) - range_m, -wall), min(max(xs) + range_m, wall)
        bottom, top = max(min(ys) - range_m, -wall), min(max(ys) + range_m, wall)
        for _ in range(_ATTEMPTS):
            if placing.take(rng.uniform(left, right), rng.uniform(bottom, top)) is not None:
                break
        else:
            raise _no_room(nodes, arena_m, len(placing.positions))
    return placing.positions


def spread_bases(positions: list[Position], bases: int) -> list[Position]:
    """The same places with several bases (ids 0 .. bases-1) far apart instead of side by side.

    Base 0 stays. Each further base changes places with the node whose nearest base so far is farthest away; among
    equals, with the lowest id. On a square grid bases 0 to 3 so take the four corners, diagonal first; on a line base 1
    takes the other end. All other nodes keep their ids and places. With one base nothing changes.
    """
    places = list(positions)
    nearest = [math.inf] * len(places)
    for base in range(1, bases):
        x, y = places[base - 1]
        nearest = [min(d, math.dist((x, y), place)) for d, place in zip(nearest, places, strict=True)]
        # Rounded, so that places that are equally far by symmetry stay equal in spite of floating point.
        farthest = max(range(base, len(places)), key=lambda i: (round(nearest[i], 6), -i))
        places[base], places[farthest] = places[farthest], places[base]
        nearest[base], nearest[farthest] = nearest[farthest], nearest[base]
    return places


def even_bases(positions: list[Position], bases: int) -> list[Position]:
    """The same places with each base (ids 0 .. bases-1) in the middle of about as many nodes as every other base.

    From the places of `spread_bases`, each base moves to the middle of the nodes that it is the nearest base of, until
    none moves (Lloyd's algorithm), at most 50 times. Then it changes places with the node nearest to that point; among
    equals, with the one with the lowest id. All other nodes keep their ids and places.
    """
    middles = spread_bases(positions, bases)[:bases]
    for _ in range(50):
        shares: list[list[Position]] = [[] for _ in middles]
        for place in positions:
            # Rounded as in `spread_bases`.
            shares[min(range(bases), key=lambda base: round(math.dist(place, middles[base]), 6))].append(place)
        before = middles
        middles = [
            (math.fsum(x for x, _ in share) / len(share), math.fsum(y for _, y in share) / len(share))
            if share else middle
            for share, middle in zip(shares, middles, strict=True)
        ]  # fmt: skip
        if middles == before:
            break
    places = list(positions)
    for base, middle in enumerate(middles):
        nearest = min(range(base, len(places)), key=lambda i: (round(math.dist(places[i], middle), 6), i))
        places[base], places[nearest] = places[nearest], places[base]
    return places


class _Placing:
    """Robots accepted so far, and the rule for the next: its nearest robot is MIN_SPACING_M to the range away."""

    def __init__(self, range_m: float) -> None:
        self.positions: list[Position] = []
        self._cells = Cells(range_m)
        self._range2 = (range_m + TOLERANCE_M) ** 2

    def take(self, x: float, y: float) -> list[int] | None:
        """Place a robot at (x, y) and return the ids within range of it, or None if the place violates the rule."""
        heard = []
        for j, distance2 in self._cells.near(x, y):
            if distance2 < MIN_SPACING_M**2:
                return None
            if distance2 <= self._range2:
                heard.append(j)
        if self.positions and not heard:
            return None
        self._cells.add(len(self.positions), x, y)
        self.positions.append((x, y))
        return heard


def _walls(arena_m: float, range_m: float) -> float:
    if range_m <= MIN_SPACING_M:
        raise ConfigError(f"radio.range_m: expected more than the {MIN_SPACING_M:g} m between robots, got {range_m!r}")
    return wall_m(arena_m)


def _no_room(nodes: int, arena_m: float, placed: int) -> ConfigError:
    return ConfigError(
        f"nodes: no place found for robot {placed + 1} of {nodes} in an arena of {arena_m:g} m;"
        " expected fewer nodes or a larger arena"
    )

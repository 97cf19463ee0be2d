"""How the nodes of a mock swarm move, step by step.

A `Mobility` starts with the positions of step 0 and is asked for one step after the other. All random numbers come from
the generator passed in, and robots are handled in id order, so the same seed gives the same positions in any process.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from random import Random
from typing import NamedTuple

from rass_mav.errors import ConfigError
from rass_mav.lab.medium.neighbours import Position, RangeGraph

from . import topology

#: The names `make_mobility` knows.
TOPOLOGIES = ("grid", "scale-free", "lennard-jones", "random-walk", "line", "islands", "positions", "survey")

#: Random walk: metres a robot moves in a step, and its chance to take a new heading before it does.
WALK_M = 0.15
WALK_TURN_CHANCE = 0.1

#: Lennard-Jones: the distance at which two robots neither attract nor repel each other, metres.
LJ_DISTANCE_M = 1.7
#: Lennard-Jones: the most a robot moves in a step, metres.
LJ_MAX_STEP_M = 0.05
#: Lennard-Jones: standard deviation of the random motion along each axis, metres a step.
LJ_NOISE_M = 0.005
# Metres a step for a force of one. Near the rest distance the force is as stiff as 2/d0^2 a neighbour; with six of them
# this gain still settles without swinging.
_LJ_GAIN = 0.1


class Mobility(ABC):
    """Where the nodes are, now and a step later."""

    def __init__(self, positions: list[Position]) -> None:
        self.positions = positions
        """Current position of each node in metres, by id. A step that moves anything creates a new list."""
        self._next_step = 0

    def step(self, t: int) -> bool:
        """Advance to the positions of step t = 0, 1, 2, ... in order, 0 being the start. Returns whether any moved."""
        if t != self._next_step:
            raise ValueError(f"step {self._next_step} is due, not step {t}")
        self._next_step += 1
        return t > 0 and self._advance(t)

    @abstractmethod
    def _advance(self, t: int) -> bool:
        """Move on to step t > 0. Returns whether any moved."""


class Static(Mobility):
    """Nodes that stay where they are."""

    def _advance(self, t: int) -> bool:
        return False


class RandomWalk(Mobility):
    """Every robot, the base too, moves 0.15 m a step, and before that takes a new uniform heading with chance 0.1.

    A robot about to pass a wall turns back first: the part of its heading that points at the wall changes sign. So its
    step is always 0.15 m long. One that starts beyond a wall (a crowded grid) heads inwards and cannot come out again.
    """

    def __init__(self, positions: list[Position], wall_m: float, rng: Random) -> None:
        """`wall_m`: distance of the walls from the centre, at least 0.15 m (`ConfigError` otherwise)."""
        super().__init__(positions)
        if wall_m < WALK_M:
            raise ConfigError(f"arena_m: robots that walk need at least {2 * (WALK_M + topology.WALL_MARGIN_M):g} m")
        self._wall = wall_m
        self._rng = rng
        self._headings = [_unit(rng) for _ in positions]

    def _advance(self, t: int) -> bool:
        rng, wall = self._rng, self._wall
        moved = []
        for i, (x, y) in enumerate(self.positions):
            if rng.random() < WALK_TURN_CHANCE:
                self._headings[i] = _unit(rng)
            across, along = self._headings[i]
            across = _turned_back(x, across, wall)
            along = _turned_back(y, along, wall)
            self._headings[i] = (across, along)
            moved.append((x + WALK_M * across, y + WALK_M * along))
        self.positions = moved
        return True


class LennardJones(Mobility):
    """Robots that keep their distance from those within range, like the particles of a fluid.

    Neighbour at distance r: the force on the robot, along the direction to the neighbour, is -((d0/r)^4 - (d0/r)^2)/r
    with d0 = 1.7 m: repulsive when nearer than d0, attractive when farther. In a step a robot moves by the sum of these
    forces (0.1 m for a force of one) plus a small random motion, at most 0.05 m in all, and stops at the walls. All
    robots move at once, by the positions of the step before.
    """

    def __init__(self, positions: list[Position], range_m: float, wall_m: float, rng: Random) -> None:
        """`range_m`: how far robots feel each other, `wall_m`: distance of the walls from the centre, in metres."""
        super().__init__(positions)
        self._wall = wall_m
        self._rng = rng
        self._graph = RangeGraph(positions, range_m)

    def _advance(self, t: int) -> bool:
        rng, wall = self._rng, self._wall
        moved = []
        for (x, y), (force_x, force_y) in zip(self.positions, self._forces(), strict=True):
            step_x = _LJ_GAIN * force_x + rng.gauss(0.0, LJ_NOISE_M)
            step_y = _LJ_GAIN * force_y + rng.gauss(0.0, LJ_NOISE_M)
            length = math.hypot(step_x, step_y)
            if length > LJ_MAX_STEP_M:
                step_x *= LJ_MAX_STEP_M / length
                step_y *= LJ_MAX_STEP_M / length
            moved.append((min(max(x + step_x, -wall), wall), min(max(y + step_y, -wall), wall)))
        self.positions = moved
        self._graph.update(moved)
        return True

    def _forces(self) -> list[tuple[float, float]]:
        positions = self.positions
        forces_x = [0.0] * len(positions)
        forces_y = [0.0] * len(positions)
        for i, (x, y) in enumerate(positions):
            for j in self._graph.neighbours[i]:
                if j < i:
                    continue
                dx, dy = positions[j][0] - x, positions[j][1] - y
                r2 = dx * dx + dy * dy
                if r2 == 0.0:
                    continue  # no direction to push in; the random motion separates them
                ratio2 = LJ_DISTANCE_M**2 / r2
                # Force over r, and (dx, dy) over r for the direction: together one division by r^2.
                pull = (ratio2 - ratio2 * ratio2) / r2
                forces_x[i] += pull * dx
                forces_y[i] += pull * dy
                forces_x[j] -= pull * dx
                forces_y[j] -= pull * dy
        return list(zip(forces_x, forces_y, strict=True))


class Islands(Mobility):
    """A swarm that splits in two: at `split_step` all nodes with x > 0 jump by `gap_m` in +x, and stay there.

    With `rejoin_step` they jump back to their first places at that step. On the grid the swarm is cut in two if
    pitch + gap is larger than the radio range.
    """

    def __init__(self, positions: list[Position], split_step: int, gap_m: float, rejoin_step: int | None) -> None:
        """Steps >= 1, `rejoin_step` after `split_step`; `gap_m` > 0 in metres; `ConfigError` otherwise."""
        super().__init__(positions)
        if split_step < 1:
            raise ConfigError(f"mobility.split_step: expected a step >= 1, got {split_step!r}")
        if rejoin_step is not None and rejoin_step <= split_step:
            raise ConfigError(f"mobility.rejoin_step: expected a step after {split_step}, got {rejoin_step!r}")
        if not (math.isfinite(gap_m) and gap_m > 0):
            raise ConfigError(f"mobility.gap_m: expected a number > 0, got {gap_m!r}")
        self._together = positions
        self._apart = [(x + gap_m if x > 0 else x, y) for x, y in positions]
        self._split_step = split_step
        self._rejoin_step = rejoin_step

    def _advance(self, t: int) -> bool:
        before = self.positions
        if t == self._split_step:
            self.positions = self._apart
        elif t == self._rejoin_step:
            self.positions = self._together
        return self.positions is not before


class Survey(Mobility):
    """Drones that survey a rectangular area, each a block of its own in strips, and bases at its edge.

    A drone flies at a constant speed of its own, uniform between two bounds, from a place on its way and in a direction
    that chance decides. The bases are at equal distances along the edge, the first in the middle of the south side;
    they drive along it, anticlockwise.
    """

    def __init__(
        self,
        nodes: int,
        bases: int,
        area_m: tuple[float, float],
        rng: Random,
        *,
        strip_m: float,
        speed_m: tuple[float, float],
        base_speed_m: float,
    ) -> None:
        """:param area_m: width and height, metres.
        :param strip_m: the most that two strips of a drone may be apart, metres.
        :param speed_m: metres that a drone flies in a step: the least and the most.
        :param base_speed_m: metres that a base drives in a step.
        """
        edge = Perimeter(*area_m)
        self._ways: list[Perimeter | Lawnmower] = [edge] * bases
        self._starts = [edge.length_m * base / bases for base in range(bases)]
        self._speeds = [base_speed_m] * bases
        if nodes > bases:
            for block in blocks(nodes - bases, *area_m):
                way = Lawnmower(block, strip_m)
                self._ways.append(way)
                # There and back again: the place decides the direction too.
                self._starts.append(rng.uniform(0.0, 2 * way.length_m))
                self._speeds.append(rng.uniform(*speed_m))
        super().__init__(self._at(0))

    def _at(self, t: int) -> list[Position]:
        return [
            way.at(start + t * speed) for way, start, speed in zip(self._ways, self._starts, self._speeds, strict=True)
        ]

    def _advance(self, t: int) -> bool:
        before, self.positions = self.positions, self._at(t)
        return self.positions != before


def make_mobility(
    name: str,
    *,
    nodes: int,
    range_m: float,
    arena_m: float,
    rng: Random,
    bases: int = 1,
    pitch_m: float | None = None,
    split_step: int = 100,
    rejoin_step: int | None = None,
    gap_m: float = 2.0,
    positions: Sequence[Sequence[float]] | None = None,
    area_m: tuple[float, float] | None = None,
    strip_m: float = 50.0,
    speed_m: tuple[float, float] = (5.0, 15.0),
    base_speed_m: float = 0.0,
    even_bases: bool = False,
) -> Mobility:
    """A mobility by name, one of `TOPOLOGIES`.

    `nodes` counts the bases, which have the ids 0 .. bases-1; `range_m` and `arena_m` (the arena's side) in metres.
    Options: `pitch_m` of `line`, metres, default 0.8 range_m; `split_step`, `rejoin_step` and `gap_m` of `islands`;
    `positions` of `positions`, one [x, y] in metres for each node; `area_m`, `strip_m`, `speed_m` and `base_speed_m` of
    `survey` (see `Survey`), whose area is the arena by default. Other names do not use these.

    Several bases are far apart in `grid`, `line`, `islands`, `survey` and at the start of `random-walk`
    (`topology.spread_bases`), or with `even_bases` each in the middle of its share (`topology.even_bases`); in the
    others they are where chance or the list puts them.

    Raises `ConfigError` for an unknown name or impossible numbers.
    """
    if name not in TOPOLOGIES:
        raise ConfigError(f"topology: expected one of {', '.join(TOPOLOGIES)}, got {name!r}")
    if nodes < 1:
        raise ConfigError(f"nodes: expected a number >= 1, got {nodes!r}")
    if not 1 <= bases <= nodes:
        raise ConfigError(f"bases: expected 1..{nodes}, got {bases!r}")
    if not (math.isfinite(range_m) and range_m > 0):
        raise ConfigError(f"radio.range_m: expected a number > 0, got {range_m!r}")
    place_bases = topology.even_bases if even_bases else topology.spread_bases
    if name == "positions":
        return Static(_listed(positions, nodes))
    if name == "survey":
        return Survey(
            nodes, bases, area_m or (arena_m, arena_m), rng, strip_m=strip_m, speed_m=speed_m, base_speed_m=base_speed_m
        )
    if name == "line":
        pitch = topology.LINE_PITCH * range_m if pitch_m is None else pitch_m
        if not (math.isfinite(pitch) and pitch > 0):
            raise ConfigError(f"mobility.pitch_m: expected a number > 0, got {pitch_m!r}")
        return Static(place_bases(topology.line(nodes, pitch), bases))
    wall = topology.wall_m(arena_m)
    if name == "scale-free":
        return Static(topology.scale_free(nodes, arena_m, range_m, rng))
    if name == "lennard-jones":
        return LennardJones(topology.connected_uniform(nodes, arena_m, range_m, rng), range_m, wall, rng)
    on_grid = place_bases(topology.grid(nodes, arena_m), bases)
    if name == "random-walk":
        return RandomWalk(on_grid, wall, rng)
    if name == "islands":
        return Islands(on_grid, split_step, gap_m, rejoin_step)
    return Static(on_grid)


def _listed(positions: Sequence[Sequence[float]] | None, nodes: int) -> list[Position]:
    if positions is None or len(positions) != nodes:
        given = "none" if positions is None else str(len(positions))
        raise ConfigError(f"mobility.positions: expected one [x, y] for each of {nodes} nodes, got {given}")
    places = []
    for i, place in enumerate(positions):
        if len(place) != 2 or not all(math.isfinite(value) for value in place):
            raise ConfigError(f"mobility.positions[{i}]: expected [x, y] in metres, got {list(place)!r}")
        places.append((float(place[0]), float(place[1])))
    return places


def _unit(rng: Random) -> tuple[float, float]:
    heading = rng.uniform(0.0, 2 * math.pi)
    return math.cos(heading), math.sin(heading)


def _turned_back(coordinate: float, part: float, wall: float) -> float:
    """The part of a heading along one axis, after turning back at the walls of that axis."""
    if coordinate + WALK_M * part > wall:
        return -abs(part)
    if coordinate + WALK_M * part < -wall:
        return abs(part)
    return part


class Block(NamedTuple):
    """A rectangle, metres."""

    west: float
    south: float
    width: float
    height: float


def blocks(drones: int, width: float, height: float) -> list[Block]:
    """One block for each drone. Together they cover the area, all are equally large, and they are about square.

    They lie in rows, from the south, and each row from the west. Where the drones do not fill the rows evenly, some
    rows have one block more than others, and are higher.

    :param drones: at least 1.
    :param width: of the area from west to east, metres, > 0.
    :param height: from south to north, metres, > 0.
    """
    rows = min(max(round((drones * height / width) ** 0.5), 1), drones)
    found = []
    south = -height / 2
    for row in range(rows):
        # Those that are left over are spread over the rows.
        columns = (row + 1) * drones // rows - row * drones // rows
        high = height * columns / drones
        wide = width / columns
        found += [Block(-width / 2 + column * wide, south, wide, high) for column in range(columns)]
        south += high
    return found


class Lawnmower:
    """A way in parallel strips over a block: along the first to the east, along the next to the west, and so on."""

    def __init__(self, block: Block, strip_m: float) -> None:
        """`strip_m`: the most that two strips may be apart, metres, > 0."""
        strips = max(-int(-block.height // strip_m), 1)
        self._gap = block.height / strips
        # The ends of a strip are as far from the edge of the block as its sides.
        inset = min(self._gap, block.width) / 2
        self._long = block.width - 2 * inset
        self._west = block.west + inset
        self._south = block.south + self._gap / 2
        self.length_m = strips * self._long + (strips - 1) * self._gap
        """Of the way from one end to the other, metres; 0 in a block that one place covers."""

    def at(self, metres: float) -> Position:
        """The place after so many metres (any number) along the way, from its end back to its start, and so on."""
        if not self.length_m:
            return self._west, self._south
        along = metres % (2 * self.length_m)
        if along > self.length_m:
            along = 2 * self.length_m - along
        strip, rest = divmod(along, self._long + self._gap)
        east = min(rest, self._long)
        if strip % 2:
            east = self._long - east
        return self._west + east, self._south + strip * self._gap + max(rest - self._long, 0.0)


class Perimeter:
    """The way along the edge of the area, anticlockwise, from the middle of the south side."""

    def __init__(self, width: float, height: float) -> None:
        self._width = width
        self._height = height
        self.length_m = 2 * (width + height)

    def at(self, metres: float) -> Position:
        """The place after so many metres (any number)."""
        width, height = self._width, self._height
        along = (metres + width / 2) % self.length_m
        if along <= width:
            return along - width / 2, -height / 2
        along -= width
        if along <= height:
            return width / 2, along - height / 2
        along -= height
        if along <= width:
            return width / 2 - along, height / 2
        return -width / 2, height / 2 - (along - width)

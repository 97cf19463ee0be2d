"""Places and motion of the robots in the authors' experiment: `mobility.layout: authors`.

Source: the authors' repository MISTLab/RASS at d362ebf. The authors' logs confirm the grid. The rest are readings of
settings that changed between the runs. Guesses of ours are marked as such below.
"""

from __future__ import annotations

import math
from random import Random

from rass_mav.errors import ConfigError
from rass_mav.lab.medium.neighbours import Cells, Position

from .mobility import Mobility, Static

#: The grid: robots in a row, metres between them, and the first robot's x and y.
GRID_SIDE = 10
GRID_PITCH_M = 2.0
GRID_FIRST_M = 9.0
#: Robots placed at random: uniform in +- this along each axis, metres. The authors had 9 and 10 at different times.
SCALE_FREE_M = 10.0
LJ_START_M = 9.0
#: The goal of the base from its random place: the corner of its quadrant, this far from both axes, metres.
CORNER_M = 7.5
#: Walls of the arena, metres from the centre.
WALL_M = 11.0
#: Lennard-Jones: distance that robots keep, metres.
LJ_DISTANCE_M = 2.83
#: The most a robot drives in a step: the base to its corner, any robot under Lennard-Jones, metres (guesses).
HOMING_STEP_M = 0.1
LJ_STEP_M = 0.003
#: Random walk: the share of the distance to its target that a robot drives in a step (a guess).
WALK_SHARE = 0.03
#: Lennard-Jones: metres a step for a force of one (a guess).
LJ_GAIN = 0.1
#: Lennard-Jones: how far robots feel each other, metres: the radio range.
LJ_REACH_M = 3.5
#: Random walk: how far a target moves in a step, in a random direction, and how far it gets from the centre along each
#: axis, metres (guesses).
WALK_TARGET_M = 0.5
WALK_BOX_M = 10.0


class Homing(Mobility):
    """Robots that stay where they are, except the base (id 0): it drives to the corner of its quadrant."""

    def __init__(self, positions: list[Position]) -> None:
        super().__init__(positions)
        x, y = positions[0]
        self._corner = (math.copysign(CORNER_M, x), math.copysign(CORNER_M, y))

    def _advance(self, t: int) -> bool:
        if self.positions[0] == self._corner:
            return False
        self.positions = [towards(self.positions[0], self._corner, HOMING_STEP_M), *self.positions[1:]]
        return True


class AuthorsLennardJones(Homing):
    """Robots that keep `LJ_DISTANCE_M` from those within reach, while the base drives to its corner.

    The force of a neighbour at distance r is 1/r ((d0/r)^4 - (d0/r)^2), pushing away where it is positive.
    """

    def _advance(self, t: int) -> bool:
        super()._advance(t)
        positions = self.positions
        cells = Cells(LJ_REACH_M)
        for i, (x, y) in enumerate(positions):
            cells.add(i, x, y)
        moved = [positions[0]]
        for i, (x, y) in enumerate(positions):
            if i == 0:
                continue
            push_x = push_y = 0.0
            for j, r2 in cells.near(x, y):
                if j == i or r2 == 0.0 or r2 > LJ_REACH_M**2:
                    continue
                ratio2 = LJ_DISTANCE_M**2 / r2
                push = LJ_GAIN * (ratio2 * ratio2 - ratio2) / r2
                push_x += push * (x - positions[j][0])
                push_y += push * (y - positions[j][1])
            goal = (_inside(x + push_x), _inside(y + push_y))
            moved.append(towards((x, y), goal, LJ_STEP_M))
        self.positions = moved
        return True


class Chase(Mobility):
    """Every robot, the base too, drives after a target of its own, which does a random walk in a box.

    It starts at its target, and in each step it drives `WALK_SHARE` of the distance to it. So the grid dissolves slowly
    at first, as it does in the authors' curves: for the first ten steps they are those of the grid.
    """

    def __init__(self, positions: list[Position], rng: Random) -> None:
        super().__init__(positions)
        self._targets = list(positions)
        self._rng = rng

    def _advance(self, t: int) -> bool:
        moved = []
        for i, position in enumerate(self.positions):
            x, y = self._targets[i]
            heading = self._rng.uniform(0.0, 2 * math.pi)
            self._targets[i] = target = (
                min(max(x + WALK_TARGET_M * math.cos(heading), -WALK_BOX_M), WALK_BOX_M),
                min(max(y + WALK_TARGET_M * math.sin(heading), -WALK_BOX_M), WALK_BOX_M),
            )
            moved.append(
                (
                    position[0] + WALK_SHARE * (target[0] - position[0]),
                    position[1] + WALK_SHARE * (target[1] - position[1]),
                )
            )
        self.positions = moved
        return True


def make_authors_mobility(topology: str, nodes: int, rng: Random) -> Mobility:
    """Places and motion by the name of a topology. Raises `ConfigError` for one that the authors did not use."""
    if topology == "grid":
        return Static(authors_grid(nodes))
    if topology == "random-walk":
        return Chase(authors_grid(nodes), rng)
    if topology == "scale-free":
        return Homing(_uniform(nodes, SCALE_FREE_M, rng))
    if topology == "lennard-jones":
        return AuthorsLennardJones(_uniform(nodes, LJ_START_M, rng))
    raise ConfigError(
        f"mobility.layout: authors has grid, scale-free, lennard-jones and random-walk, not the topology {topology}"
    )


def authors_grid(nodes: int) -> list[Position]:
    """Ten in a row from the corner (9, 9), 2 m apart: robot i at x = 9 - 2 (i mod 10), y = 9 - 2 (i div 10)."""
    return [
        (GRID_FIRST_M - GRID_PITCH_M * (i % GRID_SIDE), GRID_FIRST_M - GRID_PITCH_M * (i // GRID_SIDE))
        for i in range(nodes)
    ]


def _uniform(nodes: int, reach_m: float, rng: Random) -> list[Position]:
    return [(rng.uniform(-reach_m, reach_m), rng.uniform(-reach_m, reach_m)) for _ in range(nodes)]


def towards(position: Position, goal: Position, step_m: float) -> Position:
    """Where a robot that drives to a goal is a step later: there, or `step_m` nearer."""
    distance = math.dist(position, goal)
    if distance <= step_m:
        return goal
    share = step_m / distance
    return position[0] + share * (goal[0] - position[0]), position[1] + share * (goal[1] - position[1])


def _inside(coordinate: float) -> float:
    return min(max(coordinate, -WALL_M), WALL_M)

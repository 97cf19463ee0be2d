"""Counting to infinity: Alg. 2 exactly as the paper writes it, beside our routing table, when the base vanishes.

No swarm and no bytes: only which node hears which, and one beacon a step from each node to all its neighbours.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

from rass_mav.core.messages import BEACON_BASE, BEACON_WANTED, NO_ROUTE, Beacon
from rass_mav.core.routes.announcements import following
from rass_mav.core.routes.ranks import ByHops
from rass_mav.core.routes.table import RoutingTable
from rass_mav.core.settings import NodeSettings
from rass_mav.lab.experiment.figures import OTHERS, Curve, Panel, draw
from rass_mav.lab.experiment.tables import markdown, write_csv, write_text
from rass_mav.lab.medium.neighbours import RangeGraph
from rass_mav.lab.swarm.statistics import count_loops
from rass_mav.lab.swarm.topology import grid, line
from rass_mav.policy.settings import PolicySettings

#: The step from which on the base is gone.
VANISHES = 60
#: Node 0 is the base. The grid is the paper's; the line has its greatest distance.
LAYOUTS = {"grid": RangeGraph(grid(100, 20.0), 3.0).neighbours, "line": RangeGraph(line(10, 2.0), 3.0).neighbours}
COLUMNS = ("layout", "algorithm", "step", "nodes_with_route", "hops_mean", "hops_max", "cycles")


class Router(Protocol):
    """All nodes' tables under one algorithm. Node 0 is the base, until it vanishes."""

    def step(self, base: bool) -> None:
        """Every node processes what was broadcast in the step before, and broadcasts. `base`: node 0 is present."""

    def hops(self) -> list[int | None]:
        """Hop count that each node believes in; None: no route. Node 0 is left out."""

    def next_hops(self) -> list[int | None]:
        """The neighbour to which each node would hand over its data."""


class AsWritten:
    """Alg. 2: routing_table <- the neighbours' broadcasts; min_hops = min of it, 0 at the base; broadcast min_hops + 1.

    The text does not say whether an entry ever leaves the table. `forgets`: the table contains what was heard in the
    last step; otherwise it is a hash table in which a neighbour that fell silent stays.
    """

    def __init__(self, neighbours: Sequence[Sequence[int]], *, forgets: bool) -> None:
        self._neighbours = neighbours
        self._forgets = forgets
        self._tables: list[dict[int, int]] = [{} for _ in neighbours]
        self._said: dict[int, int] = {}

    def step(self, base: bool) -> None:
        said: dict[int, int] = {}
        for node, near in enumerate(self._neighbours):
            if node == 0 and not base:
                continue
            table = self._tables[node]
            if self._forgets:
                table.clear()
            table.update((n, self._said[n]) for n in near if n in self._said)
            if node == 0:
                said[node] = 1
            elif table:
                said[node] = min(table.values()) + 1
        self._said = said

    def hops(self) -> list[int | None]:
        return [min(table.values()) if table else None for table in self._tables]

    def next_hops(self) -> list[int | None]:
        return [None, *(min(table, key=lambda n: (table[n], n)) if table else None for table in self._tables[1:])]


class Ours:
    """The routing table that flies: announcement numbers, feasibility, and neighbours that are forgotten in time."""

    def __init__(self, neighbours: Sequence[Sequence[int]]) -> None:
        self._period = PolicySettings(name="hop-count").make().seq_period
        self._neighbours = neighbours
        self._tables = [
            RoutingTable(NodeSettings(node_id=n, base=n == 0, without=("contacts",)), life=n, rank=ByHops())
            for n in range(len(neighbours))
        ]
        self._said: dict[int, Beacon] = {}
        self._step = 0

    def step(self, base: bool) -> None:
        now = float(self._step)
        said: dict[int, Beacon] = {}
        for node, near in enumerate(self._neighbours):
            if node == 0 and not base:
                continue
            table = self._tables[node]
            for n in near:
                if n in self._said:
                    table.hear(self._said[n], now)
            if node == 0 and self._step % self._period == 0:
                table.announce(following(table.number))
            table.update(now)
            table.announced(now)
            said[node] = _beacon(table, self._step)
        self._said = said
        self._step += 1

    def hops(self) -> list[int | None]:
        return [None if table.hops == NO_ROUTE else table.hops for table in self._tables]

    def next_hops(self) -> list[int | None]:
        return [None, *(table.next_hop for table in self._tables[1:])]


def _beacon(table: RoutingTable, number: int) -> Beacon:
    """A node's beacon about its route; the other fields do not matter here."""
    flags = (BEACON_BASE if table.base else 0) | (BEACON_WANTED if table.wanted else 0)
    base, epoch, route_number, hops = table.route if table.route is not None else (0, 0, 0, NO_ROUTE)
    wanted_base, wanted_number = table.wanted or (0, 0)
    return Beacon(
        table.node_id, table.life, number & 0xFFFF, flags, base, epoch, route_number, hops, wanted_base,
        wanted_number, risk=0, free=1, policy=0, potential=0, statements_hash=0,
    )  # fmt: skip


class Sample(NamedTuple):
    """All nodes except the base, after a step."""

    step: int
    with_route: int
    mean: float | None
    """Hop count, of the nodes with a route."""
    highest: int | None
    cycles: int
    """In the graph of next hops."""


def observe(router: Router, steps: int, vanishes: int) -> list[Sample]:
    """Run it for `steps` steps; the base is silent from step `vanishes` on."""
    samples = []
    for step in range(steps):
        router.step(step < vanishes)
        hops = [h for h in router.hops()[1:] if h is not None]
        mean = sum(hops) / len(hops) if hops else None
        cycles = count_loops(router.next_hops())
        samples.append(Sample(step, len(hops), mean, max(hops, default=None), cycles))
    return samples


#: Name in files, name for people, colour, marker.
ALGORITHMS = (
    ("alg2-forgets", "Alg. 2 as written, silent neighbours forgotten", OTHERS[1], "s"),
    ("alg2-keeps", "Alg. 2 as written, entries kept permanently", OTHERS[2], "^"),
    ("rass-mav", "rass-mav: announcement numbers", "#0072B2", "o"),
)


def report(out: Path, steps: int) -> list[Path]:
    """Write counting.csv, table.csv, table.md and a figure for each layout; returns their paths."""
    rows: list[list[object]] = []
    table: list[list[object]] = []
    figures = []
    for layout, neighbours in LAYOUTS.items():
        routers: dict[str, Router] = {
            "alg2-forgets": AsWritten(neighbours, forgets=True),
            "alg2-keeps": AsWritten(neighbours, forgets=False),
            "rass-mav": Ours(neighbours),
        }
        samples = {name: observe(router, steps, VANISHES) for name, router in routers.items()}
        for name, found in samples.items():
            rows += [[layout, name, *sample] for sample in found]
            table.append([layout, name, *_verdict(found)])
        figures.append(_draw(out / f"counting-{layout}.png", layout, samples))
    columns = ["layout", "algorithm", "steps_until_no_route", "highest_hops", "steps_with_cycles", "most_cycles"]
    names = {name: label for name, label, *_ in ALGORITHMS}
    text = (
        "# Counting to infinity\n\n"
        f"Node 0 is the base and falls silent at step {VANISHES} of {steps}. Counted from then on, over the\n"
        "other nodes.\n\n"
        + markdown(
            ["Layout", "Algorithm", "Steps until no node has a route", "Highest hop count", "Steps with cycles",
             "Most cycles at once"],
            [[str(row[0]), names[str(row[1])], "never" if row[2] is None else str(row[2]), *map(str, row[3:])]
             for row in table],
        )
    )  # fmt: skip
    return [
        write_csv(out / "counting.csv", COLUMNS, rows),
        write_csv(out / "table.csv", columns, table),
        write_text(out / "table.md", text),
        *figures,
    ]


def _verdict(samples: Sequence[Sample]) -> tuple[int | None, int, int, int]:
    """From the moment the base is gone: steps until no node has a route (None: never), and the other columns."""
    after = samples[VANISHES:]
    believing = [s.step for s in after if s.with_route]
    gone = None if believing and believing[-1] == after[-1].step else (believing[-1] + 1 - VANISHES if believing else 0)
    return (
        gone,
        max((s.highest for s in after if s.highest is not None), default=0),
        sum(s.cycles > 0 for s in after),
        max(s.cycles for s in after),
    )


def _draw(path: Path, layout: str, samples: dict[str, list[Sample]]) -> Path:
    nan = float("nan")
    hops, routes, cycles = [], [], []
    for name, label, color, marker in ALGORITHMS:
        found = samples[name]
        x = [s.step for s in found]
        hops.append(Curve(label, x, [nan if s.highest is None else s.highest for s in found], color, marker))
        routes.append(Curve(label, x, [s.with_route for s in found], color, marker))
        cycles.append(Curve(label, x, [s.cycles for s in found], color, marker))
    others = len(LAYOUTS[layout]) - 1
    return draw(
        path,
        [
            Panel(f"The base vanishes at step {VANISHES}: {layout} of {others + 1} nodes", "step",
                  "highest hop count believed (hops)", hops),
            Panel("Nodes that believe in a route", "step", f"nodes (of {others})", routes),
            Panel("Cycles of next hops", "step", "cycles in the graph of next hops", cycles),
        ],
        legend_columns=1,
    )  # fmt: skip

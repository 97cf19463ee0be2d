"""Our defaults and the protocols that others have published, at the same airtime and memory, on the same air.

All have the same seeds, and so the same places, motion, sources, noise and failures. So they are compared run by run.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rass_mav.errors import ConfigError
from rass_mav.lab.baselines import OURS, PROTOCOLS
from rass_mav.lab.experiment.airs import AIRS
from rass_mav.lab.experiment.comparison import Comparison, compare
from rass_mav.lab.experiment.figures import SHARE, Point, Scatter, Style, draw_scatter
from rass_mav.lab.experiment.policies import Place
from rass_mav.lab.experiment.runs import Extent, Result, Run
from rass_mav.lab.experiment.standard import COLUMNS, HEADINGS, NOTE, PAIRED
from rass_mav.lab.experiment.statistics import counted
from rass_mav.lab.experiment.tables import cell, figures_of, markdown, triple, write_csv, write_runs, write_text
from rass_mav.lab.swarm.ledger import LOST
from rass_mav.policy.settings import PolicySettings

#: By the name that `--place` takes.
PLACES = {
    "grid": Place("grid", "demo"),
    "walk": Place("random walk", "demo", {"topology": "random-walk"}),
    # Without pictures: the baselines send a datum whole in one frame. With as much memory as elsewhere.
    "field": Place("field", "field-wifi-6m", {
        "radio.preset": None, "traffic.load": None, "traffic.picture_bytes": 0, "data.interval_steps": 5,
        "store.capacity_items": 50, "store.capacity_bytes": None,
    }),
    "dying": Place("random walk, 60 % of the drones die", "demo", {
        "topology": "random-walk", "failures.die_fraction": 0.6,
    }),
}  # fmt: skip
#: `Run.world` of each place and air.
WORLDS = {f"{place}-{air}": (place, air) for place in PLACES for air in AIRS}
#: Data are created in this part of the steps. In the rest the swarm can deliver what is left.
CREATING = 0.9

_REASONS = tuple(fate.value for fate in LOST)
TABLE_COLUMNS = (
    "place", "air", "protocol", "runs", "steps", *COLUMNS, *triple("reliability_over_ours"),
    *triple("delivered_over_ours"), "losses_in_ours", *triple("memory"), "loops",
    *(column for reason in _REASONS for column in triple(f"lost_{reason}")),
)  # fmt: skip
_STYLES = dict(
    zip(
        PROTOCOLS,
        (
            ("#E69F00", "P"), ("#D55E00", "s"), ("#000000", "X"), ("#CC79A7", "v"), ("#0072B2", "o"), ("#009E73", "^"),
            ("#56B4E9", "D"), ("#999999", "p"),
        ),
        strict=True,
    )
)  # fmt: skip

#: The figures of each protocol in each world.
Compared = dict[str, dict[str, Comparison]]


def plan(
    extent: Extent, places: Sequence[str], airs: Sequence[str], protocols: Sequence[str], *, own_runs: int | None = None
) -> list[Run]:
    """The runs of each combination. `own_runs`: of our defaults; None: as many as of the others.

    Raises `ConfigError`.
    """
    planned = []
    for place in places:
        for air in airs:
            for name in protocols:
                protocol = PROTOCOLS[name]
                keys = {
                    **PLACES[place].keys, **AIRS[air], "data.until_step": math.ceil(CREATING * extent.steps),
                    **protocol.keys,
                }  # fmt: skip
                ours = extent if own_runs is None or name != OURS else extent._replace(runs=own_runs)
                policy = keys.get("policy.name", PolicySettings().name)
                runs = ours.plan(f"{place}-{air}", PLACES[place].scenario, [policy], variant=name, keys=keys)
                if runs[0].policy != policy:
                    raise ConfigError("--set: policy.name is chosen by --baseline here")
                planned += [replace(run, protocol=name) for run in runs]
    return planned


def report(results: Sequence[Result], out: Path) -> list[Path]:
    """Write runs.csv, table.csv, table.md and a figure for each place; returns their paths."""
    groups: dict[str, dict[str, list[Result]]] = {}
    for result in results:
        groups.setdefault(result.world, {}).setdefault(result.variant, []).append(result)
    compared = {
        world: {name: compare(found, here.get(OURS, ())) for name, found in here.items()}
        for world, here in groups.items()
    }
    places = dict.fromkeys(WORLDS[world][0] for world in compared)
    return [
        write_runs(out / "runs.csv", results),
        write_csv(out / "table.csv", TABLE_COLUMNS, _rows(compared)),
        write_text(out / "table.md", _text(compared)),
        *(_draw(out / f"reliability-by-bytes-{place}.png", place, compared) for place in places),
    ]


def _rows(compared: Compared) -> list[list[object]]:
    """`TABLE_COLUMNS`."""
    return [
        [
            *WORLDS[world], name, c.standard.runs, c.standard.steps, *c.standard.columns(), *figures_of(c.gain, 6),
            *figures_of(c.delivered_gain, 6), c.loss_ratio, *figures_of(c.memory), c.loops,
            *(value for reason in _REASONS for value in figures_of(c.lost[reason], 6)),
        ]
        for world, here in compared.items()
        for name, c in here.items()
    ]  # fmt: skip


def _text(compared: Compared) -> str:
    """A table for each place and air, and first of all where ours is not the best."""
    first = next(iter(next(iter(compared.values())).values())).standard
    columns = ["Protocol", "Runs", *HEADINGS, "Reliability, more", "Delivered, more", "Losses, x", "Memory, %"]
    parts = [
        "# Baselines\n",
        f"Runs of {first.steps} steps. More, x: compared with our defaults, in the runs that both have.\n",
        NOTE + PAIRED,
        *_verdict(compared),
    ]
    for world, here in compared.items():
        parts.append(f"## {_title(world)}\n")
        parts.append(markdown(columns, [_cells(name, c) for name, c in here.items()]))
    return "\n".join(parts)


def _verdict(compared: Compared) -> list[str]:
    """Where a protocol loses less than ours."""
    if not all(OURS in here for here in compared.values()):
        return []
    better = [
        f"- {_title(world)}: {PROTOCOLS[name].title}, {cell(c.gain, 4, sign='+')}\n"
        for world, here in compared.items()
        for name, c in here.items()
        if name != OURS and c.gain is not None and c.gain.mean > 0
    ]
    if not better:
        return ["None of the protocols loses less than ours anywhere.\n"]
    return ["These lose less than ours (the difference in reliability, and its interval):\n", "".join(better)]


def _cells(name: str, c: Comparison) -> list[str]:
    gains = [cell(gain, 4, sign="+") for gain in (c.gain, c.delivered_gain)]
    return [
        PROTOCOLS[name].title,
        str(c.standard.runs),
        *c.standard.cells(),
        *gains,
        cell(c.loss_ratio),
        cell(c.memory),
    ]


def _title(world: str) -> str:
    place, air = WORLDS[world]
    return f"{PLACES[place].title}, air {air}"


def _draw(path: Path, place: str, compared: Compared) -> Path:
    """Reliability against bytes on the air: a panel an air."""
    here = {world: found for world, found in compared.items() if WORLDS[world][0] == place}
    points = {world: [_point(name, c) for name, c in found.items()] for world, found in here.items()}
    shown = [point for found in points.values() for point in found]
    lowest = min(point.y.reach[0] for point in shown)
    widest = max(point.x.reach[1] for point in shown)
    panels = [
        Scatter(
            _title(world), "bytes per node and second", "reliability (1 - lost / created)", found,
            (0.0, 1.08 * widest or 1.0), (max(0.0, math.floor(10 * lowest) / 10), 1.01), SHARE,
        )
        for world, found in points.items()
    ]  # fmt: skip
    used = dict.fromkeys(name for found in here.values() for name in found)
    runs = max(c.standard.runs for found in here.values() for c in found.values())
    return draw_scatter(path, panels, [_style(name) for name in used], note=f"mean of {counted(runs, 'error bars')}")


def _point(name: str, c: Comparison) -> Point:
    return Point(_style(name), c.standard.bytes_per_node_s, c.standard.reliability)


def _style(name: str) -> Style:
    color, marker = _STYLES[name]
    return Style(PROTOCOLS[name].title, color, marker)

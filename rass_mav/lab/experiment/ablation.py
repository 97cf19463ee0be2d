"""What each part of the defaults is worth: it is switched off alone, and all together, on several airs.

The swarms are the paper's, with this product's own defaults (scenarios `demo` and `islands`).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rass_mav.errors import ConfigError
from rass_mav.lab.experiment.airs import AIRS, SLOW_AIRS
from rass_mav.lab.experiment.comparison import Comparison, compare
from rass_mav.lab.experiment.figures import OTHERS, SHARE, Bars, draw_bars
from rass_mav.lab.experiment.paper import TOPOLOGY_TITLES
from rass_mav.lab.experiment.policies import Place
from rass_mav.lab.experiment.runs import Extent, Result, Run
from rass_mav.lab.experiment.standard import COLUMNS, HEADINGS, NOTE, PAIRED
from rass_mav.lab.experiment.statistics import Estimate, counted
from rass_mav.lab.experiment.tables import cell, figures_of, markdown, triple, write_csv, write_runs, write_text
from rass_mav.lab.swarm.catalogue import DEFAULT
from rass_mav.policy.settings import PolicySettings


@dataclass(frozen=True)
class Switch:
    """Something that can be switched off."""

    title: str
    """What is there without it."""
    keys: dict[str, Any]


_PARTS = {
    "policy": Switch("hop count instead of survival", {"policy.name": "hop-count"}),
    "immediate": Switch("one hop a step", {"node.forward": "step"}),
    "mirror": Switch("no spare copies", {"custody.mirror": False}),
    "receipts": Switch("no receipts", {"custody.receipts": False}),
    "copies": Switch("one spare copy at most", {"custody.copies": 1}),
}
#: The defaults as they are: the others are compared with them.
NOTHING = "nothing"
#: By the name that `--off` takes.
SWITCHES = {
    NOTHING: Switch("the defaults", {}),
    **_PARTS,
    "everything": Switch("all of these", {key: value for part in _PARTS.values() for key, value in part.keys.items()}),
}
ALL_AIRS = {**AIRS, **SLOW_AIRS}
#: What is run unless chosen otherwise.
USUAL_AIRS = tuple(AIRS)
USUAL_PLACES = ("grid", "random-walk")
#: By the name that `--topology` takes.
PLACES = {
    **{name: Place(title, DEFAULT, {"topology": name}) for name, title in TOPOLOGY_TITLES.items()},
    "islands": Place("islands", "islands"),
}
TABLE_COLUMNS = (
    "air", "topology", "off", "runs", "steps", *COLUMNS, *triple("reliability_over_defaults"),
    *triple("delivered_over_defaults"), "losses_in_defaults", "transmissions_in_defaults", "loops",
)  # fmt: skip


def plan(extent: Extent, airs: Sequence[str], topologies: Sequence[str], switches: Sequence[str]) -> list[Run]:
    """The runs of each combination. Raises `ConfigError`."""
    planned = []
    for air in airs:
        for topology in topologies:
            for name in switches:
                place = PLACES[topology]
                keys = {**place.keys, **ALL_AIRS[air], **SWITCHES[name].keys}
                planned += extent.plan(air, place.scenario, [PolicySettings().name], variant=name, keys=keys)
                if planned[-1].scenario.topology != topology:
                    raise ConfigError("--set: the topology is chosen by --topology here")
    return planned


def report(results: Sequence[Result], out: Path) -> list[Path]:
    """Write runs.csv, table.csv, table.md and two figures for each topology; returns their paths."""
    groups: dict[tuple[str, str], dict[str, list[Result]]] = {}
    for result in results:
        groups.setdefault((result.topology, result.world), {}).setdefault(result.variant, []).append(result)
    compared = {
        where: {name: compare(found, here.get(NOTHING, ())) for name, found in here.items()}
        for where, here in groups.items()
    }
    files = [
        write_runs(out / "runs.csv", results),
        write_csv(out / "table.csv", TABLE_COLUMNS, _rows(compared)),
        write_text(out / "table.md", _text(compared)),
    ]
    for topology in dict.fromkeys(topology for topology, _ in compared):
        here = {air: found for (where, air), found in compared.items() if where == topology}
        files += [_draw(out, topology, here, share) for share in _SHARES]
    return files


#: Figures by topology and air, then by what is off.
Compared = dict[tuple[str, str], dict[str, Comparison]]


def _rows(compared: Compared) -> list[list[object]]:
    """`TABLE_COLUMNS`."""
    return [
        [
            air, topology, name, c.standard.runs, c.standard.steps, *c.standard.columns(), *figures_of(c.gain, 6),
            *figures_of(c.delivered_gain, 6), c.loss_ratio, c.transmission_ratio, c.loops,
        ]
        for (topology, air), here in compared.items()
        for name, c in here.items()
    ]  # fmt: skip


def _text(compared: Compared) -> str:
    """A table for each topology and air."""
    first = next(iter(next(iter(compared.values())).values())).standard
    columns = ["Off", "Instead", *HEADINGS, "Reliability, more", "Delivered, more", "Losses, x", "Sent, x"]
    parts = [
        "# What each part of the defaults is worth\n",
        f"{counted(first.runs)} of {first.steps} steps. More, x: compared with the defaults in the same runs.\n",
        NOTE + PAIRED,
    ]
    for (topology, air), here in compared.items():
        parts.append(f"## {PLACES[topology].title}, air {air}\n")
        lines = [
            [
                name, SWITCHES[name].title, *c.standard.cells(),
                *("reference" if name == NOTHING else cell(e, 4, sign="+") for e in (c.gain, c.delivered_gain)),
                cell(c.loss_ratio), cell(c.transmission_ratio),
            ]
            for name, c in here.items()
        ]  # fmt: skip
        parts.append(markdown(columns, lines))
    return "\n".join(parts)


#: The shares that figures show, and how they are computed.
_SHARES = {"reliability": "1 - lost / created", "delivered": "arrived / created"}


def _draw(out: Path, topology: str, here: dict[str, dict[str, Comparison]], share: str) -> Path:
    names = list(next(iter(here.values())))
    bars = []
    for color, (air, found) in zip(itertools.cycle(OTHERS), here.items(), strict=False):
        heights: list[Estimate] = [getattr(found[name].standard, share) for name in names]
        bars.append(Bars(f"air {air}", color, heights))
    runs = next(iter(next(iter(here.values())).values())).standard.runs
    return draw_bars(
        out / f"{share}-{topology}.png", f"{share} with a part of the defaults off: {PLACES[topology].title}",
        f"{share} ({_SHARES[share]})", names, bars,
        bounds=SHARE, note=f"mean of {counted(runs, 'error bars')}",
    )  # fmt: skip

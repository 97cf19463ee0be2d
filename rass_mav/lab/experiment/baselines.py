"""Our defaults and the protocols that others have published, at the same airtime and memory, on the same air.

All have the same seeds, and so the same places, motion, sources, noise and failures. So they are compared run by run.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from rass_mav.errors import ConfigError
from rass_mav.lab.baselines import OURS, PROTOCOLS
from rass_mav.lab.experiment.columns import (
    BYTES,
    LOOPS,
    LOST_BY_REASON,
    MEMORY,
    RELIABILITY,
    STANDARD,
    Group,
    delivered,
    difference,
    kept,
    losses,
    number,
    ratio,
)
from rass_mav.lab.experiment.declaration import AIRS, Case, Experiment, Factor, Level, by_air, counted_runs, split
from rass_mav.lab.experiment.figures import SHARE, Point, Scatter, Style, around, draw_scatter
from rass_mav.lab.experiment.tables import cell

#: By the name that `--place` takes.
PLACES = {
    "grid": Level("grid"),
    "walk": Level("random walk", {"topology": "random-walk"}),
    # Without pictures: the baselines send a datum whole in one frame. With as much memory as elsewhere.
    "field": Level("field", scenario="field-wifi-6m", keys={
        "radio.preset": None, "traffic.load": None, "traffic.picture_bytes": 0, "data.interval_steps": 5,
        "store.capacity_items": 50, "store.capacity_bytes": None,
    }),
    "dying-walk": Level("random walk, 60 % of the drones die", {
        "topology": "random-walk", "failures.die_fraction": 0.6,
    }),
}  # fmt: skip
#: Data are created in this part of the steps. In the rest the swarm can deliver what is left.
CREATING = 0.9
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

#: What a protocol loses less than ours.
GAIN = difference("reliability_over_ours", "Reliability, more", kept, shown=4)


def experiment(own_runs: int | None = None) -> Experiment:
    """Its declaration. `own_runs`: of our defaults; None: as many as of the others. Raises `ConfigError`."""
    if own_runs is not None and own_runs < 1:
        raise ConfigError(f"--own-runs: expected 1 or more, got {own_runs}")
    protocols = {name: Level(protocol.title, protocol.keys) for name, protocol in PROTOCOLS.items()}
    return Experiment(
        title="Baselines",
        factors=[
            Factor("place", "Place", PLACES, "--place"),
            by_air(AIRS),
            Factor("protocol", "Protocol", protocols, "--baseline", key="policy.name"),
        ],
        columns=[
            number("", "Runs", lambda group: len(group.runs), shown=0),
            *STANDARD,
            GAIN,
            difference("delivered_over_ours", "Delivered, more", delivered, shown=4),
            ratio("losses_in_ours", "Losses, x", losses),
            MEMORY,
            LOOPS,
            *LOST_BY_REASON,
        ],
        scenario="demo",
        world="{place}-{air}",
        variant="{protocol}",
        protocol="{protocol}",
        keys=_keys,
        runs=lambda case, runs: own_runs if own_runs is not None and case["protocol"] == OURS else runs,
        reference={"protocol": OURS},
        intro="Runs of {steps} steps. More, x: compared with our defaults, in the runs that both have.\n",
        before=_verdict,
        sections=("place", "air"),
        section_title=_title,
        files=_files,
    )


def _keys(case: Case, steps: int) -> dict[str, Any]:
    return {"data.until_step": math.ceil(CREATING * steps)}


def _title(groups: Sequence[Group]) -> str:
    case = groups[0].case
    return f"{PLACES[case['place']].title}, air {case['air']}"


def _verdict(groups: Sequence[Group]) -> list[str]:
    """Where a protocol loses less than ours."""
    if not all(group.reference for group in groups):
        return []
    better = [
        f"- {_title([group])}: {PROTOCOLS[group.case['protocol']].title}, {cell(gain, 4, sign='+')}\n"
        for group in groups
        if (gain := group.estimate(GAIN)) is not None and gain.mean > 0
    ]
    if not better:
        return ["None of the protocols loses less than ours anywhere.\n"]
    return ["These lose less than ours (the difference in reliability, and its interval):\n", "".join(better)]


def _files(groups: Sequence[Group], out: Path) -> Iterator[Path]:
    """Reliability against bytes on the air: a figure a place, a panel an air."""
    for (place,), here in split(groups, "place").items():
        ranges = around([*map(_point, here)])
        panels = [
            Scatter(
                _title(found), "bytes per node and second", "reliability (1 - lost / created)", [*map(_point, found)],
                *ranges, SHARE,
            )
            for found in split(here, "air").values()
        ]  # fmt: skip
        keys = [_style(protocol) for (protocol,) in split(here, "protocol")]
        path = out / f"reliability-by-bytes-{place}.png"
        yield draw_scatter(path, panels, keys, note=f"mean of {counted_runs(here, 'error bars')}")


def _point(group: Group) -> Point:
    return Point(_style(group.case["protocol"]), group.certain(BYTES), group.certain(RELIABILITY))


def _style(name: str) -> Style:
    color, marker = _STYLES[name]
    return Style(PROTOCOLS[name].title, color, marker)

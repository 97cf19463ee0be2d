"""What each part of the defaults is worth: it is switched off alone, and all together, on several airs.

The swarms are the paper's, with this product's own defaults (scenarios `demo` and `islands`).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import median

from rass_mav.lab.experiment.columns import (
    DELIVERED,
    LOOPS,
    RELIABILITY,
    STANDARD,
    Group,
    delivered,
    difference,
    kept,
    losses,
    number,
    ratio,
    transmissions,
)
from rass_mav.lab.experiment.declaration import (
    AIRS,
    SLOW_AIRS,
    TOPOLOGIES,
    Experiment,
    Factor,
    Level,
    by_air,
    by_topology,
    counted_runs,
    split,
)
from rass_mav.lab.experiment.figures import OTHERS, SHARE, Bars, draw_bars
from rass_mav.lab.swarm.scenario import DEFAULT

#: Mechanisms that are left out alone, and what is done then.
_MECHANISMS = {
    "lasting-replicas": "replicas until passed on",
    "distant-replicas": "no distant replicas",
    "overhearing": "nothing overheard",
    "measured-retries": "repeats after a fixed time",
    "contacts": "no forecast of contacts",
    "queue-toll": "queues make no route dearer",
    "delivery-scores": "no forwarder is suspected",
    "passive-acknowledgement": "only answers end repeats",
}

_PARTS = {
    "policy": Level("hop count instead of survival", {"policy.name": "hop-count"}),
    "immediate": Level("one hop a step", {"node.forward": "step"}),
    "mirror": Level("no replicas", {"custody.replicas": False}),
    "receipts": Level("no receipts", {"without": ["receipts"]}),
}
#: The defaults as they are: the others are compared with them.
NOTHING = "nothing"
#: By the name that `--off` takes; the titles say what is there instead.
SWITCHES = {
    NOTHING: Level("the defaults"),
    **_PARTS,
    "everything": Level("all of these", {key: value for part in _PARTS.values() for key, value in part.keys.items()}),
    **{name: Level(title, {"without": [name]}) for name, title in _MECHANISMS.items()},
}
ALL_AIRS = {**AIRS, **SLOW_AIRS}
PLACES = {
    **{name: Level(title, {"topology": name}) for name, title in TOPOLOGIES.items()},
    "islands": Level("islands", scenario="islands"),
    "blast": Level("islands, and a blast at step 250", {"failures.blast": 250}, scenario="islands"),
    "dying": Level("grid, a tenth of the drones dies", {"topology": "grid", "failures.die_fraction": 0.1}),
    "field": Level("survey of a field", scenario="field-wifi-6m"),
}
#: The shares that figures show, and how they are computed.
_SHOWN = {RELIABILITY: "1 - lost / created", DELIVERED: "arrived / created"}


def experiment() -> Experiment:
    """Its declaration."""
    return Experiment(
        title="What each part of the defaults is worth",
        factors=[
            by_air(ALL_AIRS, usual=AIRS),
            by_topology(PLACES, usual=("grid", "random-walk")),
            Factor("off", "Off", SWITCHES, "--off", show=lambda case: case["off"]),
        ],
        columns=[
            number("", "Instead", lambda group: SWITCHES[group.case["off"]].title),
            *STANDARD,
            difference("reliability_over_defaults", "Reliability, more", kept, shown=4),
            difference("delivered_over_defaults", "Delivered, more", delivered, shown=4),
            ratio("losses_in_defaults", "Losses, x", losses),
            ratio("transmissions_in_defaults", "Sent, x", transmissions),
            LOOPS,
        ],
        scenario=DEFAULT,
        # Surveys have pictures, which need a fast radio, and steps of a second.
        includes=lambda case: case["topology"] != "field" or case["air"].startswith("wifi"),
        if_empty="surveys of a field are over Wi-Fi",
        world="{air}",
        variant="{off}",
        reference={"off": NOTHING},
        intro="{runs} of {steps} steps. More, x: compared with the defaults in the same runs.\n",
        sections=("topology", "air"),
        measures=lambda case: ("schedule",) if case["off"] == NOTHING else (),
        section_title=lambda groups: f"{PLACES[groups[0].case['topology']].title}, air {groups[0].case['air']}",
        section_notes=_spread,
        files=_files,
    )


def _spread(groups: Sequence[Group]) -> list[str]:
    """How far the runs of the defaults are apart, and what an oracle could do."""
    runs = next((group.runs for group in groups if group.case["off"] == NOTHING), ())
    rows = {
        "the defaults keep": [kept(run).value for run in runs],
        "the defaults deliver": [delivered(run).value for run in runs],
        **{
            f"a schedule {name}": [run.extra["schedule"][key] / run.extra["schedule"]["data"] for run in runs]
            for name, key in (("keeps", "kept"), ("delivers", "delivered"), ("sends for each datum", "sent"))
        },
    }
    return [
        "| | least | median | most |\n|---|---|---|---|",
        *(f"| {name} | {min(v):.4f} | {median(v):.4f} | {max(v):.4f} |" for name, v in rows.items() if v),
        "\nThe schedule is that of an oracle which knows everything beforehand, and whose frames take airtime.\n",
    ]


def _files(groups: Sequence[Group], out: Path) -> Iterator[Path]:
    """Bars of reliability and of what was delivered: a figure a topology, a colour an air."""
    note = f"mean of {counted_runs(groups, 'error bars')}"
    for (topology,), here in split(groups, "topology").items():
        names = [off for (off,) in split(here, "off")]
        for column, formula in _SHOWN.items():
            bars = [
                Bars(f"air {air}", color, [group.certain(column) for group in found])
                for color, ((air,), found) in zip(itertools.cycle(OTHERS), split(here, "air").items(), strict=False)
            ]
            yield draw_bars(
                out / f"{column.name}-{topology}.png",
                f"{column.name} with a part of the defaults off: {PLACES[topology].title}",
                f"{column.name} ({formula})", names, bars, bounds=SHARE, note=note,
            )  # fmt: skip

"""The factors of several experiments, and their levels."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from rass_mav.lab.experiment.declaration import Factor, Level
from rass_mav.lab.experiment.figures import policy_style
from rass_mav.policy.settings import PolicySettings, kinds

POLICIES = tuple(kinds())
#: Those that hand data on.
HAND_ON = tuple(name for name in POLICIES if not PolicySettings(name=name).make().replicates)
#: Where the paper's drones are.
TOPOLOGIES = {
    "grid": "grid",
    "scale-free": "scale-free",
    "lennard-jones": "Lennard-Jones",
    "random-walk": "random walk",
}
#: Differences from the scenario (docs/air.md).
AIRS: dict[str, dict[str, Any]] = {
    "none": {},
    "wifi-6m": {"radio.preset": "wifi-6m"},
    "wifi-1m": {"radio.preset": "wifi-1m"},
}
#: On slow radios steps are long, so that as many data in a step fit. No experiment uses these unless asked to.
SLOW_AIRS: dict[str, dict[str, Any]] = {
    "sik-250k": {"radio.preset": "sik-250k", "node.step_s": 10.0},
    "sik-64k": {"radio.preset": "sik-64k", "node.step_s": 10.0},
    "lora": {"radio.preset": "lora", "node.step_s": 60.0},
}


def by_policy(names: Iterable[str], usual: Iterable[str] = ()) -> Factor:
    """The policy, with `--policy`."""
    levels = {name: Level(policy_style(name).label, {"policy.name": name}) for name in names}
    return Factor("policy", "Algorithm", levels, "--policy", tuple(usual), key="policy.name")


def by_topology(levels: Mapping[str, Level] | None = None, usual: Iterable[str] = ()) -> Factor:
    """The topology, with `--topology`: by default those of the paper, which have scenarios of their own."""
    papers = {name: Level(title) for name, title in TOPOLOGIES.items()}
    return Factor("topology", "Topology", levels or papers, "--topology", tuple(usual), key="topology")


def by_air(airs: Mapping[str, Mapping[str, Any]], usual: Iterable[str] = ()) -> Factor:
    """The air, with `--air`."""
    return Factor(
        "air", "Air", {name: Level(f"air {name}", keys) for name, keys in airs.items()}, "--air", tuple(usual)
    )

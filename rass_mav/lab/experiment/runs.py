"""One run of an experiment: what determines it, how it is done, and its results."""

from __future__ import annotations

import functools
import hashlib
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from rass_mav.config.loading import to_plain
from rass_mav.errors import RassError
from rass_mav.lab.baselines import PROTOCOLS
from rass_mav.lab.experiment.measures import MEASURES, Distance, DistanceMeasure, Series, SeriesMeasure, Watcher
from rass_mav.lab.swarm.scenario import Scenario
from rass_mav.lab.swarm.virtual import at_rest
from rass_mav.lab.swarm.world import World

#: Increase it when the form of a run's results changes.
FORMAT = 1

_PACKAGE = Path(__file__).parents[2]
#: What a run's outcome depends on: these packages with their data files, and this package's measuring modules.
_ROOMS = (
    "config", "core", "policy", "wire", "mavlink", "link", "store", "trust", "agent", "station", "app", "lab/swarm",
    "lab/medium", "lab/disk", "lab/hostile", "lab/scenarios", "lab/baselines",
)  # fmt: skip
_MODULES = ("lab/experiment/measures.py", "lab/experiment/oracle.py", "lab/experiment/runs.py")


@functools.cache
def code_hash() -> str:
    """SHA-256 over the source files that a run's outcome depends on: with other code it is another run."""
    digest = hashlib.sha256()
    files = [path for room in _ROOMS for path in (_PACKAGE / room).rglob("*") if path.is_file()]
    files += [_PACKAGE / module for module in _MODULES]
    for path in sorted(files):
        if path.suffix != ".pyc":
            digest.update(path.relative_to(_PACKAGE).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


@dataclass(frozen=True)
class Run:
    """One run, in this process or another."""

    world: str
    """The experiment's name for its scenario: `paper`, `reference`, `five-drones`."""
    variant: str
    """Further distinction within its experiment, or empty."""
    scenario: Scenario
    """All keys, including the seed and the policy."""
    measures: tuple[str, ...] = ()
    """Names in `MEASURES`."""
    protocol: str = ""
    """What every node runs, a name in `PROTOCOLS`; empty: what the policy asks for."""
    code: str = ""
    """`code_hash` of the process that requested the run; empty: do not compare."""

    @property
    def policy(self) -> str:
        """The policy's name."""
        return self.scenario.policy.name

    @property
    def key(self) -> str:
        """64 hexadecimal digits for everything that determines the outcome."""
        what = [
            FORMAT, self.world, self.variant, to_plain(self.scenario), list(self.measures), self.protocol, self.code,
        ]  # fmt: skip
        return hashlib.sha256(msgspec.json.encode(what, order="sorted")).hexdigest()

    @property
    def name(self) -> str:
        """For people: what it is in its experiment."""
        parts = (self.world, self.scenario.topology, self.policy, self.variant, str(self.scenario.seed))
        return "_".join(part for part in parts if part)

    @property
    def file_name(self) -> str:
        """Where its outcome is kept: readable, and different for different keys."""
        return f"{self.name}_{self.key[:16]}.json"


class Result(msgspec.Struct):
    """The results of a run: one small JSON file."""

    key: str
    world: str
    topology: str
    policy: str
    variant: str
    seed: int
    steps: int
    summary: dict[str, Any]
    """As `swarm --json` prints it, without wall times."""
    series: Series
    delays: dict[int, int]
    """Steps from creation to first arrival -> how many data."""
    distances: dict[int, Distance]
    """By hops from the base at creation."""
    extra: dict[str, dict[str, Any]]
    """By the name of a measure."""


def execute(run: Run) -> Result:
    """Do a run. Raises `RassError` if the code of this process differs from that of the requesting one."""
    if run.code and run.code != code_hash():
        raise RassError("a worker has another version of rass_mav than this process: install the same one")
    world = World(run.scenario, participant=PROTOCOLS[run.protocol].participant if run.protocol else None)
    series, distances = SeriesMeasure(), DistanceMeasure()
    extra = {name: MEASURES[name]() for name in run.measures}
    watching: list[Watcher] = [series, distances, *extra.values()]

    def after(world: World) -> None:
        for measure in watching:
            measure.after(world)

    with at_rest():
        world.run(run.scenario.steps, after=after)
    return Result(
        run.key, run.world, run.scenario.topology, run.policy, run.variant, run.scenario.seed, run.scenario.steps,
        summary=world.statistics.summary(),
        series=series.series,
        delays=dict(sorted(Counter(world.ledger.delays()).items())),
        distances=distances.result(world),
        extra={name: measure.result() for name, measure in extra.items()},
    )  # fmt: skip

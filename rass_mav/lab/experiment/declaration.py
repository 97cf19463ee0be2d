"""What an experiment is: factors, of which every combination of levels is a case; columns; and figures.

An experiment's module declares one; here is all that they have in common: which runs they consist of, and their tables.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

from rass_mav.errors import ConfigError
from rass_mav.lab.experiment.columns import NOTE, PAIRED, RUNS, STEPS, Column, Group
from rass_mav.lab.experiment.figures import policy_style
from rass_mav.lab.experiment.runner import Result, Run
from rass_mav.lab.experiment.statistics import Interval, counted
from rass_mav.lab.experiment.tables import markdown, write_csv, write_runs, write_text
from rass_mav.lab.swarm.scenario import load_scenario
from rass_mav.policy.settings import PolicySettings, kinds

#: The name of its level, by factor.
Case = Mapping[str, str]


@dataclass(frozen=True)
class Level:
    """A value of a factor."""

    title: str
    """For people."""
    keys: Mapping[str, Any] = field(default_factory=dict)
    """Differences from the scenario."""
    scenario: str = ""
    """Instead of the experiment's."""


@dataclass(frozen=True)
class Factor:
    """What cases differ in."""

    name: str
    """Its column in a CSV file."""
    heading: str
    """In a Markdown table."""
    levels: Mapping[str, Level]
    """By their names in options and files."""
    option: str = ""
    """With which a user chooses levels; empty: there is no choice."""
    usual: Collection[str] = ()
    """What is run unless chosen otherwise; empty: all."""
    key: str = ""
    """Of the scenario, that the levels determine without naming it. --set must change neither it nor what they name."""
    show: Callable[[Case], str] | None = None
    """A case's cell in a Markdown table; None: the level's title."""

    def cell(self, case: Case) -> str:
        """In a Markdown table."""
        return self.show(case) if self.show else self.levels[case[self.name]].title


class Extent(NamedTuple):
    """How many runs an experiment does for each of its cases."""

    runs: int
    """Seeds first_seed .. first_seed + runs - 1."""
    steps: int
    assignments: Sequence[str] = ()
    """`key.path=value`: they override all other keys."""
    first_seed: int = 0


class Planned(NamedTuple):
    """A run, and what it is for."""

    case: Case
    run: Run


def _no_keys(case: Case, steps: int) -> dict[str, Any]:
    return {}


def _nothing(groups: Sequence[Group]) -> list[str]:
    return []


@dataclass(frozen=True)
class Experiment:
    """Runs of the mock swarm, and what is made of them."""

    title: str
    """Of the tables."""
    factors: Sequence[Factor]
    """The first changes slowest. Tables begin with them."""
    columns: Sequence[Column]
    """After the factors; a CSV file has `RUNS` and `STEPS` between."""
    scenario: str
    """Its name; {factor} stands for the level."""
    world: str = ""
    """`Run.world`; {factor} stands for the level."""
    variant: str = ""
    """`Run.variant`, likewise."""
    protocol: str = ""
    """`Run.protocol`, likewise."""
    measures: Callable[[Case], tuple[str, ...]] = lambda case: ()
    """Names in `MEASURES`."""
    keys: Callable[[Case, int], Mapping[str, Any]] = _no_keys
    """Differences from the scenario, in addition to the levels'; from the case and the number of steps."""
    runs: Callable[[Case, int], int] = lambda case, runs: runs
    """How many a case has, when that many were requested."""
    includes: Callable[[Case], bool] = lambda case: True
    """Which combinations make sense."""
    if_empty: str = ""
    """Why there may be nothing to run."""
    check: Callable[[Run], None] = lambda run: None
    """Raises `ConfigError` for scenarios that cannot be measured."""
    intro: str = "{runs} of {steps} steps.\n"
    """What the tables show, for people; {runs} stands for their number in words, {steps} for their length."""
    reference: Case = field(default_factory=dict)
    """The case with these levels is the one that the others are compared with; empty: nothing is compared."""
    sections: Sequence[str] = ()
    """Factors: table.md has a table for each combination of their levels."""
    section_title: Callable[[Sequence[Group]], str] = lambda groups: ""
    section_notes: Callable[[Sequence[Group]], list[str]] = _nothing
    """Paragraphs between the title and the table."""
    before: Callable[[Sequence[Group]], list[str]] = _nothing
    """Paragraphs before the first table."""
    after: Callable[[Sequence[Group]], list[str]] = _nothing
    """Paragraphs after the last table."""
    files: Callable[[Sequence[Group], Path], Iterable[Path]] = lambda groups, out: ()
    """Writes figures and further tables to a directory; returns their paths."""
    table: str = "table"
    """The name of the table's files."""

    # -- what is run ---------------------------------------------------------------------------------------------------

    def plan(self, extent: Extent, chosen: Mapping[str, Sequence[str]] | None = None) -> list[Planned]:
        """The runs of each case. `chosen`: levels by factor, where not the usual ones. Raises `ConfigError`."""
        levels = [(chosen or {}).get(f.name) or f.usual or f.levels for f in self.factors]
        chosen_by = {"steps": "--steps", "seed": "--first-seed"}
        for factor, names in zip(self.factors, levels, strict=True):
            keys = itertools.chain((factor.key,), *(factor.levels[name].keys for name in names))
            chosen_by |= dict.fromkeys(filter(None, keys), factor.option)
        planned: list[Planned] = []
        for names in itertools.product(*levels):
            case = dict(zip((factor.name for factor in self.factors), names, strict=True))
            if self.includes(case):
                planned += self._runs(case, extent, chosen_by)
        if not planned:
            raise ConfigError(f"nothing to run: {self.if_empty}")
        return planned

    def _runs(self, case: Case, extent: Extent, chosen_by: Mapping[str, str]) -> list[Planned]:
        """`chosen_by`: keys that the experiment varies, and the option that chooses their values; empty: there is
        none."""
        found = [factor.levels[case[factor.name]] for factor in self.factors]
        name = next((level.scenario for level in found if level.scenario), self.scenario).format(**case)
        keys: dict[str, Any] = {"steps": extent.steps, "seed": extent.first_seed}
        for level in found:
            keys |= level.keys
        own = self.keys(case, extent.steps)
        keys |= own
        scenario = load_scenario(name, keys, extent.assignments)
        if extent.assignments:
            unchanged = load_scenario(name, keys)
            for key, option in {**chosen_by, **dict.fromkeys(own, "")}.items():
                if attrgetter(key)(scenario) != attrgetter(key)(unchanged):
                    raise ConfigError(f"--set: {key} is chosen by {option or 'the experiment'} here")
        run = Run(
            self.world.format(**case), self.variant.format(**case), scenario, self.measures(case),
            self.protocol.format(**case),
        )  # fmt: skip
        self.check(run)
        seeds = range(extent.first_seed, extent.first_seed + self.runs(case, extent.runs))
        return [Planned(case, replace(run, scenario=replace(scenario, seed=seed))) for seed in seeds]

    # -- what is written -----------------------------------------------------------------------------------------------

    def groups(self, planned: Sequence[Planned], results: Sequence[Result]) -> list[Group]:
        """The results of the planned runs, by case, each with those of the reference beside it."""
        found: dict[tuple[str, ...], list[Result]] = {}
        for (case, _), result in zip(planned, results, strict=True):
            found.setdefault(tuple(case.values()), []).append(result)
        names = [factor.name for factor in self.factors]
        cases = [dict(zip(names, levels, strict=True)) for levels in found]
        return [
            Group(case, runs, found.get(tuple({**case, **self.reference}.values()), ()) if self.reference else ())
            for case, runs in zip(cases, found.values(), strict=True)
        ]

    def report(self, groups: Sequence[Group], out: Path) -> list[Path]:
        """Write runs.csv, the tables and the figures; returns their paths."""
        rows = (
            [*group.case.values(), *itertools.chain(*(column.fields(group) for column in (RUNS, STEPS, *self.columns)))]
            for group in groups
        )
        return [
            write_runs(out / "runs.csv", [run for group in groups for run in group.runs]),
            write_csv(out / f"{self.table}.csv", self.csv_columns, rows),
            write_text(out / f"{self.table}.md", self._text(groups)),
            *self.files(groups, out),
        ]

    @property
    def csv_columns(self) -> tuple[str, ...]:
        """Of the table's CSV file."""
        columns = itertools.chain(*(column.names for column in (RUNS, STEPS, *self.columns)))
        return (*(factor.name for factor in self.factors), *columns)

    def _text(self, groups: Sequence[Group]) -> str:
        intro = self.intro.format(runs=counted_runs(groups), steps=groups[0].steps)
        parts = [f"# {self.title}\n", intro, NOTE + (PAIRED if self.reference else "")]
        parts += self.before(groups)
        for section in split(groups, *self.sections).values():
            if self.sections:
                parts.append(f"## {self.section_title(section)}\n")
            parts += self.section_notes(section)
            parts.append(self._table(section))
        return "\n".join([*parts, *self.after(groups)])

    def _table(self, groups: Sequence[Group]) -> str:
        factors = [factor for factor in self.factors if factor.name not in self.sections]
        columns = [column for column in self.columns if column.heading]
        return markdown(
            [*(factor.heading for factor in factors), *(column.heading for column in columns)],
            [[*(f.cell(group.case) for f in factors), *(c.cell(group) for c in columns)] for group in groups],
        )


def split(groups: Iterable[Group], *factors: str) -> dict[tuple[str, ...], list[Group]]:
    """Groups by their levels of these factors, in order of first occurrence."""
    found: dict[tuple[str, ...], list[Group]] = {}
    for group in groups:
        found.setdefault(tuple(group.case[factor] for factor in factors), []).append(group)
    return found


def counted_runs(groups: Sequence[Group], interval: Interval | None = None) -> str:
    """How many runs each group has, in words. `interval`: how a figure shows the confidence interval of several."""
    return counted(max(len(group.runs) for group in groups), interval)


def choose(option: str, given: Sequence[str] | None, known: Collection[str]) -> list[str]:
    """The given names, each once. Raises `ConfigError` if one is not known."""
    names = list(dict.fromkeys(given or ()))
    wrong = [f"{option}: expected some of {', '.join(known)}, got {name!r}" for name in names if name not in known]
    if wrong:
        raise ConfigError(*wrong)
    return names


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
#: Differences from the scenario (docs/evaluation/air.md).
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

"""What each tuned constant of a node is worth: the same small swarms with half of it, and with twice as much.

    python -m tools.sensitivity custody.journal pace.FULL    modules, packages or single constants
    python -m tools.sensitivity                              all of them; about an hour of one core
    python -m tools.sensitivity --into docs/contribute/constants.md    and write them into the page

The constants are the tuned ones of `tools/tables.py --constants`, and those derived from others; `WORLDS` has the
swarms that are run for each module. A run is the program with one number changed where it stands, so whatever is
computed from it changes too. An integer stays one, and at least 1. Of a share above a half the rest is halved and
doubled: 0.999 becomes 0.9995 and 0.998.

A row has the differences from today's program, means over the seeds. Today's program is run several times with each
seed while its nodes draw other random numbers: their standard deviation is the spread, and their mean is what the
others are compared with. **Bold** differences are more than three standard errors. A change with which the nodes send
the same bytes with the first seed is not run with the others. Finished runs are lines of FOLDER/runs.jsonl, and the
same command goes on after them.
"""

from __future__ import annotations

import argparse
import ast
import concurrent.futures
import importlib
import importlib.util
import json
import math
import statistics
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from tools.pages import ROOT, filled, table, write
from tools.tables import KINDS, PACKAGE, Constant, constants

PAGE = "docs/contribute/constants.md"
FACTORS = (0.5, 2.0)
#: How often today's program is run with each seed.
DRAWS = 5
#: A difference of so many standard errors is shown as one.
CERTAIN = 3.0
#: The least spread: one datum of a run.
LEAST = 0.007
#: A run that takes longer, seconds, has failed.
PATIENCE_S = 120.0


class World(NamedTuple):
    """A swarm of a few seconds."""

    about: str
    scenario: str
    keys: tuple[str, ...]
    """As `rass-mav swarm --set` takes them."""


#: Drones that walk at random, so far apart that data wait, and in the way of radiation.
_WALK = (
    "topology=random-walk", "nodes=31", "arena_m=15", "store.capacity_items=25", "radio.preset=wifi-1m",
    "radio.loss=0.05", "failures.die_fraction=0.1",
)  # fmt: skip
WORLDS = {
    "walk": World(
        "30 drones that walk at random over Wi-Fi at 1 Mbit/s, in the way of radiation; a tenth dies, others reboot",
        "demo",
        (*_WALK, "steps=180", "data.until_step=160", "data.interval_steps=10", "failures.reboot_rate=0.001"),
    ),
    "blast": World(
        "35 drones on two islands that part in step 40; in step 110 a blast kills those around the fullest drone",
        "islands",
        (
            "nodes=36", "arena_m=12", "steps=160", "data.until_step=150", "data.interval_steps=12", "radio.loss=0.1",
            "mobility.split_step=40", "failures.blast=110",
        ),
    ),
    "black hole": World(
        "24 drones with keys, and from step 20 on two captured ones that drop what they take, at the base's side",
        "hostile",
        (
            "steps=120", "data.until_step=100", "data.interval_steps=5", "store.capacity_items=20", "keys=true",
            "hostile=[{kind: black-hole, near: 0, begin: 20, captured: true}, "
            "{kind: black-hole, near: 1, begin: 20, captured: true}]",
        ),
    ),
    "pictures": World(
        "13 drones that survey a field, and send pictures of 64 KiB and statuses over Wi-Fi at 1 Mbit/s",
        "field-wifi-1m",
        (
            "nodes=14", "steps=50", "data.until_step=44", "mobility.area_m=[1700, 1000]", "data.status_s=null",
            "radio.loss=0.1", "traffic.load=0.8",
        ),
    ),
    "keys": World(
        "like walk, with keys; some drones lose their stores, and the base is off for a while",
        "demo",
        (
            *_WALK, "steps=120", "data.until_step=108", "keys=true", "failures.wipe_rate=0.001",
            "failures.base_off=[[40, 60]]",
        ),
    ),
}  # fmt: skip
#: The worlds of a constant, by the beginning of its label: the first that fits.
_OF = {
    **dict.fromkeys((f"core.custody.{name}." for name in ("flow", "transfers", "incoming")), ("pictures",)),
    "core.custody.journal.": ("walk", "black hole"),
    "core.custody.": ("walk", "blast"),
    "core.replicas.": ("walk", "blast"),
    "core.risk.": ("walk", "blast"),
    **dict.fromkeys(("core.exchange.", "core.pace."), ("walk", "pictures")),
    "core.": ("walk",),
    "trust.": ("keys", "black hole"),
    "agent.": ("walk", "pictures"),
}
#: Units, by the ends of names.
_UNITS = {
    "_S": "s", "_TURNS": "turns", "_REST": "turns", "PERIOD": "turns", "_STEPS": "steps", "_TRIPS": "round trips",
    "_ROUNDS": "rounds", "_LIFETIMES": "lifetimes", "_HOPS": "hops", "_PERIODS": "periods", "IMIN": "periods",
    "IMAX": "periods", "NEW": "periods", "FIRST_WINDOW": "chunks", "SACK_EVERY": "chunks", "MARGIN_KEPT": "chunks",
    "A_COPY": "chunks", "_SAVED": "chunks", "LATE_WINDOW": "beacons", "LIGHT": "entries", "SHARED": "statements",
    "PRIOR": "data", "_SINCE": "data", "FURTHER": "replicas",
}  # fmt: skip
#: What is shown of a run, and whether as a ratio.
FIGURES = {"kept": False, "delivered": False, "delay": True, "sent": True, "bytes": True}


class Run(NamedTuple):
    """One swarm."""

    label: str
    """The constant; empty: today's program."""
    value: str
    """Today's."""
    factor: float
    """Without a constant: the number of the draw."""
    world: str
    seed: int


class Result(NamedTuple):
    """What became of it."""

    figures: tuple[float, ...] | None
    """None: it failed."""
    air: str
    """Hash of all that was sent."""


def chosen(names: Sequence[str]) -> list[Constant]:
    """The tuned and derived constants that these are parts of the labels of; none: all."""
    found = [one for one in constants() if one.kind in ("tuned", "derived")]
    for name in names:
        if not any(f".{name}." in f".{one.label}." for one in found):
            raise SystemExit(f"{name}: no tuned constant, and no module that has some")
    return [one for one in found if not names or any(f".{name}." in f".{one.label}." for name in names)]


def worlds(constant: Constant) -> tuple[str, ...]:
    """The names of its worlds."""
    return next(names for start, names in _OF.items() if constant.label.startswith(start))


def unit(constant: Constant) -> str:
    """Its unit."""
    ends = [unit for end, unit in _UNITS.items() if constant.name.endswith(end)]
    if ends:
        return ends[-1]
    module = constant.module.replace("/", ".")
    number = getattr(importlib.import_module(f"rass_mav.{module}"), constant.name)
    return "number" if isinstance(number, int) else "share" if number < 1.0 else "times"


# -- one run -----------------------------------------------------------------------------------------------------------


def changed(text: str, name: str, factor: float) -> str:
    """The text of a module with another value of a constant."""
    for node in ast.parse(text).body:
        if isinstance(node, ast.Assign) and any(
            isinstance(one, ast.Name) and one.id == name for target in node.targets for one in ast.walk(target)
        ):
            lines = text.splitlines()
            lines.insert(
                node.end_lineno or 0, f"import tools.sensitivity; {name} = tools.sensitivity.times({name}, {factor})"
            )
            return "\n".join(lines) + "\n"
    raise SystemExit(f"there is no {name}")


def times(value: float, factor: float) -> float:
    """Half or twice a value."""
    if isinstance(value, int):
        return max(1, round(value * factor))
    return 1.0 - (1.0 - value) * factor if 0.5 < value < 1.0 else value * factor


def _put(module: str, text: str) -> None:
    """Import a module with this text instead of its own."""
    spec = importlib.util.find_spec(module)
    assert spec is not None
    assert spec.origin is not None
    found = sys.modules[module] = importlib.util.module_from_spec(spec)
    exec(compile(text, spec.origin, "exec"), found.__dict__)


def swarm(run: Run, more: Sequence[str] = ()) -> int:
    """Do a run in this process, and print its summary. `more`: other keys of its world."""
    if run.label:
        module, _, name = run.label.rpartition(".")
        file = PACKAGE / f"{module.replace('.', '/')}.py"
        _put(f"rass_mav.{module}", changed(file.read_text(encoding="utf-8"), name, run.factor))
    elif run.factor:
        text = (PACKAGE / "lab/swarm/virtual.py").read_text(encoding="utf-8")
        assert "{seed}:node:" in text
        _put("rass_mav.lab.swarm.virtual", text.replace("{seed}:node:", f"{{seed}}:node {run.factor:g}:"))
    from rass_mav.cli import main

    world = WORLDS[run.world]
    keys = [word for key in (*world.keys, *more) for word in ("--set", key)]
    return main(["swarm", world.scenario, "--json", "--seed", str(run.seed), *keys])


def _do(run: Run, more: Sequence[str]) -> Result:
    code = f"from tools.sensitivity import Run, swarm; raise SystemExit(swarm({run!r}, {more!r}))"
    try:
        done = subprocess.run(
            [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True, timeout=PATIENCE_S
        )
    except subprocess.SubprocessError as error:
        print(run, *(getattr(error, "stderr", None) or str(error)).splitlines()[-1:], file=sys.stderr)
        return Result(None, "")
    summary: dict[str, Any] = json.loads(done.stdout)
    created, hostile = summary["created"], summary.get("hostile", {})
    return Result(
        (
            1 - (sum(summary["lost"].values()) + hostile.get("false_delivered", 0)) / created,
            summary["delivered"] / created,
            math.log(1.0 + (summary["delay_steps"]["mean"] or 0.0)),
            math.log(summary["transmissions_per_datum"]),
            math.log(summary["bytes_sent"] / created),
        ),
        summary["air_sha256"],
    )


# -- all of them -------------------------------------------------------------------------------------------------------


def runs(wanted: Sequence[Constant], seeds: Sequence[int]) -> Iterator[Run]:
    """What there is to do."""
    for world in dict.fromkeys(name for one in wanted for name in worlds(one)):
        for seed in seeds:
            yield from (Run("", "", draw, world, seed) for draw in range(DRAWS))
    for seed in seeds:
        for one in wanted:
            yield from (Run(one.label, one.value, factor, world, seed) for world in worlds(one) for factor in FACTORS)


def read(path: Path) -> dict[Run, Result]:
    """Finished runs."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    return {Run(*run): Result(figures and tuple(figures), air) for run, (figures, air) in map(json.loads, lines)}


def do(wanted: Sequence[Run], path: Path, jobs: int, more: Sequence[str] = ()) -> dict[Run, Result]:
    """The results of these runs; those that the file does not have are done."""
    found = read(path)
    path.parent.mkdir(exist_ok=True, parents=True)
    lock = threading.Lock()

    def one(run: Run) -> None:
        first = run._replace(seed=wanted[0].seed)
        if run in found or (run.label and first in found and not _differs(found, first)):
            return
        result = _do(run, more)
        with lock:
            found[run] = result
            file.write(json.dumps((run, result)) + "\n")
            file.flush()

    with concurrent.futures.ThreadPoolExecutor(jobs) as pool, path.open("a", encoding="utf-8") as file:
        list(pool.map(one, wanted))
    return {run: found[run] for run in wanted if run in found}


def _differs(found: dict[Run, Result], run: Run) -> bool:
    """Whether the nodes have sent something else than those of today's program."""
    return found[run].air != found[Run("", "", 0, run.world, run.seed)].air


# -- the table ---------------------------------------------------------------------------------------------------------


class Today(NamedTuple):
    """What today's program does in one world."""

    means: dict[int, list[float]]
    """Figures by seed."""
    spread: list[float]
    """Standard deviation of a run, of each figure, within a seed."""
    airs: dict[int, str]
    """What the first draw of each seed sent."""


def today(results: dict[Run, Result], world: str) -> Today:
    """Of the runs of today's program."""
    by_seed: dict[int, list[tuple[float, ...]]] = {}
    airs = {}
    for run, result in results.items():
        if not run.label and run.world == world and result.figures:
            by_seed.setdefault(run.seed, []).append(result.figures)
            if not run.factor:
                airs[run.seed] = result.air
    columns = {seed: list(zip(*found, strict=True)) for seed, found in by_seed.items()}
    return Today(
        {seed: [statistics.fmean(column) for column in found] for seed, found in columns.items()},
        [
            max(LEAST, math.sqrt(statistics.fmean(statistics.variance(found[i]) for found in columns.values())))
            for i in range(len(FIGURES))
        ],
        airs,
    )


def _difference(ratio: bool, value: float) -> str:
    return f"x{math.exp(value):.3f}" if ratio else f"{value:+.4f}"


def cell(now: Today, found: dict[int, Result]) -> str:
    """What a change does, by the results of its seeds."""
    if any(result.figures is None for result in found.values()):
        return "fails"
    if all(result.air == now.airs[seed] for seed, result in found.items()):
        return "the same bytes"
    error = math.sqrt((1 + 1 / DRAWS) / len(found))
    texts = []
    for i, ratio in enumerate(FIGURES.values()):
        mean = statistics.fmean(
            result.figures[i] - now.means[seed][i] for seed, result in found.items() if result.figures
        )
        text = _difference(ratio, mean)
        texts.append(f"**{text}**" if abs(mean) > CERTAIN * error * now.spread[i] else text)
    return ", ".join(texts)


def class_lines() -> list[str]:
    """How many constants there are of each class."""
    about = (
        "waits, gains and thresholds that were chosen", "follow from another constant",
        "protect memory, airtime, the disk or the processor",
        "follow from the wire, an RFC, the world or how numbers are rounded",
    )  # fmt: skip
    counts = Counter(one.kind for one in constants())
    rows = ((kind, str(counts[kind]), text) for kind, text in zip(KINDS, about, strict=True))
    return table(("class", "constants", "they"), rows)


def world_lines(results: dict[Run, Result]) -> list[str]:
    """The worlds, and what today's program does in them."""
    rows = []
    for world in dict.fromkeys(run.world for run in results):
        now = today(results, world)
        for i, (name, ratio) in enumerate(FIGURES.items()):
            values = [math.exp(means[i]) if ratio else means[i] for means in now.means.values()]
            rows.append((
                world if not i else "", name, f"{min(values):.4g} to {max(values):.4g}",
                f"x{math.exp(now.spread[i]):.3f}" if ratio else f"{now.spread[i]:.4f}",
            ))  # fmt: skip
    about = [f"- **{name}**: {WORLDS[name].about}" for name in dict.fromkeys(run.world for run in results)]
    return [*about, "", *table(("world", "figure", "today, by seed", "spread"), rows)]


def rows(wanted: Sequence[Constant], results: dict[Run, Result], seeds: Sequence[int]) -> Iterator[tuple[str, ...]]:
    """A row for each constant and world."""
    known = {world: today(results, world) for world in dict.fromkeys(run.world for run in results)}
    for one in wanted:
        for world in worlds(one):
            cells = (
                cell(known[world], {run.seed: results[run] for run in those if run in results})
                for factor in FACTORS
                if (those := [Run(one.label, one.value, factor, world, seed) for seed in seeds])
            )
            yield f"`{one.name}`", one.value, unit(one), world, *cells


HEAD = ("constant", "value", "unit", "world", "half: " + ", ".join(FIGURES), "twice")


def constant_lines(wanted: Sequence[Constant], results: dict[Run, Result], seeds: Sequence[int]) -> Iterator[str]:
    """The tables, by mechanism."""
    for module in dict.fromkeys(one.module for one in wanted):
        text = ast.get_docstring(ast.parse((PACKAGE / f"{module}.py").read_text(encoding="utf-8"))) or ""
        here = [one for one in wanted if one.module == module]
        yield from (f"### {module.replace('/', '.')}", "", " ".join(text.split("\n\n")[0].split()), "")
        yield from (*table(HEAD, rows(here, results, seeds)), "")


def main(arguments: Sequence[str] | None = None) -> None:
    """Its command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help="custody.journal, trust, pace.FULL (default: all)")
    parser.add_argument("--folder", type=Path, default=ROOT / "build/sensitivity", help="(default: build/sensitivity)")
    parser.add_argument("--seeds", default="1-3", metavar="FIRST-LAST", help="(default: 1-3)")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--set", action="append", default=[], metavar="KEY.PATH=VALUE", help="for another FOLDER")
    parser.add_argument("--into", metavar="PAGE", help="write the tables into this page")
    args = parser.parse_args(arguments)
    if args.into and args.names:
        parser.error("a page has all constants")
    first, _, last = args.seeds.partition("-")
    seeds = range(int(first), int(last or first) + 1)
    wanted = chosen(args.names)
    results = do(list(runs(wanted, seeds)), args.folder / "runs.jsonl", args.jobs, args.set)
    parts = {
        "classes": class_lines(), "worlds": world_lines(results),
        "constants": list(constant_lines(wanted, results, seeds)),
    }  # fmt: skip
    if args.into:
        write({args.into: filled(args.into, parts)})
    else:
        print("\n".join([*parts["worlds"], "", *parts["constants"]]))


if __name__ == "__main__":
    main()

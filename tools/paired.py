"""Two programs in the same mock swarms, compared run by run: what a change of the mechanisms does.

    python -m tools.paired run CHECKOUT RUNS.jsonl --cells random-walk grid/wifi-6m --seeds 6000-6003
    python -m tools.paired compare BEFORE.jsonl AFTER.jsonl

A cell is PLACE/AIR, or hostile/ATTACKER-PLACE-KEYS (`hostile/sinkhole-base-captured`). `all` stands for the cells of
docs/evaluation/comparison.md, `attackers` for every attacker. Each finished run is a line of the file, and the same
command goes on after it. Each checkout has its own environment (`make install`), so both programs run with their own
code.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import json
import math
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from rass_mav.lab.experiment.ablation import ALL_AIRS, PLACES
from rass_mav.lab.experiment.hostile import ATTACK, VARIANTS
from rass_mav.lab.experiment.hostile import PLACES as BESIDE
from rass_mav.lab.experiment.statistics import Estimate, estimate
from rass_mav.lab.hostile.kinds import KINDS

#: Places and airs of the tables in docs/evaluation/comparison.md.
PUBLISHED = (
    "random-walk", "random-walk/wifi-6m", "random-walk/wifi-1m", "grid", "grid/wifi-6m", "grid/wifi-1m", "grid/sik-64k",
    "dying", "dying/wifi-6m", "dying/wifi-1m", "islands", "blast", "field/wifi-6m", "field/wifi-1m",
)  # fmt: skip
ATTACKERS = tuple(
    f"hostile/{kind}-{place}-{keys}" for kind in ("nobody", *KINDS) for place in BESIDE for keys in VARIANTS
)
#: Columns of the comparison: what is compared, and whether as a ratio.
COLUMNS = {"kept": False, "delivered": False, "sent": True, "bytes": True, "p95": False}
Runs = dict[tuple[str, int], dict[str, Any]]


def _keys(cell: str) -> tuple[str, dict[str, Any]]:
    """Scenario and keys of a cell."""
    place, _, rest = cell.partition("/")
    if place == "hostile":
        kind, beside, keys = rest.rsplit("-", 2)
        signed, captured = VARIANTS[keys]
        attacker = {"kind": kind, "near": BESIDE[beside], "begin": ATTACK, "captured": captured}
        return "hostile", {"keys": signed, "hostile": [] if kind == "nobody" else [attacker]}
    level = PLACES[place]
    scenario = level.scenario or "demo"
    if place == "field":
        return f"field-{rest}", {}
    return scenario, {**level.keys, **ALL_AIRS[rest or "none"]}


def _run(program: Path, cell: str, seed: int, steps: int, more: Sequence[str]) -> dict[str, Any]:
    scenario, keys = _keys(cell)
    keys = {**keys, "steps": steps, "data.until_step": steps * 9 // 10}
    command = [str(program), "swarm", scenario, "--json", "--seed", str(seed)]
    for assignment in (*(f"{key}={json.dumps(value)}" for key, value in keys.items()), *more):
        command += ["--set", assignment]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{cell}, seed {seed}: {done.stderr.strip()}")
    summary: dict[str, Any] = json.loads(done.stdout)
    return summary


def read(path: Path) -> Runs:
    """Finished runs by cell and seed."""
    lines = path.read_text().splitlines() if path.exists() else []
    return {(run["cell"], run["seed"]): run["summary"] for run in map(json.loads, lines)}


def run(args: argparse.Namespace) -> None:
    """Do what is not done yet."""
    cells = [name for cell in args.cells for name in {"all": PUBLISHED, "attackers": ATTACKERS}.get(cell, (cell,))]
    first, _, last = args.seeds.partition("-")
    program = (args.checkout / ".venv/bin/rass-mav").absolute()
    done = read(args.file)
    waiting = [
        (cell, seed) for cell in cells for seed in range(int(first), int(last or first) + 1) if (cell, seed) not in done
    ]
    with concurrent.futures.ThreadPoolExecutor(args.jobs) as pool, args.file.open("a") as file:
        futures = {pool.submit(_run, program, *which, args.steps, args.set): which for which in waiting}
        for future in concurrent.futures.as_completed(futures):
            cell, seed = futures[future]
            file.write(json.dumps({"cell": cell, "seed": seed, "summary": future.result()}) + "\n")
            file.flush()


def _values(summary: Mapping[str, Any]) -> dict[str, float]:
    created, hostile = summary["created"], summary.get("hostile", {})
    return {
        "kept": 1 - (sum(summary["lost"].values()) + hostile.get("false_delivered", 0)) / created,
        "delivered": summary["delivered"] / created,
        "sent": math.log(summary["transmissions_per_datum"]),
        "bytes": math.log(summary["bytes_sent"] / created),
        "p95": float(summary["delay_steps"]["p95"] or 0),
    }


def _cell(name: str, found: Estimate | None, mean: float) -> str:
    if found is None or found.interval is None:
        return f"{mean:.4g}"
    half = (found.interval[1] - found.interval[0]) / 2
    if COLUMNS[name]:
        return f"{mean:.3g} x{math.exp(found.mean):.3f} ± {half:.3f}"
    digits = 1 if name == "p95" else 4
    return f"{mean:.{digits}f} {found.mean:+.{digits}f} ± {half:.{digits}f}"


def table(before: Runs, after: Runs) -> Iterator[str]:
    """Lines of a Markdown table: the mean after the change, and the mean difference with its 95 % interval."""
    yield "| cell | runs | " + " | ".join(COLUMNS) + " |"
    yield "|---|---|" + "---|" * len(COLUMNS)
    both = [key for key in after if key in before]
    for cell in dict.fromkeys(cell for cell, _ in both):
        pairs = [(_values(before[key]), _values(after[key])) for key in both if key[0] == cell]
        row = []
        for name in COLUMNS:
            new = [second[name] for _, second in pairs]
            mean = sum(map(math.exp, new) if COLUMNS[name] else new) / len(new)
            row.append(_cell(name, estimate([second[name] - first[name] for first, second in pairs]), mean))
        yield f"| {cell} | {len(pairs)} | " + " | ".join(row) + " |"


def main(argv: Sequence[str] | None = None) -> None:
    """Its command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    running = commands.add_parser("run", help="run what the file does not hold yet")
    running.add_argument("checkout", type=Path, help="folder of the program, with its .venv")
    running.add_argument("file", type=Path)
    running.add_argument("--cells", nargs="+", default=["all"])
    running.add_argument("--seeds", default="2000-2003", help="FIRST-LAST")
    running.add_argument("--steps", type=int, default=250)
    running.add_argument("--set", action="append", default=[], metavar="KEY.PATH=VALUE")
    running.add_argument("--jobs", type=int, default=1)
    running.set_defaults(do=run)
    comparing = commands.add_parser("compare", help="print the table of two files")
    comparing.add_argument("before", type=Path)
    comparing.add_argument("after", type=Path)
    comparing.set_defaults(do=lambda args: print(*table(read(args.before), read(args.after)), sep="\n"))
    args = parser.parse_args(argv)
    args.do(args)


if __name__ == "__main__":
    main()

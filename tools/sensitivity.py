"""What each tuned constant of a node is worth: the same swarms with half of it, and with twice as much.

    python tools/sensitivity.py run FOLDER --jobs 2        runs what FOLDER does not hold yet
    python tools/sensitivity.py show FOLDER                a line for each constant, and the range of each world

A constant is one of `tools/tables.py --constants`; the worlds of its module are in `WORLDS`. A run is a copy of the
package in which one number is changed, so what is derived from it changes too.
"""

from __future__ import annotations

import argparse
import ast
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tools import paired
from tools.tables import PACKAGE, Constant, constants

#: Cells of `tools/paired.py`, with steps and seeds, by module: the first prefix that fits.
World = tuple[str, int, str]
WALK: World = ("random-walk/wifi-1m", 200, "6000-6001")
PICTURES: World = ("field/wifi-1m", 100, "6000-6001")
BLAST: World = ("blast", 320, "6000-6001")
BLACK_HOLE: World = ("hostile/black-hole-base-captured", 200, "6000-6001")
WORLDS: dict[str, tuple[World, ...]] = {
    **dict.fromkeys((f"core/custody/{name}" for name in ("flow", "transfers", "sending", "listening")), (PICTURES,)),
    "core/custody/journal": (WALK, BLACK_HOLE),
    "core/custody/custody_store": (BLAST,),
    "core/replicas/distant": (BLAST,),
    "core/": (WALK,),
}
#: Units, sizes of fields and frames, and guards against rounding errors: there is nothing to choose.
FACTS = {
    "EMPTY", "_METRES_PER_DEGREE", "UNIT_DEGREES", "_UNIT_M", "_PLACE_BITS", "_SPEED_BITS", "UNIT_M_S", "_PLACE",
    "_SPEED", "_FASTEST", "_ROUNDING_S", "RECEIPT_BYTES", "NOTES_IN_FRAME", "PROVEN_NOTES_IN_FRAME",
    "_MOST_PASSED_ON", "SERIALS_CLAIMED", "ANNOUNCEMENTS_CLAIMED", "MOST_JUMP", "_AGES_DIFFER_S", "SEQUENCE_MARK_SINCE",
}  # fmt: skip
FACTORS = (0.5, 2.0)


def tuned() -> Iterator[tuple[Constant, tuple[World, ...]]]:
    """The constants that can be tuned, and their worlds."""
    for constant in constants():
        worlds = next((worlds for prefix, worlds in WORLDS.items() if constant.module.startswith(prefix)), ())
        if worlds and not constant.bound and constant.name not in FACTS:
            yield constant, worlds


def changed(text: str, constant: Constant, factor: float) -> str:
    """The text of its module with another value. An integer stays one, and at least 1."""
    for node in ast.parse(text).body:
        match node:
            case ast.Assign(targets=[ast.Name(id=constant.name)], value=value):
                found = value
            case ast.Assign(targets=[ast.Tuple(elts=names)], value=ast.Tuple(elts=values)):
                named = dict(zip(map(ast.unparse, names), values, strict=True))
                if constant.name not in named:
                    continue
                found = named[constant.name]
            case _:
                continue
        segment = ast.get_source_segment(text, found)
        assert segment is not None
        lines = text.splitlines(keepends=True)
        line = lines[found.lineno - 1]
        other = f"_times({segment}, {factor})"
        lines[found.lineno - 1] = line[: found.col_offset] + other + line[found.end_col_offset :]
        rounded = "max(1, round(value * factor)) if isinstance(value, int) else value * factor"
        lines.insert(node.lineno - 1, f"def _times(value, factor): return {rounded}\n")
        return "".join(lines)
    raise SystemExit(f"{constant.module} has no {constant.name}")


def _run(checkout: Path, file: Path, worlds: tuple[World, ...], jobs: int) -> None:
    for cell, steps, seeds in worlds:
        options = ["run", str(checkout), str(file), "--cells", cell, "--seeds", seeds, "--steps", str(steps)]
        paired.main([*options, "--jobs", str(jobs)])


def run(folder: Path, jobs: int) -> None:
    """Do what is not done yet."""
    folder.mkdir(exist_ok=True, parents=True)
    found = list(tuned())
    every = dict.fromkeys(world for _, worlds in found for world in worlds)
    with tempfile.TemporaryDirectory() as place:
        checkout = Path(place)
        shutil.copytree(PACKAGE, checkout / "rass_mav", ignore=shutil.ignore_patterns("__pycache__"))
        program = checkout / ".venv/bin/rass-mav"
        program.parent.mkdir(parents=True)
        program.write_text(f'#!/bin/sh\nPYTHONPATH={checkout} exec {sys.executable} -P -m rass_mav "$@"\n')
        program.chmod(0o755)
        _run(checkout, folder / "nothing.jsonl", tuple(every), jobs)
        for constant, worlds in found:
            module = checkout / "rass_mav" / f"{constant.module}.py"
            text = module.read_text(encoding="utf-8")
            for factor in FACTORS:
                module.write_text(changed(text, constant, factor), encoding="utf-8")
                _run(checkout, folder / f"{_label(constant)}-{factor:g}.jsonl", worlds, jobs)
            module.write_text(text, encoding="utf-8")


def _label(constant: Constant) -> str:
    return f"{constant.module.replace('/', '.')}.{constant.name}"


def _figures(summary: dict[str, Any]) -> tuple[float, float, float, float]:
    created = summary["created"]
    kept = 1 - sum(summary["lost"].values()) / created
    return kept, summary["delivered"] / created, summary["transmissions_per_datum"], summary["bytes_sent"]


def show(folder: Path) -> Iterator[str]:
    """A Markdown table: what changes with half and with twice the value, means of the runs."""
    before = paired.read(folder / "nothing.jsonl")
    yield "| constant | value | world | half: kept, delivered, sent, bytes | twice |"
    yield "|---|---|---|---|---|"
    for constant, worlds in tuned():
        for cell, *_ in worlds:
            cells = []
            for factor in FACTORS:
                after = paired.read(folder / f"{_label(constant)}-{factor:g}.jsonl")
                pairs = [(_figures(before[key]), _figures(run)) for key, run in after.items() if key[0] == cell]
                if not pairs:
                    cells.append("")
                    continue
                means = [
                    [sum(figures[i] for figures in side) / len(pairs) for i in range(4)]
                    for side in zip(*pairs, strict=True)
                ]
                (kept, delivered, sent, size), (kept_2, delivered_2, sent_2, size_2) = means
                differences = f"{kept_2 - kept:+.4f}, {delivered_2 - delivered:+.4f}"
                cells.append(f"{differences}, x{sent_2 / sent:.3f}, x{size_2 / size:.3f}")
            module = constant.module.removeprefix("core/")
            yield f"| {module} `{constant.name}` | {constant.value} | {cell} | {' | '.join(cells)} |"


def main() -> None:
    """Its command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("do", choices=("run", "show"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--jobs", type=int, default=1)
    args = parser.parse_args()
    if args.do == "run":
        run(args.folder, args.jobs)
    else:
        print(*show(args.folder), sep="\n")


if __name__ == "__main__":
    main()

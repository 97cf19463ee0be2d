"""The tables of docs/evaluation/performance.md: least, median and most of several repetitions.

    python -m benchmarks                                          all of them; about a quarter of an hour
    python -m benchmarks node handover                            these alone
    python -m benchmarks --into docs/evaluation/performance.md    and put them where the page has its tables
    python -m benchmarks --json                                   one JSON object, with each repetition

Nothing else should run on the computer meanwhile.
"""

from __future__ import annotations

import argparse
import datetime
import importlib.metadata
import json
import os
import platform
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks import attestation, base, frames, handover, held, node, page, sources, store, swarm, transfer

#: What the page has around a table.
MARKS = "<!-- measured: {} -->\n", "<!-- end of measured -->\n"


class Part(NamedTuple):
    """A table or two."""

    measure: Callable[[], Any]
    show: Callable[[Any], str]


PARTS = {
    "node": Part(lambda: node.measure(5, 2.0), node.show),
    "held": Part(lambda: held.measure(held.DATA), held.show),
    "handover": Part(lambda: handover.measure(5, 2000), handover.show),
    "store": Part(store.measure, store.show),
    "keys": Part(attestation.measure, attestation.show),
    "frames": Part(lambda: frames.measure_both(7), frames.show),
    "base": Part(lambda: base.measure(base.DATA), base.show),
    "sources": Part(sources.measure, sources.show),
    "transfer": Part(lambda: transfer.measure_ours(("57600/5", "1000000/5"), 3), transfer.table_of),
    "swarm": Part(lambda: swarm.measure(5, 5000, 50), swarm.show),
    "page": Part(lambda: page.measure(100, 100_000, 60), page.show),
}


def machine(load: float) -> str:
    """What was measured, and where. `load`: of the last minute before."""
    cpu = re.search(r"^model name\s*: (.*)$", Path("/proc/cpuinfo").read_text(encoding="utf-8"), re.M)
    packages = ", ".join(
        f"{name} {importlib.metadata.version(name)}"
        for name in ("rass-mav", "pymavlink", "fastcrc", "numpy")
        if any(importlib.metadata.distributions(name=name))
    )
    return (
        f"{datetime.date.today():%-d %B %Y}, {os.cpu_count()} cores of "
        f"{cpu[1] if cpu else platform.machine()}, {platform.system()} {platform.release()}, "
        f"{platform.python_implementation()} {platform.python_version()}, {packages}; load before: {load:.2f}.\n"
    )


def put(text: str, name: str, table: str) -> str:
    """A page with another table in the place of this name. Raises `ValueError` if the page has no such place."""
    begin, end = (mark.format(name) for mark in MARKS)
    if begin not in text:
        raise ValueError(f"the page has no {begin.strip()}")
    before, _, rest = text.partition(begin)
    return before + begin + table + end + rest.partition(end)[2]


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)} (default: all)")
    parser.add_argument("--into", type=Path, metavar="PAGE", help="put the tables into this page, too")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args(arguments)
    if unknown := set(options.parts) - set(PARTS):
        parser.error(f"no such part: {', '.join(sorted(unknown))}")
    # Otherwise each process compiles the dialect of pymavlink again, which takes time and 60 MiB.
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    results: dict[str, Any] = {"machine": machine(os.getloadavg()[0])}
    for name in options.parts or PARTS:
        if name == "page" and not page.CHROMIUM:
            print("page: without Chromium there is nothing to measure", file=sys.stderr)
            continue
        print(f"{name} ...", file=sys.stderr)
        results[name] = PARTS[name].measure()
    if options.json:
        print(json.dumps(results))
    for name, measured in results.items():
        table = PARTS[name].show(measured) if name in PARTS else measured
        if not options.json:
            print(f"{name}\n\n{table}")
        if options.into:
            text = options.into.read_text(encoding="utf-8")
            options.into.write_text(put(text, name, table), encoding="utf-8")


if __name__ == "__main__":
    main()

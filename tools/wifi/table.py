"""Rows of the page's tables: table.py [--ages] RESULT.json ... --ages: delays by the ages on the way."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any


def two(values: Iterable[float | None]) -> str:
    """The 50 % and 95 % points of those that are known: datagrams have no ages."""
    ordered = sorted(v for v in values if v is not None)
    points = [ordered[int(len(ordered) * p)] for p in (0.5, 0.95)] if ordered else []
    return ", ".join(f"{v:.3f}" if v < 0.1 else f"{v:.2f}" for v in points) or "none came"


def row(r: dict[str, Any], ages: bool) -> str:
    """The row of one cell."""
    cell, hops = r["cell"], {int(i): h for i, h in r["hops"].items()}
    late = 6 if ages else 3
    pictures = [x for x in r["data"] if (x[5] or 0) > 20_000]
    others = [x for x in r["data"] if x not in pictures]
    came = [x for x in others if x[3] is not None]
    kb = (r["air"]["bc_bytes"] + r["air"]["uni_bytes"]) / 1000
    mac = "batman-adv, UDP" if cell["mac"] == "batman" else cell["mac"]
    first = [cell["name"], f"{100 * cell['loss']:.0f} %", mac]
    last = [f"{kb:.0f} in {r['s']:.0f} s", f"{r['busy']:.2f} (nodes {r['nodes_busy']:.2f})"]
    if pictures:
        there = [x for x in pictures if x[3] is not None]
        soon = sum(x[2] + x[3] <= r["window"] for x in there)
        first += [f"{soon}, {len(there)} of {len(pictures)}", two(x[late] for x in there)]
        last[0] = f"{kb / len(pictures):.1f}"
    if others or not pictures:
        first += [f"{len(came)} of {len(others)}", two(x[late] for x in came)]
    if cell["place"] != "fly" and not pictures:
        first += [two(x[late] for x in came if hops[x[0]] == h) if h in hops.values() else "" for h in (4, 9)]
    if cell["place"] == "fly":
        last.append(f"without a way {sum(r['without_way']):.1f} s")
    return "| " + " | ".join(first + last) + " |"


def main() -> None:
    """Print a row for each file."""
    ages = "--ages" in sys.argv
    for path in sys.argv[1 + ages :]:
        print(row(json.loads(Path(path).read_text()), ages))


if __name__ == "__main__":
    main()

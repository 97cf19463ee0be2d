"""Runs cells one after another, some in one guest: cells.py RESULTS [NAME ...]. What is there already is left out.

RESULTS gets NAME.json of each. Needs $WORK and $PROJECT as vm.sh does, and `vm.sh build` before. --list: the names.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
GROUP, LIMIT_S = 6, 1200  # cells in a guest, seconds for one
MACS = ("broadcast", "unicast", "batman")
PLACES: dict[str, dict[str, Any]] = {
    "line5": {"place": "line", "nodes": 5, "every": 1, "window": 60},
    "line10": {"place": "line", "nodes": 10, "every": 2, "window": 60},
    "grid20": {"place": "grid", "nodes": 20, "width": 5, "every": 4, "window": 48},
    "fly10": {"place": "fly", "nodes": 10, "every": 1, "window": 40, "side": 500, "walk_seed": 5},
    "fly21": {"place": "fly", "nodes": 21, "every": 4, "window": 48, "side": 700, "walk_seed": 13},
    "pictures5": {"place": "line", "nodes": 5, "every": 0, "window": 42, "pictures": [1, 2, 3, 4], "picture_s": 6},
    "pictures20": {"place": "grid", "nodes": 20, "width": 5, "every": 0, "window": 48, "pictures": [4, 7, 11, 15, 19],
                   "picture_s": 12},
}  # fmt: skip


def cell(name: str) -> dict[str, Any]:
    """Read PLACE-LOSS%-MAC[-mcastRATE][-KEY=VALUE][-SEED], such as line5-10-unicast-2."""
    place, loss, mac, *more = name.split("-")
    mcast = next((int(x[5:]) for x in more if x.startswith("mcast")), 6)
    values = [x for x in more if "=" in x]
    seed = next((int(x) for x in more if x.isdigit()), 1)
    return {
        "name": name, "loss": int(loss) / 100, "mac": mac, "mcast": mcast, "seed": seed, "bytes": 60, "set": values,
        "warm": 50 if mac == "batman" else 25, "drain": 10, "range": 250, "speed": 10, "from": 60, **PLACES[place],
    }  # fmt: skip


def names() -> Iterator[str]:
    """All cells, in the order in which they are run."""
    for loss in (0, 20):
        yield from (f"grid20-{loss}-{mac}" for mac in MACS)
    yield from ("line10-0-broadcast", "line10-0-unicast", "line10-20-broadcast", "line5-20-broadcast")
    for place, loss in (("fly10", 0), ("fly10", 20), ("fly21", 10), ("pictures20", 10)):
        yield from (f"{place}-{loss}-{mac}" for mac in MACS)
    for place in ("line5", "line10"):
        yield from (f"{place}-10-{mac}-mcast1" for mac in MACS[:2])
    for place in ("line5", "line10", "grid20"):
        yield from (f"{place}-10-{mac}-2" for mac in MACS)
    yield from (f"{place}-20-broadcast-risk.worst=0" for place in ("line5", "line10", "grid20"))


def main() -> None:
    """Run what is left, a group in each guest."""
    if sys.argv[1:] == ["--list"]:
        print(*names(), sep="\n")
        return
    results = Path(sys.argv[1])
    results.mkdir(parents=True, exist_ok=True)
    came = Path(os.environ["WORK"]) / "share" / "results"
    left = [name for name in sys.argv[2:] or names() if not (results / f"{name}.json").exists()]
    while left:
        guest, began = start(left[:GROUP], results), time.time()
        group = left[:GROUP]
        while group:
            ended = guest.poll() is not None or time.time() - began > LIMIT_S
            if (came / f"{group[0]}.json").exists():
                shutil.move(came / f"{group[0]}.json", results)
                print(time.strftime("%H:%M:%S"), group[0], f"{time.time() - began:.0f} s", flush=True)
                left.remove(group.pop(0))
                began = time.time()
            elif ended:
                print(time.strftime("%H:%M:%S"), group[0], "failed:", (results / "log").read_text(), flush=True)
                left.remove(group.pop(0))
                break
            else:
                time.sleep(0.5)
        if guest.poll() is None and group:
            os.killpg(guest.pid, signal.SIGTERM)
        guest.wait()


def start(group: Sequence[str], results: Path) -> subprocess.Popen[bytes]:
    """Start a guest for these cells."""
    (results / "cells").write_text(json.dumps([cell(name) for name in group]))
    with open(results / "log", "w") as log:
        return subprocess.Popen(
            [HERE / "vm.sh", "run", results / "cells"], stdout=log, stderr=subprocess.STDOUT, start_new_session=True
        )


if __name__ == "__main__":
    main()

"""What a base finds of the sources of mock swarms: the estimate, and the hot spots, beside where the sources are.

    python -m tools.spots field-wifi-1m --seeds 1-8 --set failures.die_fraction=0.2

A line for each seed. It runs `rass-mav swarm` with `--store`, and reads the store as `report` and `sources` do.
"""

from __future__ import annotations

import argparse
import math
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from rass_mav.ground.archive import Archive
from rass_mav.ground.attention.watch import Watch
from rass_mav.ground.sources.locator import estimate_of
from rass_mav.ground.sources.readings import Samples
from rass_mav.lab.experiment.located import inside
from rass_mav.lab.swarm.autopilot import to_arena
from rass_mav.lab.swarm.scenario import load_scenario
from rass_mav.lab.swarm.world import World

HEAD = (
    "| seed | sources found | errors, m | covered | areas, m² | hot spots | from the sources, m |\n"
    "|---|---|---|---|---|---|---|"
)


def row(scenario: str, seed: int, changes: Sequence[str]) -> str:
    """What a base has found at the end of a mission, for the table."""
    true = World(load_scenario(scenario, {"seed": seed}, changes)).surroundings.field.sources
    with TemporaryDirectory() as folder:
        store = Path(folder) / "base.db"
        more = [part for change in changes for part in ("--set", change)]
        swarm = [sys.executable, "-m", "rass_mav", "swarm", scenario, "--seed", str(seed), *more]
        subprocess.run([*swarm, "--store", str(store)], check=True, stdout=subprocess.DEVNULL)
        with Archive(store) as archive:
            samples = Samples()
            spots = Watch.of(archive, None, samples.watch(archive.entries())).spots.highest()
    found = estimate_of(samples)["sources"]
    places = [to_arena(*source["place"]) for source in found]
    peaks = [to_arena(*spot.place) for spot in spots]
    rings = [[to_arena(*corner) for corner in ring] for source in found for ring in source["region"]]
    resolved = sum(source["resolved"] for source in found)
    more_text = f", {len(found) - resolved} not resolved" if resolved < len(found) else ""

    def nearest(points: Sequence[tuple[float, float]], digits: int) -> str:
        """How far the nearest of these is from each source."""
        if not points:
            return "none"
        return ", ".join(f"{min(math.dist(one[:2], point) for point in points):.{digits}f}" for one in true)

    covered = sum(any(inside(ring, *one[:2]) for ring in rings) for one in true)
    ours = [min(found, key=lambda source: math.dist(to_arena(*source["place"]), one[:2])) for one in true if found]
    areas = ", ".join("-" if source["area_m2"] is None else f"{source['area_m2']:,.0f}" for source in ours)
    cells = [seed, f"{len(found)} of {len(true)}{more_text}", nearest(places, 1), covered, areas, len(spots)]
    return f"| {' | '.join(map(str, cells))} | {nearest(peaks, 0)} |"


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenario")
    parser.add_argument("--seeds", default="1-8", metavar="FIRST-LAST", help="(default: 1-8)")
    parser.add_argument("--set", action="append", default=[], metavar="KEY.PATH=VALUE", dest="changes")
    options = parser.parse_args(arguments)
    first, _, last = options.seeds.partition("-")
    print(HEAD)
    for seed in range(int(first), int(last or first) + 1):
        print(row(options.scenario, seed, options.changes), flush=True)


if __name__ == "__main__":
    main()

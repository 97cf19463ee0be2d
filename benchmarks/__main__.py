"""All benchmarks in one run, and whether the aims are met.

    python -m benchmarks            tables
    python -m benchmarks --json     one JSON object

It takes about five minutes. docs/evaluation/performance.md explains the figures. Times depend on the machine, so the
aims are
ratios where possible.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
from collections.abc import Sequence
from typing import Any

from benchmarks import air, frames, handover, node, page, policies, swarm

#: Path of a figure in the results, what it is, its bound, and whether that is the most or the least it may be.
AIMS: tuple[tuple[tuple[str, ...], str, float, bool], ...] = (
    (("frames", "fastcrc", "tunnel_encode", "ratio"), "TUNNEL encode / pymavlink, with fastcrc", 0.2, True),
    (("frames", "fastcrc", "tunnel_decode", "ratio"), "TUNNEL decode / pymavlink, with fastcrc", 0.2, True),
    (("frames", "fallback", "tunnel_encode", "ratio"), "TUNNEL encode / pymavlink, without", 0.2, True),
    (("frames", "fallback", "tunnel_decode", "ratio"), "TUNNEL decode / pymavlink, without", 0.2, True),
    (("swarm", "default", "per_s_100"), "robot-steps a second, 100 nodes", 20_000, False),
    (("policies", "survival", "ratio"), "robot-step under survival / under rass", 1.3, True),
    (("swarm", "default", "ratio"), "robot-step at 1,000 nodes / at 100, demo", 1.5, True),
    (("swarm", "same load", "ratio"), "the same, as many hand-overs a robot-step", 1.5, True),
    (("swarm", "bases in proportion", "ratio"), "the same, bases in proportion", 1.5, True),
    (("swarm", "islands of 100", "ratio"), "the same, ten swarms of 100", 1.5, True),
    (("swarm", "no data", "ratio"), "the same, beacons only", 1.5, True),
    (("air", "wifi-6m", "ratio_a_frame"), "a frame on wifi-6m / on the air that takes no time", 1.5, True),
    (("air", "wifi-1m", "ratio_a_frame"), "a frame on wifi-1m / on the air that takes no time", 1.5, True),
    (("air", "sik-64k", "ratio_a_frame"), "a frame on sik-64k / on the air that takes no time", 1.5, True),
    (("handover", "scrub all", "fsyncs_drone"), "fsyncs a datum, drone", 0.1, True),
    (("handover", "scrub all", "fsyncs_base"), "fsyncs a datum, base", 0.1, True),
    (("node", "node - bare", "rss"), "drone node over bare Python, MiB", 24.0, True),
    # For a Pi Zero, which has one slow core and 512 MiB for everything.
    (("node", "node", "rss"), "drone node, MiB resident", 34.0, True),
    (("node", "serial node", "rss"), "drone node with serial ports, MiB resident", 34.0, True),
    (("node", "node", "start_ms"), "drone node, start, ms", 1500.0, True),
    (("page", "drawn_ms", "p95"), "the page: 95 % of the frames drawn, ms", 100.0, True),
    (("page", "server_share"), "the page: the server's share of a core", 0.5, True),
    (("page", "to_page_s", "worst"), "the page: from arrival to page, worst, s", 1.0, True),
    (("page", "late_steps"), "the page: late steps of the base", 0.0, True),
)


def measure() -> dict[str, Any]:
    """All results, with a description of the machine."""
    from rass_mav.mavlink.crc import HAVE_FASTCRC

    return {
        "machine": {
            "python": platform.python_version(),
            "system": platform.system(),
            "processor": platform.machine(),
            "cores": os.cpu_count(),
        },
        "frames": {
            **({"fastcrc": frames.measure(7)} if HAVE_FASTCRC else {}),
            "fallback": frames.measure_without_fastcrc(7),
        },
        "swarm": swarm.measure(5, 10_000, 50),
        "policies": policies.measure(7, 10_000, 50),
        "air": air.measure(5, 5000, 50),
        "handover": handover.measure(5, 2000),
        "node": node.measure(5, 2.0),
        **({"page": page.measure(100, 100_000, 60)} if page.CHROMIUM else {}),
    }


def aims(results: dict[str, Any]) -> list[dict[str, Any]]:
    """Each aim with the measured figure; figures that could not be measured here are left out."""
    found = []
    for path, what, bound, at_most in AIMS:
        value: Any = results
        for key in path:
            value = value.get(key) if isinstance(value, dict) else None
        if value is not None:
            met = value <= bound if at_most else value >= bound
            found.append({"what": what, "measured": value, "aim": bound, "at_most": at_most, "met": met})
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args(arguments)
    results = measure()
    found = aims(results)
    if options.json:
        print(json.dumps({**results, "aims": found}))
        return
    print("  ".join(f"{key}: {value}" for key, value in results["machine"].items()))
    for show, name in (
        (frames.show, "frames"),
        (swarm.show, "swarm"),
        (policies.show, "policies"),
        (air.show, "air"),
        (handover.show, "handover"),
        (node.show, "node"),
        (page.show, "page"),
    ):
        if name in results:
            print()
            show(results[name])
    print(f"\n{'aims':<44} {'measured':>10} {'aim':>12}")
    for one in found:
        aim = f"{'at most' if one['at_most'] else 'at least'} {one['aim']:g}"
        print(f"  {one['what']:<42} {one['measured']:>10.4g} {aim:>17}  {'met' if one['met'] else 'NOT MET'}")


if __name__ == "__main__":
    main()

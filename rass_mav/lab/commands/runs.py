"""Shared by the commands that run swarms: recordings, progress, what is kept of an interrupted run, and summaries."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from rass_mav.commands.common import progress
from rass_mav.errors import RassError, os_errors_as


def summary_lines(summary: dict[str, Any], *remarks: str | None) -> Iterator[str]:
    """The summary of `swarm` or `replay` as lines. `remarks`: what to know about the world in which it was measured."""
    # A node does not load the mock swarm.
    from rass_mav.lab.swarm.failures import OLD_STEPS

    s = summary
    bases = "base" if s["bases"] == 1 else "bases"
    yield (
        f"{s['nodes'] - s['bases']} drones and {s['bases']} {bases}, topology {s['topology']}, policy {s['policy']}, "
        f"{s['steps']} steps, seed {s['seed']}"
    )
    yield from filter(None, remarks)
    yield ""
    created = s["created"]
    lost = s["lost"]
    yield _count(created, "data created by the drones")
    yield _count(s["delivered"], "arrived at a base", created)
    yield _count(s["held"], "held by drones, in transit", created)
    reasons = ", ".join(f"{reason} {count:,}" for reason, count in lost.items() if count)
    yield _count(sum(lost.values()), f"lost{': ' + reasons if reasons else ''}", created)
    yield ""
    delay, hops = s["delay_steps"], s["hops"]
    if delay["mean"] is not None:
        yield (
            f"reliability {s['reliability']:.3f}; mean delay {delay['mean']:.1f} steps (median {delay['p50']}, "
            f"95 % within {delay['p95']}) and {hops['mean']:.1f} hops to a base"
        )
    else:
        yield f"reliability {s['reliability']:.3f}; nothing has arrived"
    yield (
        f"drones' memory used {s['memory_used_percent']:.2f} %, {s['copies_mean']:.2f} copies and "
        f"{s['transmissions_per_datum']:.1f} transmissions per datum"
    )
    frames = s["frames"]
    yield (
        f"on the air: {frames['sent']:,} MAVLink frames, {s['bytes_sent'] / 1e6:.1f} MB; heard {frames['received']:,} "
        f"times, lost {frames['dropped']:,} times, {frames['malformed']:,} malformed"
    )
    if "load" in s:
        load = s["load"]
        intervals = [
            f"{what} every {interval} steps"
            for what, interval in (
                ("a measurement", load["interval_steps"]), ("a picture", load["picture_interval_steps"])
            )
            if interval
        ]  # fmt: skip
        yield (
            f"load {load['share']:.3f} of the air's one-hop capacity of {load['capacity_bytes_s']:,} bytes/s: "
            f"{load['created_bytes_s']:,} bytes/s created, from each drone {' and '.join(intervals)}"
        )
    if "failures" in s:
        failed = s["failures"]
        yield (
            f"drones that died: {failed['died']}, landed: {failed['landed']}; reboots: {failed['rebooted']}, "
            f"stores wiped: {failed['wiped']}"
        )
    if "blast" in s:
        blast = s["blast"]
        yield (
            f"blast: {blast['drones']} drones; of {blast['held']:,} data held that were at least {OLD_STEPS} steps "
            f"old, {blast['lost']:,} lost"
        )
    yield f"altered data: {s['altered']}; routing loops: {s['routing']['loops']}"
    if "wall_s" in s:
        yield (
            f"{s['wall_s']:.1f} s, {s['cpu_s']:.1f} s of processor time; "
            f"{s['robot_steps_per_s']:,} robot-steps per second of processor time"
        )


def _count(count: int, what: str, whole: int | None = None) -> str:
    share = f"{100 * count / whole:5.1f} %" if whole else " " * 7
    return f"  {count:>9,} {share}  {what}"


def flight_lines(flight: dict[str, Any]) -> Iterator[str]:
    """The part `sitl` of the summary of `sitl` as lines."""
    f = flight
    yield ""
    yield f"firmware {f['firmware']}, {f['wiring'].replace('-', ' ')}, readings {f['readings']}"
    missions = f["missions"]
    for v in f["vehicles"]:
        state = "mission finished" if v["finished"] else f"at mission item {v['item']} of {v['items'] - 1}"
        if v["node_id"] in missions["not_flown"]:
            state = "mission not flown"
        if v["killed_s"] is not None:
            state += f", autopilot killed after {v['killed_s']:.1f} s"
        yield (
            f"  vehicle {v['node_id']}: {state}; flew {v['flew_m']:.0f} m, at most {v['farthest_m']:.0f} m away and "
            f"{v['highest_m']:.0f} m high"
        )
    yield (
        f"missions finished: {len(missions['finished'])}, not finished: {len(missions['unfinished'])}, "
        f"not flown: {len(missions['not_flown'])}"
    )
    m = f["measurements"]
    yield (
        f"measurements at the base: {m['delivered']:,}, with position {m['with_position']:,}, "
        f"with reading {m['with_reading']:,}"
    )
    if m["error_m"]["mean"] is not None:
        yield f"their positions are {m['error_m']['mean']:.1f} m off on average, {m['error_m']['max']:.1f} m at most"


#: The start of virtual time in recordings, 2020-01-01 00:00 UTC, so that the same run creates the same file.
VIRTUAL_START_S = 1_577_836_800.0


@contextlib.contextmanager
def recorder(
    path: Path | None, step_s: float, start_s: float = VIRTUAL_START_S
) -> Iterator[Callable[[bytes, int], None] | None]:
    """Write frames to a .tlog, with times from `start_s`, seconds since 1970."""
    if path is None:
        yield None
        return
    from rass_mav.lab.medium.tlog import TlogWriter

    with os_errors_as(RassError, path), path.open("wb") as file:
        writer = TlogWriter(file)
        yield lambda frame, step: writer.record(frame, start_s + step * step_s)


@contextlib.contextmanager
def progress_of_steps(steps: int, *, quiet: bool) -> Iterator[Callable[[int], None]]:
    """The same for a swarm in real time, which reports the number of finished steps."""
    done = 0
    with progress(steps, "steps", quiet=quiet) as advance:

        def reached(step: int) -> None:
            nonlocal done
            advance(step - done)
            done = step

        yield reached


def kept_files(record: Path | None, keep: Path | None = None) -> str:
    """What is kept of an interrupted run: `record`: a file of frames; `keep`: a directory."""
    parts = [f"the frames so far are in {record}"] if record is not None else []
    if keep is not None:
        parts.append(f"configurations, stores and logs so far are in {keep}")
    return "; ".join(parts) or "nothing was saved"

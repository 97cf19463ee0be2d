"""How long a drone node takes to start, and how much memory it needs, against bare Python.

    python -m benchmarks.node            a table
    python -m benchmarks.node --json     one JSON object

The node is `python -m rass_mav run` with a UDP link, an autopilot port and a new store. It is ready when it reports so.
The serial node has its autopilot, a radio and a Geiger counter on serial ports (pseudo-terminals) instead. The node
with keys has the first one's ports. Bare Python
is the same interpreter, which prints a line and waits. `dialect` is bare Python that has imported pymavlink's common
dialect: the part of the node's memory that is not ours. All are started in turns.

Memory is read some steps after the start, from /proc (Linux only). RSS is all resident memory, shared libraries
included. USS is what would be freed if the process ended.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import pty
import select
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.tables import spread, table

ROOT = Path(__file__).resolve().parent.parent
STEP_S = 0.1
DEADLINE_S = 30.0
#: Resident memory, KiB: field of /proc/PID/smaps_rollup. USS is the sum of the two private fields.
_FIELDS = {"Rss": "rss", "Private_Clean": "uss", "Private_Dirty": "uss"}
_WAIT = "print('ready', flush=True); input()"

BARE = {
    "bare": [sys.executable, "-c", _WAIT],
    "dialect": [sys.executable, "-c", f"from pymavlink.dialects.v20 import common; {_WAIT}"],
}


def memory(pid: int) -> dict[str, float]:
    """`rss` and `uss` of a process in MiB."""
    found = {"rss": 0.0, "uss": 0.0}
    for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
        name, _, rest = line.partition(":")
        if name in _FIELDS:
            found[_FIELDS[name]] += int(rest.split()[0]) / 1024
    return found


def _free_ports(count: int) -> list[int]:
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(count)]
    for one in sockets:
        one.bind(("127.0.0.1", 0))
    ports = [one.getsockname()[1] for one in sockets]
    for one in sockets:
        one.close()
    return ports


def config() -> dict[str, Any]:
    """Of a drone with a UDP link and an autopilot port."""
    link, peer, autopilot = _free_ports(3)
    return {
        "node": {"id": 1, "step_s": STEP_S},
        "autopilot": {"url": f"udpin:127.0.0.1:{autopilot}"},
        "links": [{"listen": f"127.0.0.1:{link}", "peers": [{"address": f"127.0.0.1:{peer}", "id": 0}]}],
    }


def _serial_config(ports: Sequence[str]) -> dict[str, Any]:
    autopilot, radio, counter = ports
    return {
        **config(),
        "autopilot": {"url": f"serial:{autopilot}:921600"},
        "links": [{"type": "serial", "device": f"{radio},57600"}],
        "sensor": {"type": "mightyohm", "port": counter},
    }


def start(command: list[str], directory: Path, settle_s: float) -> dict[str, float]:
    """Start a process, wait until it is ready, measure it after `settle_s` seconds more, and stop it."""
    # As for a user who has installed the package: after the first start its bytecode is compiled.
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    begin = time.perf_counter()
    with subprocess.Popen(
        command, cwd=directory, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        try:
            assert process.stdout is not None
            ready, _, _ = select.select([process.stdout], [], [], DEADLINE_S)
            seconds = time.perf_counter() - begin
            if not ready or not process.stdout.readline():
                raise RuntimeError(f"{command} did not start")
            time.sleep(settle_s)
            return {"start_ms": seconds * 1e3, **memory(process.pid)}
        finally:
            process.terminate()


def measure(rounds: int, settle_s: float) -> dict[str, dict[str, list[float]]]:
    """Figures of each round, for each kind of process."""
    from rass_mav.trust.keys import folder

    found: dict[str, dict[str, list[float]]] = {}
    pairs = [pty.openpty() for _ in range(3)]
    ports = [os.ttyname(near) for _, near in pairs]
    # The first round only compiles and fills the disk's cache.
    for turn in range(rounds + 1):
        with tempfile.TemporaryDirectory() as name:
            directory = Path(name)
            folder.create(directory / "keys")
            [issued] = folder.issue(directory / "keys", [1])
            configs = {
                "node": config(),
                "node with keys": {**config(), "keys": {"file": str(issued.path)}},
                "serial node": _serial_config(ports),
            }
            commands = dict(BARE)
            for kind, values in configs.items():
                # JSON is YAML too. Each has a store of its own.
                (directory / kind).mkdir()
                (directory / kind / "drone.yaml").write_text(json.dumps(values))
                commands[kind] = [sys.executable, "-m", "rass_mav", "run", "--json", f"{kind}/drone.yaml"]
            for kind, command in commands.items():
                one = start(command, directory, settle_s)
                if turn:
                    for key, value in one.items():
                        found.setdefault(kind, {}).setdefault(key, []).append(round(value, 2))
    for end in itertools.chain(*pairs):
        os.close(end)
    return found


def show(results: dict[str, dict[str, list[float]]]) -> str:
    """The table."""
    rows = [
        [kind, spread(one["start_ms"]), spread(one["rss"], 1), spread(one["uss"], 1)] for kind, one in results.items()
    ]
    return table(["", "start, ms", "RSS, MiB", "USS, MiB"], rows)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--rounds", type=int, default=5, help="starts of each (default: 5)")
    parser.add_argument("--settle", type=float, default=2.0, help="seconds from ready to the measurement (default: 2)")
    options = parser.parse_args(arguments)
    results = measure(options.rounds, options.settle)
    print(json.dumps(results) if options.json else show(results))


if __name__ == "__main__":
    main()

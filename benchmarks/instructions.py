"""Instructions of a robot-step: counted, so that load on the machine does not change them.

    python -m benchmarks.instructions            two tables; needs valgrind
    python -m benchmarks.instructions --rooms    only the bytecodes, by room
    python -m benchmarks.instructions --json     one JSON object

Machine instructions are those of the whole process under cachegrind: a swarm runs once for some steps and once for
more, and the difference is divided among the robot-steps between them, and among the frames that were received in
these. Which part of the program they belong to, cachegrind cannot tell. So the bytecodes that the interpreter carries
out are counted too, by the room whose code they are. The two are not the same: one bytecode may call a long function in
C. Each line has two numbers for each swarm: in a robot-step, and for each frame received.

The swarms are the scenario `paper-grid`, and `demo` with the paper's node and with the defaults.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from benchmarks.swarm import reached

ROOT = Path(__file__).resolve().parent.parent
if TYPE_CHECKING:
    from rass_mav.lab.swarm.world import World

#: The paper's node: one copy, one hop a step, no receipts.
PLAIN: dict[str, Any] = {
    "policy.name": "rass", "custody.replicas": False, "without": ["receipts"], "node.forward": "step",
}  # fmt: skip
#: Name of a line, scenario and overrides.
SWARMS: dict[str, tuple[str, dict[str, Any]]] = {
    "paper-grid": ("paper-grid", {}),
    "demo, rass": ("demo", PLAIN),
    "demo, the defaults": ("demo", {}),
}
#: Steps before the count begins, when routes are there and data on their way.
WARM_STEPS = 36


def world_of(name: str) -> World:
    """A swarm of `SWARMS` at its start."""
    from rass_mav.lab.swarm.scenario import load_scenario
    from rass_mav.lab.swarm.world import World

    scenario, options = SWARMS[name]
    return World(load_scenario(scenario, options))


class Rooms:
    """Counts the bytecodes carried out, by room."""

    def __init__(self) -> None:
        self.bytecodes: Counter[str] = Counter()
        self._room_of: dict[str, str] = {}

    def trace(self, frame: FrameType, event: str, argument: Any) -> Any:
        """For `sys.settrace`."""
        frame.f_trace_lines = False
        frame.f_trace_opcodes = True
        file = frame.f_code.co_filename
        room = self._room_of.get(file)
        if room is None:
            room = self._room_of[file] = room_of(Path(file))
        bytecodes = self.bytecodes

        def count(frame: FrameType, event: str, argument: Any) -> Any:
            if event == "opcode":
                bytecodes[room] += 1
            return count

        return count


def room_of(file: Path) -> str:
    """`core/custody` and the like; `library` for what is not ours."""
    try:
        parts = file.relative_to(ROOT / "rass_mav").parent.parts
    except ValueError:
        return "library"
    return "/".join(parts[:2]) if parts else "rass_mav"


def by_room(name: str, steps: int) -> dict[str, Any]:
    """Bytecodes a robot-step, by room, and frames received in one."""
    world = world_of(name)
    for _ in range(WARM_STEPS):
        world.step()
    before = reached(world)
    rooms = Rooms()
    sys.settrace(rooms.trace)
    try:
        for _ in range(steps):
            world.step()
    finally:
        sys.settrace(None)
    robot_steps = steps * world.scenario.nodes
    return {
        "frames": (reached(world) - before) / robot_steps,
        "bytecodes": {room: count / robot_steps for room, count in rooms.bytecodes.most_common()},
    }


def machine(name: str, steps: int) -> float:
    """Machine instructions a robot-step. OSError: there is no valgrind."""
    script = "import sys; from benchmarks.instructions import world_of\n"
    script += "from rass_mav.lab.swarm.virtual import at_rest\nworld = world_of(sys.argv[1])\n"
    # As `rass-mav swarm` does.
    script += "with at_rest():\n    for _ in range(int(sys.argv[2])): world.step()\nprint(world.scenario.nodes)"
    command = ["valgrind", "--tool=cachegrind", "--cache-sim=no", "--cachegrind-out-file=/dev/null"]
    # Without this the order of sets, and with it a little of what is counted, differs from run to run.
    environment = {**os.environ, "PYTHONHASHSEED": "0", "PYTHONPATH": str(ROOT)}
    counts, nodes = [], 1
    for each in (WARM_STEPS, WARM_STEPS + steps):
        run = [*command, sys.executable, "-c", script, name, str(each)]
        done = subprocess.run(run, env=environment, cwd=ROOT, capture_output=True, text=True, check=True)
        [count] = re.findall(r"I +refs: +([\d,]+)", done.stderr)
        counts.append(int(count.replace(",", "")))
        nodes = int(done.stdout)
    return (counts[1] - counts[0]) / (steps * nodes)


def measure(steps: int, *, rooms_only: bool) -> dict[str, Any]:
    """All of it, by swarm."""
    results = {}
    for name in SWARMS:
        results[name] = by_room(name, steps)
        if not rooms_only:
            results[name]["machine"] = machine(name, steps)
    return results


def show(results: dict[str, Any]) -> None:
    """Print the tables."""
    names = list(results)
    print(f"{'in a robot-step, for each frame':<32}" + "".join(f"{name:>24}" for name in names))

    def line(label: str, values: Sequence[float]) -> None:
        shares = [value / results[name]["frames"] for name, value in zip(names, values, strict=True)]
        both = zip(values, shares, strict=True)
        print(f"  {label:<30}" + "".join(f"{value:>16,.0f}{share:>8,.0f}" for value, share in both))

    print(f"  {'frames received':<30}" + "".join(f"{results[name]['frames']:>16.2f}{'':8}" for name in names))
    if all("machine" in results[name] for name in names):
        line("machine instructions", [results[name]["machine"] for name in names])
    line("bytecodes", [sum(results[name]["bytecodes"].values()) for name in names])
    rooms: dict[str, None] = {}
    for name in names:
        rooms.update(dict.fromkeys(results[name]["bytecodes"]))
    for room in sorted(rooms, key=lambda room: -results[names[-1]]["bytecodes"].get(room, 0.0)):
        line(f"  {room}", [results[name]["bytecodes"].get(room, 0.0) for name in names])


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--rooms", action="store_true", help="without valgrind: only bytecodes")
    parser.add_argument("--steps", type=int, default=4, help="steps that are counted (default: 4)")
    options = parser.parse_args(arguments)
    results = measure(options.steps, rooms_only=options.rooms)
    if options.json:
        print(json.dumps(results))
    else:
        show(results)


if __name__ == "__main__":
    main()

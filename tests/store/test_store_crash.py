"""kill -9 at any moment: what a node was told is committed is there afterwards, and no commit is there in part."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from rass_mav.store.reader import SqliteReader
from rass_mav.store.repairs import OpenReport
from tests.some import some

from .store_helpers import ROOT, open_store, payload

# Before each commit the child says what it is going to put and to remove, afterwards that it is done.
CHILD = """
import random, sys
from pathlib import Path
from rass_mav.core.datum import Fate
from tests.store.store_helpers import commit, datum, open_store

store = open_store(Path(sys.argv[1]))
draw = random.Random(int(sys.argv[2]))
while True:
    gone = [id for id in store.ids() if draw.random() < 1 / 3]
    for id in gone:
        store.remove(id, Fate.PASSED_ON)
    made = [store.next_sequence() for _ in range(draw.randint(1, 5))]
    for sequence in made:
        store.put(datum(sequence, draw.randint(0, 30_000)))
    store.count("made", len(made))
    store.count("gone", len(gone))
    print(*made, "-", *(id.sequence for id in gone), flush=True)
    commit(store)
    print("done", flush=True)
"""


def run_and_kill(path: Path, seed: int, commits: int) -> list[str]:
    """Let a child do at least `commits` commits and kill it wherever it is by then. Returns the lines that it said."""
    child = subprocess.Popen(
        [sys.executable, "-c", CHILD, str(path), str(seed)],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    lines = [some(child.stdout).readline() for _ in range(2 * commits)]
    child.kill()
    rest, _ = child.communicate()
    # A last line that was cut off was not said.
    lines += [line for line in rest.splitlines(keepends=True) if line.endswith("\n")]
    assert all(lines), "the child ended by itself"
    return [line.strip() for line in lines]


def test_everything_said_to_be_committed_survives_kill_9(tmp_path: Path) -> None:
    path = tmp_path / "node.db"
    held: set[int] = set()
    made = gone = 0
    for seed, commits in enumerate((1, 2, 60, 7, 150, 23)):
        lines = run_and_kill(path, seed, commits)
        states = [(held, made, gone)]
        for plan, done in zip(lines[::2], lines[1::2] + ["?"] * (len(lines) % 2), strict=True):
            came, went = ({int(word) for word in words.split()} for words in plan.split("-"))
            # No number is used twice and none is left out, however often the node dies.
            assert came == set(range(made, made + len(came)))
            held, made, gone = (held - went) | came, made + len(came), gone + len(went)
            if done == "done":
                states.clear()
            states.append((held, made, gone))
        # All that was done is there; what was planned last is there as a whole, or not at all.
        assert len(states) <= 2
        with SqliteReader(path) as reader:
            data = [reader.get(id) for id in reader.ids()]
            counters = reader.counters()
            found = {id.sequence for id in reader.ids()}, reader.assigned, counters["gone"]
        assert found in states
        assert counters["made"] == found[1]
        held, made, gone = found
        for datum in data:
            assert datum is not None
            assert datum.intact
            assert datum.payload == payload(datum.id.sequence, len(datum.payload))
        with open_store(path) as store:
            assert store.report == OpenReport()
            assert {id.sequence for id in store.ids()} == held

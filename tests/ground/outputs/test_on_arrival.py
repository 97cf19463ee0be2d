"""A command for each datum that arrives: real bases, and commands that hang, fail and flood."""

from __future__ import annotations

import json
import os
import signal
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from rass_mav.app.outlets import OnArrivalSection
from rass_mav.core.datum import Kind
from rass_mav.ground.archive import Archive
from rass_mav.ground.entry import Entry, Opens
from rass_mav.ground.feed import Cursor
from rass_mav.ground.outputs.hook_runner import MOST_LINES, Hook, HookRunner, read_cursor, write_cursor
from rass_mav.store.files import Lock
from tests.app.app_nodes import RunningNode, Tidy, command
from tests.ground.missions import HERE, Base
from tests.ground.sealed_data import OPENS, sealed
from tests.patience import PATIENCE_S
from tests.some import some

from .beside import Until, report

#: Appends what it gets to a file, in one write, and its environment to another.
TELL = ["sh", "-c", 'echo "$RASS_ID $RASS_DRONE $RASS_KIND" >> told.txt; cat >> told.jsonl']


def base(directory: Path, **on_arrival: Any) -> RunningNode:
    return RunningNode(directory, 1, node={"role": "base"}, on_arrival=on_arrival)


def put(node: RunningNode, payload: bytes) -> str:
    return str(node.ask("put", payload=payload)["id"])


def told(directory: Path) -> list[str]:
    """The ids that the command was told, in order."""
    file = directory / "told.txt"
    return [line.split()[0] for line in file.read_text().splitlines()] if file.exists() else []


def test_each_datum_is_told_once_also_over_restarts(tmp_path: Path, tidy: Tidy) -> None:
    node = tidy(base(tmp_path, command=TELL)).start()
    ids = [put(node, b"datum %d" % number) for number in range(5)]
    node.until(lambda: told(tmp_path) == ids)
    node.until(
        lambda: (
            report(node, "on_arrival")
            == {"behind": 0, "succeeded": 5, "failed": 0, "last_failure": None, "trouble": None}
        )
    )
    assert "on_arrival: 5 done, 0 failed, 0 pending" in command(tmp_path, "status", "n1.yaml").stdout.decode()
    assert node.signal(signal.SIGTERM) == 0
    node.start()
    ids.append(put(node, b"after the restart"))
    node.until(lambda: told(tmp_path) == ids)
    assert node.signal(signal.SIGTERM) == 0
    objects = [json.loads(line) for line in (tmp_path / "told.jsonl").read_text().splitlines()]
    assert [(found["id"], found["kind"]) for found in objects] == [(id, "bytes") for id in ids]
    assert (tmp_path / "told.txt").read_text().splitlines() == [f"{id} 1 bytes" for id in ids]


@pytest.mark.no_cover
def test_a_command_that_hangs_is_killed_and_the_node_goes_on(tmp_path: Path, tidy: Tidy) -> None:
    # What it started hangs too.
    hang = ["sh", "-c", "echo $$ >> pids; sleep 3600 & sleep 3600"]
    node = tidy(base(tmp_path, command=hang, timeout_s=1.0)).start()
    for number in range(50):
        put(node, b"datum %d" % number)
    first_step: dict[int, int] = {}

    def begun() -> list[int]:
        pids = tmp_path / "pids"
        return [int(pid) for pid in pids.read_text().split()] if pids.exists() else []

    def steps_go_on_while_one_command_hangs() -> bool:
        current = begun()[-1]
        steps = node.status()["steps"]
        # It hung before the node answered and afterwards.
        return alive(current) and steps >= first_step.setdefault(current, steps) + 3

    node.until(lambda: begun() != [])
    node.until(steps_go_on_while_one_command_hangs)
    node.until(lambda: report(node, "on_arrival").get("failed", 0) >= 2)
    # It looks at the store again after each command.
    node.until(lambda: (found := report(node, "on_arrival"))["behind"] == 50 - found["failed"] - found["succeeded"])
    assert report(node, "on_arrival")["last_failure"].endswith(": killed after 1 s")
    assert "the command failed for 1 data, the last one" in node.log()
    node.until(lambda: not alive(begun()[0]))
    assert node.signal(signal.SIGTERM) == 0


def alive(group: int) -> bool:
    """Whether there is a process of this group."""
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.no_cover
def test_after_kill_9_nothing_is_missed(tmp_path: Path, tidy: Tidy) -> None:
    node = tidy(base(tmp_path, command=TELL)).start()
    ids = [put(node, b"datum %d" % number) for number in range(60)]
    node.until(lambda: len(told(tmp_path)) >= 5)
    node.signal(signal.SIGKILL)
    node.start()
    ids += [put(node, b"more %d" % number) for number in range(5)]
    node.until(lambda: len(set(told(tmp_path))) >= 20)
    beside = node.status()["outputs"]["pid"]
    os.kill(beside, signal.SIGKILL)
    node.until(lambda: set(told(tmp_path)) == set(ids) and report(node, "on_arrival")["behind"] == 0)
    assert node.status()["outputs"]["ends"] == 1
    assert "the output process has ended" in node.log()
    # The process of the killed node finishes its datum; only the one that was killed itself may leave one half told.
    assert len(told(tmp_path)) <= len(ids) + 1
    assert node.signal(signal.SIGTERM) == 0


def test_a_stop_waits_for_the_command(tmp_path: Path, tidy: Tidy) -> None:
    os.mkfifo(tmp_path / "gate")
    wait = "[ -e begun ] || { echo > begun; read line < gate; }; echo $RASS_ID >> told.txt"
    node = tidy(base(tmp_path, command=["sh", "-c", wait])).start()
    ids = [put(node, b"first"), put(node, b"second"), put(node, b"third")]
    node.until((tmp_path / "begun").exists)
    assert node.process is not None
    node.process.send_signal(signal.SIGTERM)
    # Opens when the command reads it.
    (tmp_path / "gate").write_text("go on\n")
    assert node.process.wait(PATIENCE_S) == 0
    done = told(tmp_path)
    assert done == ids[: len(done)] != []
    cursor = read_cursor(tmp_path / "n1.db.told")
    with Archive(tmp_path / "n1.db") as archive:
        assert [entry.name for entry in archive.arrivals(some(cursor).arrival)] == ids[len(done) :]


# -- without a node ----------------------------------------------------------------------------------------------------


def telling(path: Path, *command: str, until: int, opens: Opens | None = None, **more: Any) -> HookRunner:
    """A teller that has run until it has gone on from so many data."""
    found = HookRunner(OnArrivalSection(command=command, **more), path, opens)
    found.run(Until(lambda: found.report()["succeeded"] + found.report()["failed"] >= until))
    return found


@pytest.fixture
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Base]:
    monkeypatch.chdir(tmp_path)
    made = Base(tmp_path / "base.db")
    yield made
    made.close()


def test_only_the_kinds_that_are_wanted_are_told(store: Base, tmp_path: Path) -> None:
    store.arrive(store.datum(7, 0, Kind.BYTES, b"text"), store.measurement(7, 1, HERE), store.file(8, 2, "a.txt", b"a"))
    telling(store.path, *TELL, until=2, kinds=("measurement", "file"))
    assert [line.split()[1:] for line in (tmp_path / "told.txt").read_text().splitlines()] == [
        ["7", "measurement"], ["8", "file"],
    ]  # fmt: skip
    first = json.loads((tmp_path / "told.jsonl").read_text().splitlines()[0])
    assert first["measurement"]["reading"] == pytest.approx(HERE.reading)
    store.arrive(store.datum(7, 3, Kind.BYTES, b"text"), store.measurement(7, 4, HERE))
    telling(store.path, *TELL, until=1, kinds=("bytes",))
    assert (tmp_path / "told.txt").read_text().splitlines()[-1].endswith("-3 7 bytes")


def test_sealed_data_are_told_opened(store: Base, tmp_path: Path) -> None:
    store.arrive(sealed(store.measurement(7, 0, HERE)), sealed(store.file(8, 1, "a.txt", b"a")))
    telling(store.path, *TELL, until=1, opens=OPENS, kinds=("measurement",))
    [told] = (tmp_path / "told.jsonl").read_text().splitlines()
    assert json.loads(told)["measurement"]["reading"] == pytest.approx(HERE.reading)


def test_a_failure_shows_no_line_of_an_earlier_run(store: Base) -> None:
    store.arrive(*(store.measurement(7, number, HERE) for number in range(2)))
    found = telling(store.path, "sh", "-c", "case $RASS_ID in *-1) exit 3;; esac; echo all well", until=2)
    assert (found.report()["succeeded"], found.report()["failed"]) == (1, 1)
    assert found.report()["last_failure"].endswith("-1: exit code 3")


@pytest.mark.parametrize(
    ("command", "why"),
    [
        (("false",), "exit code 1"),
        (("sh", "-c", "echo started; printf 'no \\033[1mnetwork' >&2; exit 3"), "exit code 3: no ?[1mnetwork"),
        (("sh", "-c", f"printf {'x' * 300}; exit 3"), f"exit code 3: {'x' * 200}"),
        (("sh", "-c", "kill -9 $$"), "ended by signal 9"),
        (("/no/such/program",), "/no/such/program: there is no folder /no/such"),
    ],
)
def test_failures_are_counted_and_not_repeated(store: Base, command: tuple[str, ...], why: str) -> None:
    store.arrive(*(store.measurement(7, number, HERE) for number in range(3)))
    # The third fails while the base stops: that does not count, and it is told again.
    found = telling(store.path, *command, until=2)
    assert found.report()["failed"] == 2
    assert found.report()["last_failure"].endswith(f"-1: {why}")
    assert telling(store.path, "true", until=1).report()["behind"] == 0


def test_a_cursor_that_cannot_be_read_or_of_another_life_begins_again(
    store: Base, caplog: pytest.LogCaptureFixture
) -> None:
    store.arrive(*(store.measurement(7, number, HERE) for number in range(3)))
    telling(store.path, "true", until=3)
    file = store.path.with_name("base.db.told")
    cursor = some(read_cursor(file))
    write_cursor(file, cursor._replace(epoch=cursor.epoch ^ 1))
    assert telling(store.path, "true", until=3).report()["succeeded"] == 3
    assert "the command runs again for all its data" in caplog.text
    file.write_text('{"life": 3}')
    assert telling(store.path, "true", until=3).report()["succeeded"] == 3
    assert "cannot be read" in caplog.text
    assert read_cursor(file) == cursor


def test_two_at_once_do_not_tell_twice(store: Base, monkeypatch: pytest.MonkeyPatch) -> None:
    store.arrive(store.measurement(7, 0, HERE))
    held = Lock(store.path.with_name("base.db.told"))
    tries: list[None] = []
    second = HookRunner(OnArrivalSection(command=("true",)), store.path)
    second.run(Until(lambda: tries.append(None) or len(tries) > 2))  # type: ignore[func-returns-value]
    assert second.report()["succeeded"] == 0
    assert "in use" in second.report()["trouble"]
    held.release()


def test_a_flood_of_output_is_cut(store: Base, caplog: pytest.LogCaptureFixture) -> None:
    store.arrive(store.measurement(7, 0, HERE))
    with Archive(store.path) as archive:
        [entry] = archive.entries()
    caplog.set_level("INFO")
    hook = Hook(OnArrivalSection(command=(sys.executable, "-c", "print('x' * 5000); print('line\\n' * 1000)")))
    assert hook.run(entry) == ""
    assert hook.run(entry._replace(hops=3)) == ""
    assert isinstance(entry, Entry)
    assert len([record for record in caplog.records if record.message == "line"]) <= 2 * MOST_LINES
    assert Counter(len(record.message) for record in caplog.records)[1000] <= 10


def test_a_cursor_is_replaced_as_a_whole(tmp_path: Path) -> None:
    file = tmp_path / "a.told"
    for arrival in (1 << 41, 3):
        write_cursor(file, Cursor(1, 0xFFFFFFFF, arrival))
        assert read_cursor(file) == Cursor(1, 0xFFFFFFFF, arrival)
    assert [path.name for path in tmp_path.iterdir()] == ["a.told"]

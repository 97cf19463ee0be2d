"""Real processes: the link key changes, and a drone is revoked, while data flow and nodes are killed."""

from __future__ import annotations

import json
import shutil
import signal
from pathlib import Path
from typing import Any

import pytest

from rass_mav.app.keyfiles import key_updates_path
from rass_mav.trust.keys.files import GROUND_FILE, drone_file

from .app_nodes import RunningNode, Tidy, command, free_ports


def mission(directory: Path, *drones: int) -> None:
    assert command(directory, "keys", "new", "mission").returncode == 0
    assert command(directory, "keys", "drone", *map(str, drones), "-d", "mission").returncode == 0


def nodes(directory: Path, tidy: Tidy, ids: list[int], pairs: list[tuple[int, int]]) -> list[RunningNode]:
    """Node 1 is the base, and `pairs` hear each other. Each drone has its file on a disk of its own."""
    ports = dict(zip(ids, free_ports(len(ids)), strict=True))
    made = []
    for node_id in ids:
        others = [b if a == node_id else a for a, b in pairs if node_id in (a, b)]
        peers = [{"id": other, "address": f"127.0.0.1:{ports[other]}"} for other in others]
        held = directory / "mission" / GROUND_FILE
        if node_id != 1:
            (directory / f"disk-{node_id}").mkdir()
            held = Path(shutil.copy2(directory / "mission" / drone_file(node_id), directory / f"disk-{node_id}"))
        sections: dict[str, Any] = {"keys": {"file": str(held)}, "data": {"status_s": 1.0}}
        if node_id == 1:
            sections["node"] = {"role": "base"}
        link = {"listen": f"127.0.0.1:{ports[node_id]}", "peers": peers}
        made.append(tidy(RunningNode(directory, node_id, links=[link], **sections)))
    return made


def number(node: RunningNode) -> int:
    return int(node.status()["keys"]["link_key"])


def hears(node: RunningNode) -> set[int]:
    return {neighbour["node_id"] for neighbour in node.status()["neighbours"]}


def create(node: RunningNode, text: str) -> str:
    return str(node.ask("put", payload=text.encode())["id"])


@pytest.mark.no_cover
def test_the_key_changes_and_a_drone_is_revoked_in_a_running_swarm(tmp_path: Path, tidy: Tidy) -> None:
    """A line of base 1 and drones 2, 3 and 4, and drone 5 beside the base. 3 is killed in the middle of the change."""
    mission(tmp_path, 2, 3, 4, 5)
    base, two, three, four, five = nodes(tmp_path, tidy, [1, 2, 3, 4, 5], [(1, 2), (2, 3), (3, 4), (1, 5), (2, 5)])
    for node in (base, two, three, four, five):
        node.start()
    sent = [create(node, f"{node.name} before") for node in (two, three, four, five)]
    base.until(lambda: set(sent) <= set(base.listing()))

    # First all go to key 2. One is killed while it has it, and finds it on its disk.
    said = json.loads(command(tmp_path, "keys", "rotate", "-d", "mission", "--json").stdout)
    assert said["link_key"] == 2
    sent += [create(node, f"{node.name} amid") for node in (two, three, four, five)]
    three.until(lambda: number(three) == 2)
    three.until(lambda: key_updates_path(tmp_path / "n3.db").exists())
    assert three.signal(signal.SIGKILL) == -signal.SIGKILL
    three.start()
    assert number(three) == 2
    for node in (base, two, four, five):
        node.until(lambda node=node: number(node) == 2)  # type: ignore[misc]
    base.until(lambda: set(sent) <= set(base.listing()))

    # Then drone 5 is revoked. 3 is off meanwhile, with data that nobody else has, and its file is that of the start.
    sent.append(create(three, "waits on a drone that is off"))
    assert three.signal(signal.SIGKILL) == -signal.SIGKILL
    said = json.loads(command(tmp_path, "keys", "revoke", "5", "-d", "mission", "--json").stdout)
    assert (said["link_key"], said["revoked"]) == (3, [{"id": 5, "serial": 1}])
    sent += [create(two, "while one is off"), create(four, "beyond the gap")]
    for node in (base, two):
        node.until(lambda node=node: number(node) == 3)  # type: ignore[misc]
    three.start()
    for node in (three, four):
        node.until(lambda node=node: number(node) == 3)  # type: ignore[misc]
    sent += [create(node, f"{node.name} after") for node in (two, three, four)]
    base.until(lambda: set(sent) <= set(base.listing()))

    # How the crew sees that it has reached a drone three hops away.
    def told() -> dict[int, int]:
        """The link key in the last status of each drone."""
        report = json.loads(command(tmp_path, "report", "n1.yaml", "--json").stdout)
        return {each["drone"]: each["status"]["link_key"] for each in report["drones"] if each["status"] is not None}

    base.until(lambda: told() == {1: 3, 2: 3, 3: 3, 4: 3, 5: 2})

    # Drone 5 knows it, and nothing that it says reaches anybody.
    five.until(lambda: bool(five.status()["key_updates"]["revoked"]))
    late = create(five, "from a drone that is out")
    base.until(lambda: 5 not in hears(base))
    two.until(lambda: 5 not in hears(two))
    steps = base.status()["steps"]
    base.until(lambda: base.status()["steps"] > steps + 40)
    assert late not in base.listing()
    assert late not in two.listing()
    assert base.status()["key_updates"]["others_revoked"] == [{"node_id": 5, "serial": 1}]
    said = command(tmp_path, "status", "n5.yaml").stdout.decode()
    assert "ALARM: the keys of this drone are revoked" in said
    assert "revoked or replaced: drone 5 up to serial 1" in command(tmp_path, "status", "n2.yaml").stdout.decode()
    contents = {entry["id"]: entry for entry in json.loads(command(tmp_path, "ls", "n1.yaml", "--json").stdout)["data"]}
    assert set(sent) <= contents.keys()
    assert command(tmp_path, "get", "-c", "n1.yaml", sent[-1]).stdout == b"n4 after"
    for node in (base, two, three, four, five):
        assert node.signal(signal.SIGTERM) == 0
        for path in tmp_path.glob("n*.letters"):
            assert path.stat().st_mode & 0o777 == 0o600


def test_a_file_that_changes_under_a_running_node(tmp_path: Path, tidy: Tidy) -> None:
    """It is taken when it is whole and right, and whatever else comes does no harm."""
    mission(tmp_path, 2)
    base, two = (node.start() for node in nodes(tmp_path, tidy, [1, 2], [(1, 2)]))
    held = tmp_path / "mission" / GROUND_FILE
    before = held.read_bytes()
    assert command(tmp_path, "keys", "rotate", "-d", "mission").returncode == 0
    after = held.read_bytes()
    base.until(lambda: number(base) == 2)
    for wrong, said in [
        (after[:-9], "damaged, or not a key file"),
        (before, "the file now holds link key 1, and this node has 2 already"),
        ((tmp_path / "disk-2" / drone_file(2)).read_bytes(), "holds the keys of drone 2, not the ground's"),
    ]:
        held.write_bytes(wrong)
        base.until(lambda said=said: said in base.log())  # type: ignore[misc]
    held.unlink()
    two.until(lambda: number(two) == 2)
    base.until(lambda: hears(base) == {2})
    held.write_bytes(after)
    held.chmod(0o600)
    assert command(tmp_path, "keys", "rotate", "-d", "mission").returncode == 0
    two.until(lambda: number(two) == 3)
    # By hand, too.
    assert two.signal(signal.SIGTERM) == 0
    key_updates_path(tmp_path / "n2.db").write_bytes(b"spoilt")
    shutil.copy2(tmp_path / "mission" / drone_file(2), tmp_path / "disk-2")
    two.start()
    assert "n2.db.letters: not a file of key updates" in two.log()
    assert number(two) == 3
    base.until(lambda: hears(base) == {2})


def test_key_updates_that_cannot_be_written_stay_in_memory_and_that_is_said(tmp_path: Path, tidy: Tidy) -> None:
    mission(tmp_path, 2)
    base, two = nodes(tmp_path, tidy, [1, 2], [(1, 2)])
    # What is to be replaced is a folder.
    blocked = key_updates_path(tmp_path / "n2.db")
    blocked.with_name(blocked.name + ".new").mkdir()
    base.start()
    two.start()
    assert command(tmp_path, "keys", "rotate", "-d", "mission").returncode == 0
    two.until(lambda: number(two) == 2)
    two.until(lambda: "the new link key is not on disk, only in memory" in two.log())
    sent = create(two, "goes on")
    base.until(lambda: sent in base.listing())
    # After a restart it asks again.
    assert two.signal(signal.SIGKILL) == -signal.SIGKILL
    two.start()
    assert number(two) == 1
    two.until(lambda: number(two) == 2)

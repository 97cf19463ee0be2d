"""Real processes with keys: two drones and a base, and what can be read where."""

from __future__ import annotations

import json
import shutil
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

from rass_mav.trust.keys.files import GROUND_FILE, drone_file, drone_text, ground_text, read_keys, write_over
from rass_mav.trust.keys.identity import Ground

from .app_nodes import RunningNode, Tidy, command, free_ports, line_of

SECRET = b"the source is in the third house"


def on_disk(directory: Path) -> bytes:
    """All bytes of all stores, logs included."""
    return b"".join(path.read_bytes() for path in sorted(directory.glob("n*.db*")))


def test_only_the_ground_reads_what_drones_with_keys_create(tmp_path: Path, tidy: Tidy) -> None:
    mission = tmp_path / "mission"
    assert command(tmp_path, "keys", "new", "mission").returncode == 0
    assert command(tmp_path, "keys", "drone", "2", "3", "-d", "mission").returncode == 0
    nodes = line_of(tmp_path, [1, 2, 3], data={"status_s": 0.3})
    for node in nodes:
        name = GROUND_FILE if node.name == "n1" else drone_file(int(node.name[1:]))
        with (tmp_path / node.config).open("a") as file:
            file.write(f"keys: {{file: {mission / name}}}\n")
            if node.name == "n1":
                file.write("on_arrival: {command: [sh, -c, 'cat >> told.jsonl'], kinds: [file]}\n")
    base, middle, far = (tidy(node).start() for node in nodes)
    photo = SECRET * 200
    (tmp_path / "photo.jpg").write_bytes(photo)

    line_id = command(tmp_path, "put", "-c", "n3.yaml", "--line", SECRET.decode()).stdout.decode().strip()
    photo_id = command(tmp_path, "put", "-c", "n3.yaml", "photo.jpg", "--ttl", "1d").stdout.decode().strip()
    base.until(lambda: {line_id, photo_id} <= set(base.listing()))
    # In the middle of the swarm a drone is killed, and goes on under the same numbers.
    assert far.signal(signal.SIGKILL) == -signal.SIGKILL
    far.start()
    more = [str(far.ask("put", payload=SECRET + b"%d" % number)["id"]) for number in range(5)]
    base.until(lambda: {line_id, photo_id, *more} <= set(base.listing()))
    base.until(lambda: sum(entry.id.origin == 2 for entry in base.listing().values()) > 1)

    assert base.status()["ledger"].get("forged", 0) == 0
    assert "data are sealed" in command(tmp_path, "status", "n3.yaml").stdout.decode()
    assert SECRET[:12] not in on_disk(tmp_path)

    # With the keys that the configuration names, and with those that are given.
    assert command(tmp_path, "get", "-c", "n1.yaml", photo_id).stdout == photo
    for arguments in (["n1.yaml"], ["n1.db", "--keys", "mission/ground.keys"]):
        listed = json.loads(command(tmp_path, "ls", *arguments, "--json").stdout)["data"]
        kinds = {entry["id"]: entry["kind"] for entry in listed}
        assert (kinds[line_id], kinds[photo_id]) == ("bytes", "file")
        assert "status" in kinds.values()
        assert "sealed" not in kinds.values()
    report = json.loads(command(tmp_path, "report", "n1.yaml", "--json").stdout)
    assert {drone["drone"]: drone["status"] is not None for drone in report["drones"]} == {1: True, 2: True, 3: True}
    done = json.loads(command(tmp_path, "export", "n1.yaml", "--format", "files", "-o", "out", "--json").stdout)
    assert (done["data"], done["sealed"]) == (7, 0)
    assert (tmp_path / "out" / f"{photo_id}-photo.jpg").read_bytes() == photo

    told = tmp_path / "told.jsonl"
    base.until(lambda: told.exists() and told.read_bytes().endswith(b"\n"))
    assert json.loads(told.read_text())["name"] == "photo.jpg"

    # Without keys, and with those of a drone.
    listed = json.loads(command(tmp_path, "ls", "n1.db", "--json").stdout)["data"]
    assert {entry["kind"] for entry in listed} == {"sealed"}
    assert {entry["id"]: entry["ttl_s"] for entry in listed if "ttl_s" in entry} == {photo_id: 86400}
    assert command(tmp_path, "get", "-c", "n1.db", photo_id).returncode == 1
    assert command(tmp_path, "ls", "n1.db", "--keys", f"mission/{drone_file(3)}").returncode == 2
    nothing = command(tmp_path, "export", "n1.db", "--format", "csv", "-o", "out.csv")
    assert nothing.returncode == 1
    assert b"sealed" in nothing.stderr
    assert not (tmp_path / "out.csv").exists()
    report = json.loads(command(tmp_path, "report", "n1.db", "--json").stdout)
    assert report["arrived"] >= 7
    for node in (base, middle, far):
        assert node.signal(signal.SIGTERM) == 0
        assert SECRET[:12].decode() not in node.log()


def test_what_another_drone_makes_in_ones_name_does_not_arrive(tmp_path: Path, tidy: Tidy) -> None:
    """Node 3 has the link key of this mission and believes its ground, but the base cannot know its secret."""
    for name in ("mission", "other"):
        assert command(tmp_path, "keys", "new", name).returncode == 0
        assert command(tmp_path, "keys", "drone", "2", "3", "-d", name).returncode == 0
    ground = read_keys(tmp_path / "mission" / GROUND_FILE)
    assert isinstance(ground, Ground)
    # A serial far from those that this ground has assigned.
    write_over(tmp_path / "other" / GROUND_FILE, ground_text(replace(ground, serials={3: 50})))
    write_over(tmp_path / "other" / drone_file(3), drone_text(ground.node(3, 50)))
    nodes = line_of(tmp_path, [1, 2, 3])
    for node, file in zip(nodes, ("mission/ground.keys", "mission/drone-2.keys", "other/drone-3.keys"), strict=True):
        with (tmp_path / node.config).open("a") as config:
            config.write(f"keys: {{file: {tmp_path / file}}}\n")
    base, _, far = (tidy(node).start() for node in nodes)
    id = str(far.ask("put", payload=SECRET)["id"])
    # It is counted when it is taken, and listed when it is on disk.
    base.until(lambda: base.status()["ledger"].get("forged") == 1 and len(base.listing()) == 1)
    assert base.status()["alarms"] == {"unsealed": 1}
    [entry] = json.loads(command(tmp_path, "ls", "n1.yaml", "--json").stdout)["data"]
    assert entry["id"].startswith(id + "#")
    assert entry["malformed"] == "not sealed by the origin that it names, or altered"
    # It was not thrown away: who has the right keys can read it.
    found = command(tmp_path, "get", "-c", "n1.db", entry["id"], "--keys", "other/ground.keys")
    assert found.stdout == SECRET


def test_two_drones_on_copies_of_one_card_begin_new_epochs(tmp_path: Path, tidy: Tidy) -> None:
    assert command(tmp_path, "keys", "new", "mission").returncode == 0
    assert command(tmp_path, "keys", "drone", "2", "-d", "mission").returncode == 0
    ports = free_ports(3)

    def node(place: int, node_id: int, name: str, **sections: Any) -> RunningNode:
        peers = [{"address": f"127.0.0.1:{port}"} for port in ports if port != ports[place]]
        link = {"listen": f"127.0.0.1:{ports[place]}", "peers": peers}
        return tidy(RunningNode(tmp_path, node_id, name, links=[link], **sections))

    base = node(0, 1, "base", node={"role": "base"}, keys={"file": str(tmp_path / "mission" / GROUND_FILE)})
    one, other = (
        node(place, 2, name, keys={"file": str(tmp_path / "mission" / drone_file(2))})
        for place, name in ((1, "one"), (2, "other"))
    )
    base.start()
    before = one.start().about["epoch"]
    one.ask("put", payload=b"from before the card was copied")
    assert one.signal(signal.SIGTERM) == 0
    for path in tmp_path.glob("one.db*"):
        shutil.copy(path, tmp_path / path.name.replace("one", "other"))
    for drone in (one, other):
        assert drone.start().about["epoch"] == before

    def epochs() -> set[str]:
        return {drone.status()["epoch"] for drone in (one, other)}

    # Once before the copy, once after it, and once anew.
    for drone, starts in ((one, 3), (other, 2)):
        drone.until(lambda drone=drone, starts=starts: drone.log().count("node 2 (drone) is running") == starts)  # type: ignore[misc]
    assert len(epochs() | {before}) == 3
    sent = {str(drone.ask("put", payload=drone.name.encode())["id"]) for drone in (one, other)}
    assert len(sent) == 2
    base.until(lambda: sent <= set(base.listing()))
    for drone in (one, other):
        assert drone.log().count("another node runs on a copy of this store; reopening") == 1
        # What is forged later, or true, has no effect any more.
        epoch, steps = drone.status()["epoch"], drone.status()["steps"]
        drone.until(lambda drone=drone, steps=steps: drone.status()["steps"] > steps + 30)  # type: ignore[misc]
        assert drone.status()["epoch"] == epoch

"""Files that are larger than a datum: put in parts, whole at the base, and nothing half put (docs/how-to/files.md)."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from rass_mav.app.payloads import parse_name
from rass_mav.core.datum import Fate
from rass_mav.errors import ControlError
from rass_mav.store.sqlite import SqliteStore
from tests.environment import environment

from .app_nodes import RunningNode, Tidy, command, free_ports, line_of

#: Does not get smaller when it is packed.
PHOTO = random.Random(1).randbytes(300_000)
#: Holds what the tests put, and others' data.
ROOM: dict[str, Any] = {"store": {"capacity_items": 400}}


def put(node: RunningNode, *names: str, json_: bool = True) -> dict[str, Any]:
    said = command(node.directory, "put", "-c", node.config, *names, "--json")
    assert (said.returncode, said.stderr) == (0, b""), said.stderr
    found: dict[str, Any] = json.loads(said.stdout)
    return found


def listed(node: RunningNode) -> list[dict[str, Any]]:
    said = command(node.directory, "ls", node.config, "--json")
    assert (said.returncode, said.stderr) == (0, b""), said.stderr
    found: list[dict[str, Any]] = json.loads(said.stdout)["data"]
    return found


def whole(node: RunningNode) -> list[str]:
    """The names of the files that are whole there."""
    return [e["name"] for e in listed(node) if "parts" in e and e["parts"]["there"] == e["parts"]["of"]]


def spool(node: RunningNode) -> list[str]:
    """What waits beside the store."""
    folder = node.directory / f"{node.name}.db.files"
    return sorted(path.name for path in folder.iterdir()) if folder.exists() else []


def test_a_photo_with_control_characters_in_its_name_is_put_without_them(tmp_path: Path, tidy: Tidy) -> None:
    node = tidy(line_of(tmp_path, [1, 2], **ROOM)[1]).start()
    for name in ("big\x1b[2J.jpg", os.fsdecode(b"\xff.jpg")):
        (tmp_path / name).write_bytes(PHOTO + name.encode(errors="replace"))
        put(node, name)
    node.until(lambda: sorted(whole(node)) == ["_.jpg", "big_[2J.jpg"])


def test_a_photo_arrives_whole_over_two_hops(tmp_path: Path, tidy: Tidy) -> None:
    base, _, far = (tidy(node).start() for node in line_of(tmp_path, [1, 2, 3], **ROOM))
    (tmp_path / "photo.jpg").write_bytes(PHOTO)
    done = put(far, "photo.jpg", "--priority", "7", "--ttl", "3d")
    assert (done["bytes"], done["parts"]) == (len(PHOTO), 10)
    base.until(lambda: whole(base) == ["photo.jpg"])
    said = command(tmp_path, "ls", base.config, "--kind", "part", "--json").stdout
    assert [(part["priority"], part["ttl_s"]) for part in json.loads(said)["data"]] == [(7, 3 * 86400)] * 10
    assert spool(far) == []
    for name in ("photo.jpg", done["id"]):
        assert command(tmp_path, "get", "-c", base.config, name).stdout == PHOTO
    assert command(tmp_path, "export", base.config, "--format", "files", "-o", "out").returncode == 0
    assert (tmp_path / "out" / f"{done['id']}-photo.jpg").read_bytes() == PHOTO
    assert b"file photo.jpg (priority 7, ttl 259200 s) 10 parts" in command(tmp_path, "ls", base.config).stdout
    for node in (base, far):
        assert node.signal(signal.SIGTERM) == 0
        assert "Traceback" not in node.log()


@pytest.mark.no_cover
def test_wait_returns_when_all_has_arrived(tmp_path: Path, tidy: Tidy) -> None:
    base, _, far = (tidy(node).start() for node in line_of(tmp_path, [1, 2, 3], **ROOM))
    (tmp_path / "photo.jpg").write_bytes(PHOTO)
    (tmp_path / "note.txt").write_bytes(b"all well")
    done = put(far, "photo.jpg", "note.txt", "--wait")["put"]
    assert whole(base) == ["photo.jpg"]
    assert {each["id"] for each in done} <= set(base.listing())
    (file,) = far.status()["files"]
    assert (file["name"], file["parts"], file["created"], file["handed_over"], file["arrived"]) == (
        "photo.jpg", 10, 10, 10, 10,
    )  # fmt: skip
    shown = command(tmp_path, "status", far.config).stdout
    assert b"file photo.jpg: [####################] 10 of 10 parts created" in shown
    # At the base itself it has arrived at once.
    said = command(tmp_path, "put", "-c", base.config, "photo.jpg", "--wait")
    assert (said.returncode, said.stderr) == (0, b"")


@pytest.mark.no_cover
def test_a_redundant_file_is_whole_without_some_of_its_data(tmp_path: Path, tidy: Tidy) -> None:
    base, _, far = (tidy(node).start() for node in line_of(tmp_path, [1, 2, 3], **ROOM))
    (tmp_path / "photo.jpg").write_bytes(PHOTO)
    done = put(far, "photo.jpg", "--redundancy", "4/7", "--wait")
    assert done["parts"] == 21
    base.until(lambda: len(base.listing()) == 22)
    shares = json.loads(command(tmp_path, "ls", base.config, "--kind", "part", "--json").stdout)["data"]
    gone = [share["id"] for share in shares if share["part"] % 7 in (0, 2, 5)]
    for node in (base, far):
        assert node.signal(signal.SIGTERM) == 0
    with SqliteStore.open(tmp_path / "n1.db", node_id=1, draw_epoch=lambda: 1) as store:
        for id in gone:
            store.remove(parse_name(id)[0], Fate.DIED)
    (file,) = listed(base)
    assert file["parts"] == {"there": 12, "of": 12}
    assert command(tmp_path, "get", "-c", base.config, "photo.jpg").stdout == PHOTO
    with SqliteStore.open(tmp_path / "n1.db", node_id=1, draw_epoch=lambda: 1) as store:
        store.remove(parse_name(next(s["id"] for s in shares if s["part"] == 3))[0], Fate.DIED)
    (file,) = listed(base)
    assert file["parts"] == {"there": 11, "of": 12}
    assert command(tmp_path, "get", "-c", base.config, "photo.jpg").returncode == 1


def test_waiting_is_in_vain_where_nothing_is_heard(tmp_path: Path, tidy: Tidy) -> None:
    drone = tidy(line_of(tmp_path, [1, 2], policy={"name": "stigmergy"})[1]).start()
    said = command(tmp_path, "put", "-c", drone.config, "--line", "hello", "--wait")
    assert (said.returncode, len(drone.listing())) == (1, 1)
    assert b"cannot tell what has arrived" in said.stderr


def test_a_small_file_stays_one_datum(tmp_path: Path, tidy: Tidy) -> None:
    drone = tidy(line_of(tmp_path, [1, 2])[1]).start()
    (tmp_path / "note.txt").write_bytes(b"all well")
    (tmp_path / "empty").write_bytes(b"")
    found = put(drone, "note.txt", "empty")["put"]
    assert [each["bytes"] for each in found] == [17, 6]
    assert [entry.kind_name for entry in drone.listing().values()] == ["file", "file"]
    assert spool(drone) == []


def test_nothing_is_half_put_beyond_the_quota(tmp_path: Path, tidy: Tidy) -> None:
    drone = tidy(line_of(tmp_path, [1, 2], store={"capacity_items": None, "quota_bytes": 500_000})[1]).start()
    (tmp_path / "photo.jpg").write_bytes(PHOTO)
    (tmp_path / "large.jpg").write_bytes(PHOTO * 2)
    said = command(tmp_path, "put", "-c", drone.config, "large.jpg")
    assert said.returncode == 1
    assert b"large.jpg: quota of 500000 bytes, but " in said.stderr
    assert said.stderr.endswith(b"are needed; nothing was submitted\n")
    assert (drone.listing(), spool(drone)) == ({}, [])
    # What somebody has announced is reserved, and free again when he goes.
    with drone.client() as client:
        client.ask("file", name="a", size=len(PHOTO), digest="0" * 64, packing=0, length=len(PHOTO), time=0.0)
        assert b"waiting to be stored" in command(tmp_path, "put", "-c", drone.config, "photo.jpg").stderr
    drone.until(lambda: spool(drone) == [])
    put(drone, "photo.jpg")
    drone.until(lambda: spool(drone) == [])
    assert len(drone.listing()) == 11
    assert command(tmp_path, "put", "-c", drone.config, "photo.jpg").returncode == 1
    assert len(drone.listing()) == 11


def test_a_put_that_is_killed_leaves_nothing(tmp_path: Path, tidy: Tidy) -> None:
    drone = tidy(line_of(tmp_path, [1, 2], **ROOM)[1]).start()
    with (tmp_path / "large.bin").open("wb") as file:
        # Its beginning is not worth packing, and there is much to read.
        file.write(PHOTO)
        file.truncate(1 << 27)
    arguments = [sys.executable, "-m", "rass_mav", "put", "-c", drone.config, "large.bin"]
    with subprocess.Popen(arguments, cwd=tmp_path, env=environment()) as client:
        drone.until(lambda: any(name.endswith(".new") for name in spool(drone)))
        client.kill()
    drone.until(lambda: spool(drone) == [])
    assert drone.listing() == {}
    assert drone.status()["files"] == []


@pytest.mark.no_cover
def test_a_node_that_is_killed_has_nothing_or_all_of_a_file(tmp_path: Path, tidy: Tidy) -> None:
    # A drone with a small store, whose parts have to wait for a base.
    (port, other) = free_ports(2)
    drone = tidy(
        RunningNode(
            tmp_path, 2, store={"capacity_items": 8},
            links=[{"listen": f"127.0.0.1:{port}", "peers": [{"address": f"127.0.0.1:{other}", "id": 1}]}],
        )
    ).start()  # fmt: skip
    base = tidy(
        RunningNode(
            tmp_path, 1, node={"role": "base"},
            links=[{"listen": f"127.0.0.1:{other}", "peers": [{"address": f"127.0.0.1:{port}", "id": 2}]}],
        )
    )  # fmt: skip
    (tmp_path / "photo.jpg").write_bytes(PHOTO)
    with drone.client() as client:
        client.ask("file", name="a", size=len(PHOTO), digest="0" * 64, packing=0, length=len(PHOTO), time=0.0)
        client.ask("piece", payload=PHOTO[:50_000])
        assert spool(drone) == ["1.new"]
        drone.signal(signal.SIGKILL)
    drone.start()
    assert (drone.listing(), spool(drone)) == ({}, [])

    done = put(drone, "photo.jpg", "--priority", "1")
    drone.until(lambda: len(drone.listing()) == 4)
    (file,) = drone.status()["files"]
    assert (file["id"], file["parts"], file["created"], file["arrived"]) == (done["id"], 10, 3, 0)
    # Half of its store stays free: a measurement would find space.
    assert drone.status()["store"]["items"] == 4
    for _ in range(2):
        assert drone.signal(signal.SIGKILL) == -signal.SIGKILL
        drone.start()
    (file,) = drone.status()["files"]
    assert (file["name"], file["created"]) == ("photo.jpg", 3)
    base.start()
    base.until(lambda: len(base.listing()) > 4)
    drone.signal(signal.SIGKILL)
    drone.start()
    base.until(lambda: whole(base) == ["photo.jpg"])
    assert command(tmp_path, "get", "-c", base.config, "photo.jpg").stdout == PHOTO
    drone.until(lambda: spool(drone) == [])
    parts = json.loads(command(tmp_path, "ls", base.config, "--kind", "part", "--json").stdout)["data"]
    assert sorted(part["part"] for part in parts) == list(range(10)), "none is there twice"
    assert {part["priority"] for part in parts} == {1}


def test_a_spooled_file_that_is_damaged_is_set_aside(tmp_path: Path, tidy: Tidy) -> None:
    drone = tidy(line_of(tmp_path, [1, 2], store={"capacity_items": 4})[1]).start()
    (tmp_path / "photo.jpg").write_bytes(PHOTO)
    put(drone, "photo.jpg")
    drone.until(lambda: len(drone.listing()) == 2)
    drone.signal(signal.SIGKILL)
    path = tmp_path / "n2.db.files" / "1.file"
    path.write_bytes(path.read_bytes()[:-1])
    (tmp_path / "n2.db.files" / "2.file").write_bytes(os.urandom(100))
    drone.start()
    assert spool(drone) == ["1.damaged", "2.damaged"]
    assert "set aside" in drone.log()
    assert drone.signal(signal.SIGTERM) == 0


#: What is wrong in a request, and what the node answers.
REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"digest": "zz" * 32}, "hexadecimal"),
    ({"name": "n" * 300}, "at most 255 bytes"),
    ({"size": 0}, "size"),
    ({"size": 1 << 60}, "size"),
    ({"length": 7}, "not packed"),
    ({"packing": 3}, "packing"),
    ({"needed": 8, "shares": 8}, "more shares"),
    ({"shares": 8}, "more shares"),
]


def test_requests_that_make_no_file_are_refused(tmp_path: Path, tidy: Tidy) -> None:
    drone = tidy(line_of(tmp_path, [1, 2])[1]).start()
    good = {"name": "a", "size": 50_000, "digest": "0" * 64, "packing": 0, "length": 50_000, "time": 0.0}
    for fields, why in REFUSED:
        with drone.client() as client:
            with pytest.raises(ControlError, match=why):
                client.ask("file", **{**good, **fields})
            with pytest.raises(ControlError, match="no file transfer is in progress"):
                client.ask("piece", payload=b"x")
    with drone.client() as client:
        client.ask("file", **good)
        client.ask("piece", payload=bytes(49_999))
        with pytest.raises(ControlError, match="1 bytes missing"):
            client.ask("done")
        client.ask("file", **good)
        with pytest.raises(ControlError, match="longer than stated"):
            client.ask("piece", payload=bytes(50_001))
    assert spool(drone) == []
    assert drone.signal(signal.SIGTERM) == 0

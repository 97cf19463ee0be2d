"""What goes wrong with files that are put: losses, damage, a full store, and a node that ends at any moment."""

from __future__ import annotations

import asyncio
import json
import random
import signal
import subprocess
import sys
from collections.abc import Coroutine
from concurrent.futures import ThreadPoolExecutor
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest

from rass_mav.app.files import MOST_TOLD, Files
from rass_mav.app.payloads import pack_file
from rass_mav.app.spool import Spool
from rass_mav.app.staging import About
from rass_mav.app.track import Track
from rass_mav.core.datum import MAX_PAYLOAD, DatumId, Fate, Kind
from rass_mav.errors import StoreFullError
from rass_mav.ground.archive import Archive
from rass_mav.store.memory import MemoryStore
from rass_mav.wire.file import PLAIN
from tests.environment import environment
from tests.link.loopback import LoopbackHub
from tests.patience import PATIENCE_S

from .app_drivers import HeldExecutor, running, settings
from .app_nodes import RunningNode, Tidy, command, free_ports, line_of

#: Does not get smaller when it is packed.
PHOTO = random.Random(1).randbytes(300_000)
ROOM: dict[str, Any] = {"store": {"capacity_items": 400}}


def data(node: RunningNode, *options: str) -> list[dict[str, Any]]:
    said = command(node.directory, "ls", node.config, "--json", *options)
    assert (said.returncode, said.stderr) == (0, b""), said.stderr
    found: list[dict[str, Any]] = json.loads(said.stdout)["data"]
    return found


def spool(node: RunningNode) -> list[str]:
    folder = node.directory / f"{node.name}.db.files"
    return sorted(path.name for path in folder.iterdir()) if folder.exists() else []


def alone(directory: Path, **sections: Any) -> RunningNode:
    """A drone that hears nobody."""
    (port,) = free_ports(1)
    return RunningNode(
        directory, 2, links=[{"listen": "127.0.0.1:0", "peers": [{"address": f"127.0.0.1:{port}"}]}], **sections
    )


# -- a lifetime --------------------------------------------------------------------------------------------------------


@pytest.mark.no_cover
def test_of_a_file_some_parts_of_which_expire_on_the_way_the_others_stay(tmp_path: Path, tidy: Tidy) -> None:
    base, relay, far = (tidy(node).start() for node in line_of(tmp_path, [1, 2, 3], **ROOM))
    (tmp_path / "film.mp4").write_bytes(PHOTO * 10)
    arguments = [sys.executable, "-m", "rass_mav", "put", "-c", far.config, "film.mp4", "--ttl", "5s", "--wait"]
    with subprocess.Popen(arguments, cwd=tmp_path, env=environment(), stderr=subprocess.PIPE) as put:
        base.until(lambda: len(base.listing()) > 10)
        base.signal(signal.SIGKILL)
        relay.until(lambda: relay.status()["store"]["items"] > 0)
        for node in (relay, far):
            node.until(lambda node=node: node.status()["store"]["items"] == 0 and spool(node) == [])  # type: ignore[misc]
        assert put.poll() is None, "of what the relay has lost it does not know"
        (told,) = far.status()["files"]
        assert (told["lost"] > 0, told["lost"] + told["handed_over"]) == (True, 92)
        base.start()
        _, said = put.communicate(timeout=PATIENCE_S)
    assert put.returncode == 1
    assert b" of 93 data are lost, " in said
    (file,) = data(base)
    there = file["parts"]["there"]
    assert 10 <= there < 92
    assert file["parts"]["of"] == 92
    base.until(lambda: base.status()["ledger"]["reported_lost"] == 92 - there)

    def losses() -> list[Fate]:
        with Archive(tmp_path / "n1.db") as archive:
            return [fate for id, fate in archive.losses() if id.origin == 3]

    # What it knows is on its disk a moment later.
    base.until(lambda: len(losses()) == 92 - there)
    assert set(losses()) == {Fate.EXPIRED}
    said_by_get = command(tmp_path, "get", "-c", base.config, "film.mp4")
    assert (said_by_get.returncode, said_by_get.stdout) == (1, b"")
    assert f"film.mp4: only {there} of 92 parts have arrived".encode() in said_by_get.stderr
    # Arrivals and losses are reported on their own: one may be known before the other.
    expected = {"parts": 92, "created": 92, "handed_over": there, "arrived": there, "lost": 92 - there}
    far.until(lambda: far.status()["files"][0].items() >= expected.items())
    bar = "#" * (20 * there // 92)
    line = f"[{bar:.<20}] 92 of 92 parts created, {there} handed over, {there} arrived, {92 - there} lost"
    assert line in command(tmp_path, "status", far.config).stdout.decode()


# -- several files -----------------------------------------------------------------------------------------------------


def test_of_several_files_one_that_cannot_be_put_stops_no_other(tmp_path: Path, tidy: Tidy) -> None:
    drone = tidy(alone(tmp_path, store={"capacity_items": None, "quota_bytes": 500_000})).start()
    (tmp_path / "photo.jpg").write_bytes(PHOTO)
    (tmp_path / "large.jpg").write_bytes(PHOTO * 2)
    (tmp_path / "note.txt").write_bytes(b"all well")
    names = ("photo.jpg", "large.jpg", "missing.jpg", "note.txt")
    said = command(tmp_path, "put", "-c", drone.config, *names)
    assert said.returncode == 1
    listed = {entry["name"]: entry["id"] for entry in data(drone)}
    assert said.stdout.decode().split() == [listed["photo.jpg"], listed["note.txt"]]
    large, missing = said.stderr.decode().splitlines()
    assert large.startswith("large.jpg: quota of 500000 bytes")
    assert missing == "missing.jpg: no such file or directory"
    again = command(tmp_path, "put", "-c", drone.config, "large.jpg", "note.txt", "--json")
    assert again.returncode == 1
    found = json.loads(again.stdout)
    assert (len(found["put"]), found["error"], again.stderr.decode().splitlines()) == (1, [large], [large])


def test_when_the_node_goes_away_it_is_said_which_files_are_not_put(tmp_path: Path, tidy: Tidy) -> None:
    drone = tidy(alone(tmp_path)).start()
    for name in ("a.txt", "b.txt", "c.txt"):
        (tmp_path / name).write_bytes(b"all well")
    with (tmp_path / "large.bin").open("wb") as file:
        file.write(PHOTO)
        file.truncate(1 << 27)
    arguments = [sys.executable, "-m", "rass_mav", "put", "-c", drone.config, "a.txt", "large.bin", "b.txt", "c.txt"]
    with subprocess.Popen(
        arguments, cwd=tmp_path, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as put:
        drone.until(lambda: any(name.endswith(".new") for name in spool(drone)))
        drone.signal(signal.SIGKILL)
        out, said = put.communicate(timeout=PATIENCE_S)
    assert put.returncode == 1
    assert out.decode().split() == [entry["id"] for entry in data(drone)]
    assert said.splitlines()[1:] == [b"large.bin: not submitted", b"b.txt: not submitted", b"c.txt: not submitted"]


def test_of_many_files_the_node_knows_how_far_each_is(tmp_path: Path, tidy: Tidy) -> None:
    """Also of more than `status` tells, and of those that wait."""
    drone = tidy(alone(tmp_path, store={"capacity_items": 200})).start()
    names = [f"photo-{number}.jpg" for number in range(MOST_TOLD + 6)]
    for number, name in enumerate(names):
        (tmp_path / name).write_bytes(PHOTO[number : number + 40_000])
    done = json.loads(command(tmp_path, "put", "-c", drone.config, *names, "--json").stdout)["put"]
    assert [each["parts"] for each in done] == [2] * len(names)
    told = [file["name"] for file in drone.status()["files"]]
    assert [drone.ask("progress", id=each["id"])["data"] for each in done] == [3] * len(names)
    # The one whose parts are created at present is among them.
    assert len(told) == MOST_TOLD
    assert drone.status()["files"][0]["created"] > 0


@pytest.mark.no_cover
def test_two_files_of_one_name_are_two_and_the_same_file_twice_is_one(tmp_path: Path, tidy: Tidy) -> None:
    ports = free_ports(3)
    peers = [{"address": f"127.0.0.1:{port}", "id": id} for id, port in enumerate(ports, 1)]
    base, one, other = (
        tidy(
            RunningNode(
                tmp_path, id, node={"role": "base" if id == 1 else "drone"}, **ROOM,
                links=[{"listen": peers[id - 1]["address"], "peers": [each for each in peers if each["id"] != id]}],
            )
        ).start()
        for id in (1, 2, 3)
    )  # fmt: skip
    ids = []
    for node, content in ((one, PHOTO), (other, PHOTO[::-1]), (one, PHOTO[1:]), (one, PHOTO)):
        (tmp_path / "photo.jpg").write_bytes(content)
        said = command(tmp_path, "put", "-c", node.config, "photo.jpg", "--wait")
        assert (said.returncode, said.stderr) == (0, b"")
        ids += said.stdout.decode().split()
    assert {entry["id"]: entry["parts"] for entry in data(base)} == {id: {"there": 10, "of": 10} for id in ids}
    for id, content in zip(ids, (PHOTO, PHOTO[::-1], PHOTO[1:], PHOTO), strict=True):
        assert command(tmp_path, "get", "-c", base.config, id).stdout == content
    said = command(tmp_path, "get", "-c", base.config, "photo.jpg")
    assert (said.returncode, said.stdout) == (2, b"")
    assert all(id.encode() in said.stderr for id in ids)
    assert command(tmp_path, "export", base.config, "--format", "files", "-o", "out").returncode == 0
    assert sorted(path.name for path in (tmp_path / "out").glob("*.jpg")) == sorted(f"{id}-photo.jpg" for id in ids)


# -- large data of the format before -----------------------------------------------------------------------------------


@pytest.mark.no_cover
def test_a_file_of_1_mib_in_one_datum_arrives_and_is_read(tmp_path: Path, tidy: Tidy) -> None:
    """As the program before put it: files that are under way in its stores."""
    base, relay, far = (tidy(node).start() for node in line_of(tmp_path, [1, 2, 3], **ROOM))
    content = random.Random(2).randbytes(MAX_PAYLOAD - 1 - len("old.jpg"))
    payload = pack_file("old.jpg", content)
    assert len(payload) == MAX_PAYLOAD
    id = far.ask("put", payload=payload, kind=int(Kind.FILE))["id"]
    (tmp_path / "new.jpg").write_bytes(PHOTO)
    new = command(tmp_path, "put", "-c", far.config, "new.jpg", "--wait")
    assert (new.returncode, new.stderr) == (0, b"")
    base.until(lambda: id in base.listing())
    assert relay.status()["faults"]["count"] == 0
    assert [("parts" in entry, entry["name"]) for entry in sorted(data(base), key=lambda entry: entry["name"])] == [
        (True, "new.jpg"), (False, "old.jpg")
    ]  # fmt: skip
    for name in ("old.jpg", id):
        assert command(tmp_path, "get", "-c", base.config, name).stdout == content
    assert command(tmp_path, "get", "-c", base.config, "old.jpg", "--partial").stdout == content
    assert command(tmp_path, "export", base.config, "--format", "files", "-o", "out").returncode == 0
    assert (tmp_path / "out" / f"{id}-old.jpg").read_bytes() == content


# -- a node that ends --------------------------------------------------------------------------------------------------


@pytest.mark.no_cover
def test_whatever_was_on_the_disk_when_the_node_was_killed_a_file_is_put_once_or_not_at_all(
    tmp_path: Path, tidy: Tidy
) -> None:
    """Each state of the disk is made from the files of the one before."""
    drone = tidy(alone(tmp_path, store={"capacity_items": 8})).start()
    (tmp_path / "photo.jpg").write_bytes(PHOTO)
    folder, store = tmp_path / "n2.db.files", tmp_path / "n2.db"
    assert command(tmp_path, "put", "-c", drone.config, "photo.jpg").returncode == 0
    drone.until(lambda: drone.status()["files"][0]["created"] == 3)
    drone.signal(signal.SIGKILL)
    taken = (folder / "1.file").read_bytes()

    def begin(name: str, content: bytes) -> None:
        """A node without data, and one file in its spool."""
        for path in (*folder.iterdir(), *tmp_path.glob("n2.db*")):
            if path.is_file():
                path.unlink()
        (folder / name).write_bytes(content)
        drone.start()

    for length in (0, 5, 20, 100_000, len(taken)):
        # It was being written.
        begin("1.new", taken[:length])
        assert (drone.listing(), spool(drone), drone.status()["files"]) == ({}, [], [])
        drone.signal(signal.SIGKILL)
    # It had its name, and no manifest yet; and then after each of some ends.
    begin("1.file", taken)
    drone.until(lambda: drone.status()["files"][0]["created"] == 3)
    for _ in range(2):
        drone.signal(signal.SIGKILL)
        drone.start()
        (told,) = drone.status()["files"]
        # What it had created before may have been handed over, and may have arrived: it does not know.
        assert (told["created"], told["handed_over"], told["arrived"]) == (3, 0, 0)
    assert sorted(entry.part.number for entry in drone.listing().values() if entry.part) == [0, 1, 2]
    # All its data were created, and it was not deleted yet.
    drone.signal(signal.SIGKILL)
    config = tmp_path / drone.config
    config.write_text(config.read_text().replace("capacity_items: 8", "capacity_items: 100"))
    drone.start()
    drone.until(lambda: spool(drone) == [])
    before = drone.listing().keys()
    drone.signal(signal.SIGKILL)
    (folder / "1.file").write_bytes(taken)
    drone.start()
    drone.until(lambda: spool(drone) == [])
    assert drone.listing().keys() == before
    assert len(before) == 11
    # The next one has a number of its own.
    assert command(tmp_path, "put", "-c", drone.config, "photo.jpg").returncode == 0
    drone.until(lambda: spool(drone) == [])
    assert len(drone.listing()) == 22
    assert command(tmp_path, "get", "-c", drone.config, "photo.jpg").stdout == PHOTO
    assert store.exists()


# -- damage ------------------------------------------------------------------------------------------------------------


def test_nobody_waits_for_what_is_damaged_before_it_was_created(tmp_path: Path, tidy: Tidy) -> None:
    base, drone = (tidy(node) for node in line_of(tmp_path, [1, 2], store={"capacity_items": 8}))
    drone.start()
    (tmp_path / "photo.jpg").write_bytes(PHOTO)
    arguments = [sys.executable, "-m", "rass_mav", "put", "-c", drone.config, "photo.jpg", "--wait"]
    with subprocess.Popen(arguments, cwd=tmp_path, env=environment(), stderr=subprocess.PIPE) as put:
        drone.until(lambda: [file["created"] for file in drone.status()["files"]] == [3])
        with (tmp_path / "n2.db.files" / "1.file").open("r+b") as file:
            file.truncate(150_000)
        base.start()
        _, said = put.communicate(timeout=PATIENCE_S)
    assert put.returncode == 1
    assert b" of 11 data are lost, " in said
    assert spool(drone) == ["1.damaged"]
    lines = command(tmp_path, "status", drone.config).stdout.decode().splitlines()
    (line,) = (line for line in lines if line.startswith("file photo.jpg: "))
    assert line.endswith(", the others are damaged on the disk")


def test_a_damaged_length_in_the_spool_costs_no_memory(tmp_path: Path) -> None:
    folder = tmp_path / "n2.db.files"
    folder.mkdir()
    with (folder / "1.file").open("wb") as file:
        file.write(b"RASS file 1\n" + b"\xff" * 4)
        file.truncate(1 << 32)
    # The node would read four gigabytes to start.
    found = subprocess.run(
        [sys.executable, "-c", _LOAD, str(folder)], env=environment(), capture_output=True, timeout=PATIENCE_S,
        check=False,
    )  # fmt: skip
    assert (found.returncode, found.stdout) == (0, b"{}\n"), found.stderr
    assert [path.name for path in folder.iterdir()] == ["1.damaged"]


_LOAD = """
import resource, sys
from pathlib import Path
from rass_mav.app.spool import Spool
resource.setrlimit(resource.RLIMIT_AS, (1 << 30, 1 << 30))
print(Spool(Path(sys.argv[1])).waiting)
"""


# -- space -------------------------------------------------------------------------------------------------------------


def test_a_file_that_never_fits_holds_up_no_other_of_a_folder(tmp_path: Path, tidy: Tidy) -> None:
    camera = tmp_path / "camera"
    camera.mkdir()
    (camera / "a-large.jpg").write_bytes(PHOTO)
    drone = tidy(
        alone(
            tmp_path, store={"capacity_items": None, "quota_bytes": 100_000},
            watch={"folder": "camera", "settle_s": 0.2},
        )
    ).start()  # fmt: skip
    drone.until(lambda: drone.status()["watch"]["refused"] == 1)
    (camera / "small.jpg").write_bytes(PHOTO[:50_000])
    drone.until(lambda: drone.status()["watch"]["put"] == 1)
    assert [entry["name"] for entry in data(drone)] == ["small.jpg"]
    assert "a-large.jpg: quota of 100000 bytes" in drone.log()


def about(name: str, content: bytes) -> About:
    return About(name, len(content), 0.0, sha256(content).digest(), PLAIN, len(content))


async def test_no_space_is_promised_twice(tmp_path: Path) -> None:
    with ThreadPoolExecutor(1) as disk:
        async with running(
            LoopbackHub().endpoint("n"),
            MemoryStore(1, quota_bytes=500_000),
            settings(2, capacity_items=None, quota_bytes=500_000),
        ) as driver:
            files = Files(driver, Spool(tmp_path / "spool"), 1 << 15, disk, Track(driver))
            # At the same moment, from two clients.
            found = await asyncio.gather(*(files.begin(about(name, PHOTO)) for name in "ab"), return_exceptions=True)
            refused = [each for each in found if isinstance(each, StoreFullError)]
            drafts = [each for each in found if not isinstance(each, BaseException)]
            assert (len(refused), len(drafts)) == (1, 1)
            # And all of it is free again.
            files.give_up(drafts[0])
            files.give_up(await files.begin(about("c", PHOTO)))


@pytest.mark.parametrize(
    ("items", "set_to", "most"),
    [(20, None, 1 << 15), (1000, None, 1 << 15), (5, None, 1 << 13), (1, None, 1 << 12), (1, 1 << 16, 1 << 16)],
)
async def test_on_a_slow_link_parts_are_small_unless_their_size_is_set(
    items: int, set_to: int | None, most: int, tmp_path: Path
) -> None:
    photo = bytes(range(256)) * 4096
    with ThreadPoolExecutor(1) as disk:
        async with running(LoopbackHub().endpoint("n"), MemoryStore(1), settings(2)) as driver:
            driver.agent.node.pace.items = items
            files = Files(driver, Spool(tmp_path / "spool"), set_to, disk, Track(driver))
            draft = await files.begin(about("a", photo))
            assert draft.manifest.cut.part_bytes == most
            files.give_up(draft)


async def test_a_file_whose_manifest_is_created_is_put_whatever_becomes_of_the_next(tmp_path: Path) -> None:
    """Two that are complete at the same moment, and space for one datum."""
    disk = HeldExecutor()

    async def writing() -> None:
        while True:
            await disk.arrived.wait()
            disk.arrived.clear()
            while disk.submitted:
                disk.release()

    async def while_writing(*work: Coroutine[Any, Any, Any]) -> list[Any]:
        writer = asyncio.ensure_future(writing())
        done = await asyncio.wait_for(asyncio.gather(*work, return_exceptions=True), PATIENCE_S)
        writer.cancel()
        return done

    async with running(LoopbackHub().endpoint("n"), MemoryStore(1), settings(2, capacity_items=1)) as driver:
        spool = Spool(tmp_path / "spool")
        files = Files(driver, spool, 1 << 15, disk, Track(driver))
        drafts = await while_writing(*(files.begin(about(name, PHOTO)) for name in "ab"))
        await while_writing(*(files.write(draft, PHOTO) for draft in drafts))
        first, second = await while_writing(*(files.finish(draft) for draft in drafts))
        assert isinstance(first, DatumId)
        assert isinstance(second, StoreFullError)
        assert [spooled.manifest.name for spooled in spool.waiting.values()] == ["a"]
        assert [info.id for info in driver.agent.store.held()] == [first]
    assert sorted(path.name for path in (tmp_path / "spool").iterdir()) == ["1.file"]

"""A watched folder: what is complete is put once, with the place and the time that the camera said."""

from __future__ import annotations

import json
import os
import random
import signal
import socket
from pathlib import Path
from typing import Any

import pytest

from rass_mav.errors import MalformedError
from rass_mav.ground.archive import Archive
from rass_mav.ground.entry import Entry
from rass_mav.lab.swarm.autopilot import autopilot_heartbeat
from rass_mav.mavlink.camera import read_capture
from rass_mav.mavlink.dialect import common
from rass_mav.mavlink.frames import Frame, FrameWriter
from tests.telemetry import global_position_int

from .app_nodes import RunningNode, Tidy, command, free_ports

PHOTO = random.Random(1).randbytes(100_000)


def watching(directory: Path, **sections: Any) -> RunningNode:
    """A drone alone that watches the folder `camera`."""
    (port,) = free_ports(1)
    sections = {"store": {"capacity_items": 100}, **sections}
    return RunningNode(
        directory, 7, links=[{"listen": "127.0.0.1:0", "peers": [{"address": f"127.0.0.1:{port}"}]}],
        watch={"folder": "camera", "settle_s": 0.2}, **sections,
    )  # fmt: skip


def files(node: RunningNode) -> dict[str, Entry]:
    """The files in its store, by name."""
    with Archive(node.directory / f"{node.name}.db") as archive:
        return {entry.file: entry for entry in archive.entries(parts=False) if entry.file is not None}


def watch(node: RunningNode) -> dict[str, Any]:
    found: dict[str, Any] = node.status()["watch"]
    return found


@pytest.mark.processes_measured
def test_what_is_complete_is_put_once_over_restarts(tmp_path: Path, tidy: Tidy) -> None:
    camera = tmp_path / "camera"
    camera.mkdir()
    (camera / "photo-1.jpg").write_bytes(PHOTO)
    (camera / "note.txt").write_bytes(b"all well")
    for unfinished in (".hidden", "photo-2.jpg.part", "photo-3.TMP", "photo~"):
        (camera / unfinished).write_bytes(PHOTO)
    drone = tidy(watching(tmp_path)).start()
    drone.until(lambda: set(files(drone)) == {"photo-1.jpg", "note.txt"})
    drone.until(lambda: watch(drone)["put"] == 2)
    first = files(drone)
    for end in (signal.SIGTERM, signal.SIGKILL):
        drone.signal(end)
        drone.start()
        (camera / f"after-{end}.jpg").write_bytes(PHOTO[:50_000] + bytes([end]))
        drone.until(lambda end=end: f"after-{end}.jpg" in files(drone))  # type: ignore[misc]
    assert {name: files(drone)[name].id for name in first} == {name: entry.id for name, entry in first.items()}
    assert len(files(drone)) == 4
    # One that is written anew under its name is another file.
    (camera / "note.txt").write_bytes(b"no more")
    drone.until(lambda: files(drone)["note.txt"].id != first["note.txt"].id)
    assert f"folder {camera}: " in command(tmp_path, "status", drone.config).stdout.decode()


@pytest.mark.processes_measured
def test_nothing_leads_out_of_the_folder_and_nothing_ends_the_node(tmp_path: Path, tidy: Tidy) -> None:
    camera = tmp_path / "camera"
    (camera / "sub").mkdir(parents=True)
    (camera / "sub" / "inner.txt").write_bytes(b"inner")
    (tmp_path / "secret").write_bytes(PHOTO)
    (camera / "link.jpg").symlink_to(tmp_path / "secret")
    (camera / "dangling").symlink_to(tmp_path / "nothing")
    os.mkfifo(camera / "pipe")
    (camera / ("n" * 255)).write_bytes(b"a long name")
    Path(os.fsdecode(os.fsencode(camera) + b"/\xff\xfe.bin")).write_bytes(b"no UTF-8")
    (camera / "closed.txt").write_bytes(b"closed")
    (camera / "closed.txt").chmod(0)
    (camera / "good.txt").write_bytes(b"good")
    drone = tidy(watching(tmp_path)).start()
    drone.until(lambda: "good.txt" in files(drone))
    drone.until(lambda: watch(drone)["waiting"] == 0)
    allowed = {"good.txt", "n" * 255, "??.bin"} | ({"closed.txt"} if os.geteuid() == 0 else set())
    assert set(files(drone)) == allowed
    assert drone.signal(signal.SIGTERM) == 0


def test_a_folder_that_goes_away_is_no_end(tmp_path: Path, tidy: Tidy) -> None:
    drone = tidy(watching(tmp_path)).start()
    drone.until(lambda: "no such file" in (watch(drone)["trouble"] or ""))
    assert f"WARNING: folder {tmp_path / 'camera'}" in command(tmp_path, "status", drone.config).stdout.decode()


def test_a_full_store_is_waited_for_and_said(tmp_path: Path, tidy: Tidy) -> None:
    camera = tmp_path / "camera"
    camera.mkdir()
    drone = tidy(watching(tmp_path, store={"capacity_items": None, "quota_bytes": 150_000})).start()
    (camera / "photo.jpg").write_bytes(PHOTO)
    drone.until(lambda: watch(drone)["put"] == 1)
    (camera / "second.jpg").write_bytes(PHOTO)
    drone.until(lambda: "more do not fit" in (watch(drone)["trouble"] or ""))
    assert watch(drone)["waiting"] == 1
    assert set(files(drone)) == {"photo.jpg"}
    drone.until(lambda: not list((tmp_path / "n7.db.files").glob("*")))


def test_a_file_that_grows_waits_until_it_is_complete(tmp_path: Path, tidy: Tidy) -> None:
    camera = tmp_path / "camera"
    camera.mkdir()
    drone = tidy(watching(tmp_path)).start()
    with (camera / "log.bin").open("wb", buffering=0) as log:
        for number in range(10):
            log.write(PHOTO[number * 10_000 : (number + 1) * 10_000])
            seen = drone.status()["steps"]
            drone.until(lambda seen=seen: drone.status()["steps"] > seen + 1)  # type: ignore[misc]
    drone.until(lambda: "log.bin" in files(drone) and files(drone)["log.bin"].size == len(PHOTO))


def captured(url: str, *, lat: int = 473_769_000, result: int = 1, time_us: int = 1_795_341_600_000_000) -> Any:
    return common.MAVLink_camera_image_captured_message(
        1000, time_us, 0, lat, 85_417_000 if lat else 0, 412_500, 50_000, [1, 0, 0, 0], 17, result, url.encode()
    )


@pytest.mark.processes_measured
def test_the_camera_says_where_and_when(tmp_path: Path, tidy: Tidy) -> None:
    camera = tmp_path / "camera"
    camera.mkdir()
    (port,) = free_ports(1)
    drone = tidy(
        watching(tmp_path, autopilot={"url": f"udpin:127.0.0.1:{port}", "messages": {}})
    ).start()  # fmt: skip
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as autopilot:
        own, lens, other = FrameWriter(42, 1), FrameWriter(42, 100), FrameWriter(43, 100)

        def fly() -> bool:
            for writer, message in (
                (own, autopilot_heartbeat()),
                (own, global_position_int(48.0, 2.0, 100.0, relative_altitude=30.0, boot_ms=1000)),
                (lens, captured("mavlinkftp:///DCIM/photo-17.jpg")),
                # A neighbour's camera counts its pictures too.
                (other, captured("/DCIM/photo-18.jpg", lat=10_000_000)),
            ):
                autopilot.sendto(writer.message(message), ("127.0.0.1", port))
            return drone.status()["position"] is not None

        drone.until(fly)
        for name in ("photo-17.jpg", "photo-18.jpg"):
            (camera / name).write_bytes(PHOTO + name.encode())
        (camera / "small.jpg").write_bytes(b"small")
        drone.until(lambda: fly() and len(files(drone)) == 3)
    found = files(drone)
    told = {name: entry.manifest for name, entry in found.items()}
    first, second, small = told["photo-17.jpg"], told["photo-18.jpg"], told["small.jpg"]
    assert first is not None
    assert second is not None
    assert (first.place, first.time) == ((47.3769, 8.5417, 412.5), 1_795_341_600.0)
    # The drone's own place, and the file's date; a small file gets a manifest for that.
    assert second.place == (48.0, 2.0, 100.0)
    assert second.time == pytest.approx((camera / "photo-18.jpg").stat().st_mtime, abs=0.001)
    assert small is not None
    assert small.place == (48.0, 2.0, 100.0)
    listed = json.loads(command(tmp_path, "ls", drone.config, "--box", "47,8,48,9", "--json").stdout)["data"]
    assert [entry["name"] for entry in listed] == ["photo-17.jpg"]


def test_what_a_camera_says_is_read_or_malformed() -> None:
    def frame(message: Any) -> Frame:
        writer = FrameWriter(1, 100)
        from rass_mav.mavlink.frames import FrameReader

        (read,) = FrameReader().datagram(writer.message(message))
        return read

    good = read_capture(frame(captured("C:\\DCIM\\a b.jpg")))
    assert (good.name, good.place, good.time) == ("a b.jpg", (47.3769, 8.5417, 412.5), 1_795_341_600.0)
    unplaced = read_capture(frame(captured("x.jpg", lat=0, time_us=0)))
    assert (unplaced.place, unplaced.time) == (None, None)
    for bad in (captured("x.jpg", result=0), captured(""), captured("/DCIM/")):
        with pytest.raises(MalformedError):
            read_capture(frame(bad))

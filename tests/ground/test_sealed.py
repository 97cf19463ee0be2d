"""Stores with sealed data: with the ground's keys they read like any others, and without them they tell little."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from rass_mav.cli import main
from rass_mav.core.datum import DatumId, Kind
from rass_mav.errors import StoreError
from rass_mav.ground.archive import HEAD_BYTES, Archive, opener_of
from rass_mav.ground.report import Report
from rass_mav.trust.keys.files import drone_text, ground_text, write_new
from rass_mav.wire.nodestatus import NodeStatus, encode_status
from tests.commands import json_output, output
from tests.some import some

from .missions import EPOCH, HERE, Base
from .sealed_data import GROUND, OPENS, PHOTO, sealed

Capture = pytest.CaptureFixture[str]

STATUS = NodeStatus(5, 2, 1, 9, 0.25, 1, 80, (47.0, 8.0), {}, {}, base=False, next_hop=None)


@pytest.fixture
def base(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Base]:
    """Three sealed data, one that nobody has sealed, and a forged one beside."""
    monkeypatch.chdir(tmp_path)
    write_new(tmp_path / "ground.keys", ground_text(GROUND))
    write_new(tmp_path / "drone-7.keys", drone_text(GROUND.node(7, 1)))
    base = Base(tmp_path / "rass-1.db")
    forged = sealed(base.measurement(7, 0, HERE._replace(reading=99.0)), by=8)
    assert base.store.keep_apart(forged)
    base.arrive(
        sealed(base.measurement(7, 0, HERE, age_s=20.0)),
        sealed(base.file(7, 1, "photo.jpg", PHOTO)),
        sealed(base.datum(7, 2, Kind.STATUS, encode_status(STATUS))),
        base.datum(8, 0, Kind.BYTES, b"open"),
    )
    yield base
    base.close()


def run(capsys: Capture, *words: str, code: int = 0) -> str:
    printed = output(capsys, *words, code=code)
    return printed.err if code else printed.out


def plain(capsys: Capture, *words: str) -> Any:
    return json_output(capsys, *words)


def configure(tmp_path: Path, keys: str, role: str = "base", node_id: int = 1) -> str:
    link = "links: [{listen: '127.0.0.1:0', peers: [{address: '127.0.0.1:9'}]}]\n"
    (tmp_path / "n.yaml").write_text(
        f"node: {{id: {node_id}, role: {role}}}\n{link}store: {{path: rass-1.db}}\nkeys: {{file: {keys}}}\n"
    )
    return "n.yaml"


def test_without_keys_a_list_tells_id_time_and_size(base: Base, capsys: Capture) -> None:
    data = plain(capsys, "ls")["data"]
    assert [(entry["id"], entry["kind"], entry["size"]) for entry in data] == [
        (f"7-{EPOCH:08x}-0", "sealed", 23 + 16),
        (f"7-{EPOCH:08x}-1", "sealed", len(PHOTO) + 10 + 16),
        (f"7-{EPOCH:08x}-2", "sealed", len(encode_status(STATUS)) + 16),
        (f"8-{EPOCH:08x}-0", "bytes", 4),
        (data[4]["id"], "sealed", 23 + 16),
    ]
    assert all("utc" in entry and not {"measurement", "status", "name", "malformed"} & set(entry) for entry in data)
    assert data[4]["apart"]
    assert [line.split()[-1] for line in run(capsys, "ls", "--kind", "sealed").splitlines()[1:]] == ["sealed"] * 4


def test_a_report_names_what_it_cannot_open(base: Base, capsys: Capture) -> None:
    remark = "3 data are sealed, so their readings and places are not shown: give the ground's keys with --keys."
    assert remark in run(capsys, "report").splitlines()
    assert plain(capsys, "report")["off_map"][0] == remark
    assert "sealed" not in run(capsys, "report", "--keys", "ground.keys")


@pytest.mark.parametrize("way", ["--keys", "configuration"])
def test_with_keys_they_read_like_open_data(base: Base, tmp_path: Path, capsys: Capture, way: str) -> None:
    words = ["--keys", "ground.keys"] if way == "--keys" else [configure(tmp_path, "ground.keys")]
    measured, photo, status, line, forged = plain(capsys, "ls", *words)["data"]
    assert (measured["kind"], measured["size"]) == ("measurement", 23)
    assert measured["measurement"]["reading"] == pytest.approx(HERE.reading)
    assert (photo["kind"], photo["name"], photo["size"]) == ("file", "photo.jpg", len(PHOTO) + 10)
    assert (status["kind"], status["status"]["held"]) == ("status", 5)
    assert line["kind"] == "bytes"
    assert (forged["kind"], forged["malformed"]) == ("sealed", "not sealed by the origin that it names, or altered")
    assert len(plain(capsys, "ls", *words, "--above", "0.1")["data"]) == 1


def test_get(base: Base, tmp_path: Path, capsys: Capture) -> None:
    id, forged = f"7-{EPOCH:08x}-1", f"7-{EPOCH:08x}-0#{next(iter(base.store.apart())).crc:08x}"
    error = run(capsys, "get", id, code=1)
    assert error == f"{id}: sealed; give the ground's keys with --keys\n"
    run(capsys, "get", id, "--keys", "ground.keys", "-o", "copy.jpg")
    assert (tmp_path / "copy.jpg").read_bytes() == PHOTO
    assert "not sealed by the origin" in run(capsys, "get", forged, "--keys", "ground.keys", code=1)


@pytest.mark.parametrize(
    ("format", "opened", "closed"),
    [
        ("csv", (4, 0, 1), (1, 0, 4)),
        ("geojson", (1, 3, 1), None),
        ("gpkg", (4, 0, 1), (1, 0, 4)),
        ("files", (2, 2, 1), (1, 0, 4)),
        ("bgeigie", (1, 3, 1), None),
    ],
)
def test_an_export_leaves_out_what_stays_sealed_and_counts_it(
    base: Base, capsys: Capture, tmp_path: Path, format: str, opened: tuple[int, ...], closed: tuple[int, ...] | None
) -> None:
    for name, keys, counts in (("a", ["--keys", "ground.keys"], opened), ("b", [], closed)):
        if counts is None:
            said = run(capsys, "export", "--format", format, "-o", name, code=1)
            assert said.startswith(f"{name}: nothing to export, so it was not created: 4: sealed: --keys opens them; ")
            continue
        done = plain(capsys, "export", "--format", format, "-o", name, *keys)
        assert (done["data"], done["left_out"], done["sealed"]) == counts
    if format == "files":
        assert (tmp_path / "a" / f"7-{EPOCH:08x}-1-photo.jpg").read_bytes() == PHOTO
    said = run(capsys, "export", "--format", "csv", "-o", "c")
    assert said.endswith("c: 1 data; 4 left out: 4: sealed: --keys opens them\n")


def test_report(base: Base, capsys: Capture, tmp_path: Path) -> None:
    drone, _ = plain(capsys, "report", "--keys", "ground.keys")["drones"]
    assert (drone["arrived"], drone["kinds"]) == (3, {"measurement": 1, "file": 1, "status": 1})
    assert (drone["highest"]["reading"], drone["status"]["held"]) == (pytest.approx(HERE.reading), 5)
    drone, _ = plain(capsys, "report")["drones"]
    assert (drone["arrived"], drone["kinds"], drone["highest"], drone["status"]) == (3, {"sealed": 3}, None, None)
    run(capsys, "report", "--keys", "ground.keys", "--html", "report.html")
    assert "0.142" in (tmp_path / "report.html").read_text()


def test_keys_that_cannot_be_used(base: Base, tmp_path: Path, capsys: Capture) -> None:
    error = run(capsys, "ls", "--keys", "drone-7.keys", code=2)
    assert error == "drone-7.keys: holds the keys of drone 7; use the mission's ground.keys\n"
    # The list does not depend on the keys that a configuration names: another user may not read them.
    (tmp_path / "ground.keys").chmod(0o644)
    assert main(["ls", configure(tmp_path, "ground.keys"), "--json"]) == 0
    said = capsys.readouterr()
    assert json.loads(said.out)["data"][0]["kind"] == "sealed"
    assert "ground.keys: accessible to other users" in said.err
    # A drone can open nothing, and says nothing of it.
    assert main(["ls", configure(tmp_path, "drone-7.keys", "drone", 7), "--json"]) == 0
    said = capsys.readouterr()
    assert (json.loads(said.out)["data"][0]["kind"], said.err) == ("sealed", "")


def test_a_copy_that_is_damaged_is_not_opened(base: Base) -> None:
    small, large = DatumId(7, EPOCH, 0), DatumId(7, EPOCH, 1)
    for id in (small, large):
        datum = some(base.store.get(id))
        base.arrive(datum._replace(payload=datum.payload[:-1] + bytes([datum.payload[-1] ^ 1])))
    with Archive(base.path, opens=OPENS) as archive:
        found = {entry.id: entry for entry in archive.entries() if not entry.apart}
        assert found[small].malformed == "corrupt, its checksum does not match"
        assert found[large].size > HEAD_BYTES
        assert found[large].malformed == "not sealed by the origin that it names, or altered"
        for id in (small, large):
            with pytest.raises(StoreError):
                archive.payload(str(id))


def test_the_report_of_a_large_mission_opens_each_datum_once(base: Base) -> None:
    calls = []

    def opens(id: DatumId, kind: int, payload: bytes, beside: bytes) -> bytes:
        calls.append(id)
        return opener_of("ground.keys")(id, kind, payload, beside)

    with Archive(base.path, opens=opens) as archive:
        Report.of(archive)
    assert len(calls) == 4

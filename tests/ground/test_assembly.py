"""Files that came in parts, in the stores of bases: whole, in part, without their manifest, and forged ones."""

from __future__ import annotations

import json
import tracemalloc
from hashlib import sha256
from pathlib import Path

import pytest

from rass_mav.app.payloads import pack_file
from rass_mav.cli import main
from rass_mav.core.datum import Kind
from rass_mav.ground.archive import Archive
from rass_mav.ground.assembly import Groups
from rass_mav.wire.file import (
    MOST_FILE,
    PLAIN,
    ZLIB,
    Manifest,
    Part,
    cut_file,
    encode_manifest,
    encode_part,
)

from .cut_files import HERE, PHOTO, cut_of, data_of, got, store
from .mission_stores import put
from .sealed_data import OPENS, sealed

Capture = pytest.CaptureFixture[str]


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def listed(capsys: Capture, *options: str) -> list[str]:
    assert main(["ls", "rass-1.db", *options]) == 0
    return capsys.readouterr().out.splitlines()[1:]


@pytest.mark.parametrize("packing", [PLAIN, ZLIB])
def test_a_whole_file_is_listed_once_and_comes_back(packing: int, capsysbinary: pytest.CaptureFixture[bytes]) -> None:
    content = PHOTO if packing == PLAIN else b"a line of a log\n" * 90_000
    store(data_of("f.bin", content, packing=packing))
    assert got(capsysbinary, "f.bin") == (0, content, "")
    assert got(capsysbinary, "7-0123abcd-0") == (0, content, "")
    assert main(["ls", "rass-1.db", "--json"]) == 0
    (found,) = json.loads(capsysbinary.readouterr().out)["data"]
    assert (found["kind"], found["name"], found["size"]) == ("file", "f.bin", len(content))
    assert found["sha256"] == sha256(content).hexdigest()
    assert found["parts"]["there"] == found["parts"]["of"]
    assert (found["place"], found["time"]) == (list(HERE), 1_795_341_600.0)


def test_of_a_file_in_part_the_beginning_is_given_on_demand(capsysbinary: pytest.CaptureFixture[bytes]) -> None:
    manifest, *parts = data_of("photo.jpg", PHOTO)
    store([manifest], parts[:3], parts[5:])
    assert main(["ls", "rass-1.db"]) == 0
    assert b"file photo.jpg 5 of 7 parts" in capsysbinary.readouterr().out
    code, out, err = got(capsysbinary, "photo.jpg")
    assert (code, out) == (1, b"")
    assert "photo.jpg: 5 of 7 parts are here; --partial gives its beginning" in err
    code, out, err = got(capsysbinary, "photo.jpg", "--partial")
    assert (code, len(out), "5 of 7" in err) == (0, 3 * 14_286, True)
    assert PHOTO.startswith(out)
    assert main(["export", "rass-1.db", "--format", "files", "-o", "out", "--json"]) == 1
    (line,) = json.loads(capsysbinary.readouterr().out)["error"]
    assert "nothing to export, so it was not created: 1 not whole, or corrupt" in line


def test_the_beginning_of_a_packed_file_is_unpacked(capsysbinary: pytest.CaptureFixture[bytes]) -> None:
    content = b"".join(b"%d lines\n" % number for number in range(40_000))
    manifest, *parts = data_of("log.txt", content, packing=ZLIB, most=1 << 13)
    store([manifest], parts[:-1])
    code, out, _ = got(capsysbinary, "log.txt", "--partial")
    assert code == 0
    assert len(content) > len(out) > len(content) // 2
    assert content.startswith(out)


def test_a_file_without_its_manifest_is_listed_and_comes_back(capsysbinary: pytest.CaptureFixture[bytes]) -> None:
    _, *parts = data_of("photo.jpg", PHOTO)
    store(parts)
    assert main(["ls", "rass-1.db"]) == 0
    line = capsysbinary.readouterr().out.decode().splitlines()[-1]
    name = line.split()[0]
    assert name.startswith("file-")
    assert line.endswith("file of drone 7 without its manifest 7 parts")
    assert got(capsysbinary, name) == (0, PHOTO, "")
    assert main(["ls", "rass-1.db", "--json"]) == 0
    (found,) = json.loads(capsysbinary.readouterr().out)["without_manifest"]
    assert found == {"name": name, "drone": 7, "parts": {"there": 7, "of": 7}}


def test_contents_that_do_not_fit_the_sha_256_are_not_given(capsysbinary: pytest.CaptureFixture[bytes]) -> None:
    manifest, *parts = data_of("photo.jpg", PHOTO)
    cut = cut_of(PHOTO)
    forged = put(3, Kind.PART, encode_part(Part(cut, 2, bytes(cut.size(2)))))
    store([manifest], parts[:2], [forged], parts[3:])
    code, out, err = got(capsysbinary, "photo.jpg")
    assert (code, out) == (1, b"")
    assert "not the file that was put, its SHA-256 does not match" in err
    assert main(["export", "rass-1.db", "--format", "files", "-o", "out", "--json"]) == 1
    (line,) = json.loads(capsysbinary.readouterr().out)["error"]
    assert "nothing to export, so it was not created: 1 not whole, or corrupt" in line


def test_parts_that_contradict_each_other_are_named(capsysbinary: pytest.CaptureFixture[bytes]) -> None:
    manifest, *parts = data_of("photo.jpg", PHOTO)
    cut = cut_of(PHOTO)
    forged = put(99, Kind.PART, encode_part(Part(cut, 2, bytes(cut.size(2)))))
    store([manifest], [forged], parts)
    code, _, err = got(capsysbinary, "photo.jpg")
    assert code == 1
    assert "7-0123abcd-3 contradict other parts" in err


def test_a_part_that_came_twice_contradicts_nothing(capsysbinary: pytest.CaptureFixture[bytes]) -> None:
    manifest, *parts = data_of("photo.jpg", PHOTO)
    again = [put(50 + n, Kind.PART, part.payload) for n, part in enumerate(parts)]
    store([manifest], parts, again)
    assert got(capsysbinary, "photo.jpg") == (0, PHOTO, "")


def test_parts_of_another_drone_do_not_count(capsys: Capture) -> None:
    manifest = data_of("photo.jpg", PHOTO)[0]
    store([manifest], data_of("photo.jpg", PHOTO, drone=8)[1:])
    assert any(line.endswith("file photo.jpg 0 of 7 parts") for line in listed(capsys))


def test_two_files_of_one_name_are_told_apart(capsysbinary: pytest.CaptureFixture[bytes]) -> None:
    store(data_of("photo.jpg", PHOTO), data_of("photo.jpg", PHOTO[::-1], 20))
    code, _, err = got(capsysbinary, "photo.jpg")
    assert code == 2
    assert "several files have this name: 7-0123abcd-0, 7-0123abcd-20" in err
    assert got(capsysbinary, "7-0123abcd-20") == (0, PHOTO[::-1], "")


def test_a_file_that_was_put_twice_is_one(capsysbinary: pytest.CaptureFixture[bytes]) -> None:
    store(data_of("photo.jpg", PHOTO)[:4], data_of("photo.jpg", PHOTO, 20)[4:])
    # What one put lacks is among the parts of the other.
    assert got(capsysbinary, "photo.jpg") == (0, PHOTO, "")


def test_large_data_of_the_format_before_stay_readable(capsysbinary: pytest.CaptureFixture[bytes]) -> None:
    store([put(0, Kind.FILE, pack_file("old.jpg", PHOTO * 9))])
    for name in ("old.jpg", "7-0123abcd-0"):
        assert got(capsysbinary, name) == (0, PHOTO * 9, "")
    assert main(["export", "rass-1.db", "--format", "files", "-o", "out"]) == 0
    assert Path("out/7-0123abcd-0-old.jpg").read_bytes() == PHOTO * 9


def test_forged_counts_cost_no_memory(capsysbinary: pytest.CaptureFixture[bytes]) -> None:
    digest = bytes(32)
    huge = cut_file(MOST_FILE, MOST_FILE, digest, PLAIN, 1 << 16)
    packed = cut_file(1000, 1 << 40, digest, ZLIB, 1 << 16)
    data = []
    for n, cut in enumerate((huge, packed)):
        size = MOST_FILE if cut.packing == PLAIN else 1000
        manifest = Manifest(cut, f"huge{n}", size, digest)
        data.append(put(10 * n, Kind.MANIFEST, encode_manifest(manifest)))
        data.append(put(10 * n + 1, Kind.PART, encode_part(Part(cut, cut.end - 1, bytes(cut.size(cut.end - 1))))))
        data.append(put(10 * n + 2, Kind.PART, encode_part(Part(cut, 0, bytes(cut.size(0))))))
    store(data)
    tracemalloc.start()
    assert main(["ls", "rass-1.db", "--json"]) == 0
    for n in range(2):
        assert got(capsysbinary, f"huge{n}")[0] == 1
        assert len(got(capsysbinary, f"huge{n}", "--partial")[1]) <= 1 << 16
    assert tracemalloc.get_traced_memory()[1] < 8 << 20
    tracemalloc.stop()


def test_sealed_files_are_put_together_with_the_keys_only(capsys: Capture) -> None:
    data = [sealed(datum) for datum in data_of("photo.jpg", PHOTO)]
    path = store(data)
    lines = listed(capsys)
    assert len(lines) == 8
    assert all(line.endswith(" sealed") for line in lines)
    with Archive(path, opens=OPENS) as archive:
        groups = Groups.of(archive)
        (manifest,) = archive.entries(parts=False)
        assert groups.parts_of(manifest).extent == (7, 7)
        assert b"".join(groups.parts_of(manifest).stored(archive.payload)) == PHOTO


def test_a_malformed_part_is_listed_with_what_is_wrong(capsys: Capture) -> None:
    manifest, *parts = data_of("photo.jpg", PHOTO)
    store([manifest], parts[:-1], [put(60, Kind.PART, b"\1short")])
    assert any("part, truncated cut of a file" in line for line in listed(capsys))
    assert len(listed(capsys, "--kind", "part")) == 7


def test_parts_are_listed_singly_on_demand(capsys: Capture) -> None:
    store(data_of("photo.jpg", PHOTO))
    lines = listed(capsys, "--kind", "part")
    assert len(lines) == 7
    assert "part 0 of file-" in lines[0]


def test_files_are_on_the_map(capsys: Capture) -> None:
    store(data_of("photo.jpg", PHOTO))
    capsys.readouterr()
    assert main(["export", "rass-1.db", "-o", "m.geojson"]) == 0
    (feature,) = json.loads(Path("m.geojson").read_text())["features"]
    assert feature["geometry"]["coordinates"] == pytest.approx([8.5417, 47.3769, 412.5])
    assert feature["properties"]["file"] == "photo.jpg"
    assert main(["export", "rass-1.db", "-o", "m.kml"]) == 0
    assert "8.5417000,47.3769000,412.500" in Path("m.kml").read_text()
    box = listed(capsys, "--box", "47,8,48,9")
    assert any("photo.jpg" in line for line in box)

"""Files that came in parts, in the stores of bases: whole, in part, without their manifest, and with forged parts: the
true file is found where it is there, and nothing else is given in its name."""

from __future__ import annotations

import json
import tracemalloc
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest

from rass_mav.app.payloads import pack_file
from rass_mav.cli import main
from rass_mav.core.datum import Datum, Kind
from rass_mav.ground.archive import Archive
from rass_mav.ground.assembly import Groups
from rass_mav.wire.file import MOST_FILE, PLAIN, ZLIB, Cut, Manifest, cut_file, encode_manifest
from tests.app.app_nodes import said_by
from tests.commands import json_output, output

from .cut_files import HERE, PHOTO, cut_of, data_of, got, manifest_of, part, store
from .mission_stores import HOSTILE, put
from .sealed_data import OPENS, sealed

Capture = pytest.CaptureFixture[str]
CaptureBytes = pytest.CaptureFixture[bytes]
LOG = b"a line of a log\n" * 20_000


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def listed(capture: CaptureBytes) -> Any:
    return json_output(capture, "ls", "rass-1.db")


def lines(capsys: Capture, *options: str) -> list[str]:
    return output(capsys, "ls", "rass-1.db", *options).out.splitlines()[1:]


@pytest.mark.parametrize("packing", [PLAIN, ZLIB])
def test_a_whole_file_is_listed_once_and_comes_back(packing: int, capsysbinary: CaptureBytes) -> None:
    content = PHOTO if packing == PLAIN else b"a line of a log\n" * 90_000
    store(data_of("f.bin", content, packing=packing))
    assert got(capsysbinary, "f.bin") == (0, content, "")
    assert got(capsysbinary, "7-0123abcd-0") == (0, content, "")
    (found,) = json_output(capsysbinary, "ls", "rass-1.db")["data"]
    assert (found["kind"], found["name"], found["size"]) == ("file", "f.bin", len(content))
    assert found["sha256"] == sha256(content).hexdigest()
    assert found["parts"]["there"] == found["parts"]["of"]
    assert (found["place"], found["time"]) == (list(HERE), 1_795_341_600.0)


def test_of_a_file_in_part_the_beginning_is_given_on_demand(capsysbinary: CaptureBytes) -> None:
    manifest, *parts = data_of("photo.jpg", PHOTO)
    store([manifest], parts[:3], parts[5:])
    assert b"file photo.jpg 5 of 7 parts" in output(capsysbinary, "ls", "rass-1.db").out
    code, out, err = got(capsysbinary, "photo.jpg")
    assert (code, out) == (1, b"")
    assert "photo.jpg: only 5 of 7 parts have arrived; --partial fetches the beginning" in err
    code, out, err = got(capsysbinary, "photo.jpg", "--partial")
    assert (code, len(out), "5 of 7" in err) == (0, 3 * 14_286, True)
    assert PHOTO.startswith(out)
    (line,) = json_output(capsysbinary, "export", "rass-1.db", "--format", "files", "-o", "out", code=1)["error"]
    assert "nothing to export, so it was not created: 5: parts of files: --kind part; 1: incomplete or corrupt" in line


def test_the_beginning_of_a_packed_file_is_unpacked(capsysbinary: CaptureBytes) -> None:
    content = b"".join(b"%d lines\n" % number for number in range(40_000))
    manifest, *parts = data_of("log.txt", content, packing=ZLIB, most=1 << 13)
    store([manifest], parts[:-1])
    code, out, _ = got(capsysbinary, "log.txt", "--partial")
    assert code == 0
    assert len(content) > len(out) > len(content) // 2
    assert content.startswith(out)


def test_a_file_without_its_manifest_is_listed_and_comes_back(capsysbinary: CaptureBytes) -> None:
    _, *parts = data_of("photo.jpg", PHOTO)
    store(parts)
    line = output(capsysbinary, "ls", "rass-1.db").out.decode().splitlines()[-1]
    name = line.split()[0]
    assert name.startswith("file-")
    assert line.endswith("file of drone 7 with no manifest yet, 7 parts")
    assert got(capsysbinary, name) == (0, PHOTO, "")
    (found,) = json_output(capsysbinary, "ls", "rass-1.db")["without_manifest"]
    assert found == {"name": name, "drone": 7, "parts": {"there": 7, "of": 7}}


def test_parts_that_contradict_each_other_are_named(capsysbinary: CaptureBytes) -> None:
    manifest, *parts = data_of("photo.jpg", PHOTO)
    cut = cut_of(PHOTO)
    forged = part(cut, 2, bytes(cut.size(2)), 99)
    store([manifest], [forged], parts)
    code, _, err = got(capsysbinary, "photo.jpg")
    assert code == 1
    assert "7-0123abcd-3 contradict other parts" in err


def test_a_part_that_came_twice_contradicts_nothing(capsysbinary: CaptureBytes) -> None:
    manifest, *parts = data_of("photo.jpg", PHOTO)
    again = [put(50 + n, Kind.PART, part.payload) for n, part in enumerate(parts)]
    store([manifest], parts, again)
    assert got(capsysbinary, "photo.jpg") == (0, PHOTO, "")


def test_parts_of_another_drone_do_not_count(capsys: Capture) -> None:
    manifest = data_of("photo.jpg", PHOTO)[0]
    store([manifest], data_of("photo.jpg", PHOTO, drone=8)[1:])
    assert any(line.endswith("file photo.jpg 0 of 7 parts") for line in lines(capsys))


def test_a_file_that_was_put_twice_is_one(capsysbinary: CaptureBytes) -> None:
    store(data_of("photo.jpg", PHOTO)[:4], data_of("photo.jpg", PHOTO, 20)[4:])
    # What one put lacks is among the parts of the other.
    assert got(capsysbinary, "photo.jpg") == (0, PHOTO, "")


def test_large_data_of_the_format_before_stay_readable(capsysbinary: CaptureBytes) -> None:
    store([put(0, Kind.FILE, pack_file("old.jpg", PHOTO * 9))])
    for name in ("old.jpg", "7-0123abcd-0"):
        assert got(capsysbinary, name) == (0, PHOTO * 9, "")
    assert main(["export", "rass-1.db", "--format", "files", "-o", "out"]) == 0
    assert Path("out/7-0123abcd-0-old.jpg").read_bytes() == PHOTO * 9


def test_forged_counts_cost_no_memory(capsysbinary: CaptureBytes) -> None:
    digest = bytes(32)
    huge = cut_file(MOST_FILE, MOST_FILE, digest, PLAIN, 1 << 16)
    packed = cut_file(1000, 1 << 40, digest, ZLIB, 1 << 16)
    data = []
    for n, cut in enumerate((huge, packed)):
        size = MOST_FILE if cut.packing == PLAIN else 1000
        manifest = Manifest(cut, f"huge{n}", size, digest)
        data.append(put(10 * n, Kind.MANIFEST, encode_manifest(manifest)))
        data += [part(cut, index, bytes(cut.size(index)), 10 * n + 1 + k) for k, index in enumerate((cut.end - 1, 0))]
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
    found = lines(capsys)
    assert len(found) == 8
    assert all(line.endswith(" sealed") for line in found)
    with Archive(path, opens=OPENS) as archive:
        groups = Groups.of(archive)
        (manifest,) = archive.entries(parts=False)
        assert groups.parts_of(manifest).extent == (7, 7)
        assert b"".join(groups.parts_of(manifest).stored(archive.payload)) == PHOTO


def test_a_malformed_part_is_listed_with_what_is_wrong(capsys: Capture) -> None:
    manifest, *parts = data_of("photo.jpg", PHOTO)
    store([manifest], parts[:-1], [put(60, Kind.PART, b"\1short")])
    assert any("part, truncated cut of a file" in line for line in lines(capsys))
    assert len(lines(capsys, "--kind", "part")) == 7


def test_parts_are_listed_singly_on_demand(capsys: Capture) -> None:
    store(data_of("photo.jpg", PHOTO))
    found = lines(capsys, "--kind", "part")
    assert len(found) == 7
    assert "part 0 of file-" in found[0]


def test_files_are_on_the_map(capsys: Capture) -> None:
    store(data_of("photo.jpg", PHOTO))
    capsys.readouterr()
    assert main(["export", "rass-1.db", "-o", "m.geojson"]) == 0
    (feature,) = json.loads(Path("m.geojson").read_text())["features"]
    assert feature["geometry"]["coordinates"] == pytest.approx([8.5417, 47.3769, 412.5])
    assert feature["properties"]["file"] == "photo.jpg"
    assert main(["export", "rass-1.db", "-o", "m.kml"]) == 0
    assert "8.5417000,47.3769000,412.500" in Path("m.kml").read_text()
    box = lines(capsys, "--box", "47,8,48,9")
    assert any("photo.jpg" in line for line in box)


# -- parts that say something else -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "other",
    [
        {"length": 99_999},
        {"length": 1 << 40},
        {"part_bytes": 1 << 14},
        {"needed": 4, "shares": 7},
        {"packing": ZLIB},
        {"key": bytes(8)},
    ],
    ids="-".join,
)
@pytest.mark.parametrize("with_manifest", [True, False])
def test_parts_that_say_another_cut_belong_to_another_file(
    other: dict[str, Any], with_manifest: bool, capsysbinary: CaptureBytes
) -> None:
    """They come first, and have the indexes of true ones."""
    manifest, *parts = data_of("photo.jpg", PHOTO)
    cut = cut_of(PHOTO)
    false = cut._replace(**other)
    forged = [part(false, index, bytes(false.size(index)), 50 + index) for index in (0, 3)]
    store(forged, [manifest] if with_manifest else [], parts)
    found = listed(capsysbinary)
    extents = [entry["parts"] for entry in found["data"]] + [entry["parts"] for entry in found["without_manifest"]]
    assert sorted(extents, key=lambda extent: extent["there"]) == [
        {"there": 2, "of": false.parts}, {"there": 7, "of": 7}
    ]  # fmt: skip
    name = "photo.jpg" if with_manifest else f"file-{cut.key.hex()}"
    assert got(capsysbinary, name) == (0, PHOTO, "")


@pytest.mark.parametrize("index", [7, 1000, 0xFFFFFFFF])
def test_a_part_beyond_the_end_is_none(index: int, capsysbinary: CaptureBytes) -> None:
    manifest, *parts = data_of("photo.jpg", PHOTO)
    store([part(cut_of(PHOTO), index, bytes(14_286), 50)], [manifest], parts[1:])
    (bad, file) = listed(capsysbinary)["data"]
    assert bad["malformed"] == f"part {index} of 7"
    assert file["parts"] == {"there": 6, "of": 7}


@pytest.mark.parametrize("size", [0, 14_285, 14_287])
def test_a_part_of_a_wrong_size_is_not_given(size: int, capsysbinary: CaptureBytes) -> None:
    manifest, *parts = data_of("photo.jpg", PHOTO)
    store([manifest], parts[:2], [part(cut_of(PHOTO), 2, bytes(size), 50)], parts[3:])
    code, out, err = got(capsysbinary, "photo.jpg")
    assert (code, out) == (1, b"")
    assert f"7-0123abcd-50: part 2 has {size} bytes, expected 14286" in err


@pytest.mark.parametrize("options", [[], ["--partial"]])
def test_a_whole_file_with_another_sha_256_is_never_given(options: list[str], capsysbinary: CaptureBytes) -> None:
    manifest, *parts = data_of("photo.jpg", PHOTO)
    store([manifest], [part(cut_of(PHOTO), 0, bytes(14_286), 50)], parts[1:])
    code, out, err = got(capsysbinary, "photo.jpg", *options, "-o", "out.jpg")
    assert (code, out) == (1, b"")
    assert "not the file that was submitted: its SHA-256 does not match" in err
    assert not Path("out.jpg").exists()
    (line,) = json_output(capsysbinary, "export", "rass-1.db", "--format", "files", "-o", "out", code=1)["error"]
    assert "nothing to export, so it was not created: 7: parts of files: --kind part; 1: incomplete or corrupt" in line


def test_a_forged_share_spoils_its_file_and_gives_nothing_else(capsysbinary: CaptureBytes) -> None:
    pytest.importorskip("zfec")
    data = data_of("photo.jpg", PHOTO, redundancy=(4, 7))
    cut = cut_of(PHOTO, redundancy=(4, 7))
    forged = part(cut, 4, bytes(cut.size(4)), 50)
    manifest, *shares = data
    # Of the first stripe it is among the first four that are there.
    store([manifest], [forged], shares[1:])
    code, out, err = got(capsysbinary, "photo.jpg")
    assert (code, out) == (1, b"")
    assert f"{shares[4].id} contradict other parts" in err


# -- second contents of an id ------------------------------------------------------------------------------------------


def test_a_second_content_of_an_id_that_contradicts_is_named(capsysbinary: CaptureBytes) -> None:
    manifest, *parts = data_of("photo.jpg", PHOTO)
    forged = part(cut_of(PHOTO), 2, bytes(14_286), 3)
    store([manifest], parts[:2], [forged], parts[3:], apart=[parts[2]])
    code, out, err = got(capsysbinary, "photo.jpg")
    assert (code, out) == (1, b"")
    assert f"7-0123abcd-3#{parts[2].crc:08x} contradict other parts" in err


def test_a_part_whose_id_somebody_has_used_before_counts(capsysbinary: CaptureBytes) -> None:
    manifest, *parts = data_of("photo.jpg", PHOTO)
    store([manifest], parts[:2], [put(3, Kind.BYTES, b"squatter")], parts[3:], apart=[parts[2]])
    assert [entry.get("parts") for entry in listed(capsysbinary)["data"]] == [{"there": 7, "of": 7}, None]
    assert got(capsysbinary, "photo.jpg") == (0, PHOTO, "")


# -- manifests ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda m: m._replace(digest=bytes(32)), "the key of a manifest is not that of its file"),
        (lambda m: m._replace(cut=m.cut._replace(part_bytes=1000)), "the key of a manifest is not that of its file"),
        (lambda m: m._replace(cut=m.cut._replace(needed=4, shares=7)), "the key of a manifest is not that of its file"),
        (lambda m: m._replace(size=5), "a file of 5 bytes in 100000"),
    ],
)
def test_a_manifest_that_contradicts_itself_is_malformed(
    change: Callable[[Manifest], Manifest], why: str, capsysbinary: CaptureBytes
) -> None:
    cut = cut_of(PHOTO)
    forged = change(Manifest(cut, "photo.jpg", len(PHOTO), sha256(PHOTO).digest()))
    store([put(90, Kind.MANIFEST, encode_manifest(forged))], data_of("photo.jpg", PHOTO))
    bad, file = listed(capsysbinary)["data"]
    assert bad["malformed"] == why
    assert file["parts"] == {"there": 7, "of": 7}
    assert got(capsysbinary, "photo.jpg") == (0, PHOTO, "")


@pytest.mark.parametrize("size", [1, len(LOG) - 1, len(LOG) + 1])
def test_a_manifest_with_a_false_size_does_not_hide_the_true_one(size: int, capsysbinary: CaptureBytes) -> None:
    """The key does not cover the size of a packed file."""
    true = data_of("log.txt", LOG, packing=ZLIB, most=200)
    forged = Manifest(cut_of(LOG, packing=ZLIB, most=200), "log.txt", size, sha256(LOG).digest())
    store([put(90, Kind.MANIFEST, encode_manifest(forged))], true)
    assert got(capsysbinary, "log.txt") == (0, LOG, "")
    code, out, err = got(capsysbinary, "7-0123abcd-90")
    assert (code, out) == (1, b"")
    assert "log.txt: " in err


def of_another_drone() -> list[Datum]:
    """A manifest with the name and the SHA-256 of the photo, and one false part that makes it whole."""
    cut = cut_file(len(PHOTO), len(PHOTO), sha256(PHOTO).digest(), PLAIN, 1 << 16)
    return [
        manifest_of(cut, "photo.jpg", PHOTO, drone=8),
        *(part(cut, index, bytes(cut.size(index)), 1 + index, drone=8) for index in cut.indexes()),
    ]


def test_a_captured_drone_cannot_hide_a_file_behind_one_of_the_same_name_and_sha_256(
    capsysbinary: CaptureBytes,
) -> None:
    store(of_another_drone(), data_of("photo.jpg", PHOTO))
    assert got(capsysbinary, "photo.jpg") == (0, PHOTO, "")


def test_it_cannot_put_another_file_in_its_place_either(capsysbinary: CaptureBytes) -> None:
    store(of_another_drone(), data_of("photo.jpg", PHOTO)[:-1])
    code, out, err = got(capsysbinary, "photo.jpg")
    assert (code, out) == (1, b"")
    assert "its SHA-256 does not match" in err


@pytest.mark.parametrize(("drone", "first"), [(7, 20), (8, 0)])
def test_two_files_of_one_name_are_told_apart(drone: int, first: int, capsysbinary: CaptureBytes) -> None:
    store(data_of("photo.jpg", PHOTO), data_of("photo.jpg", PHOTO[1:], first, drone=drone))
    code, out, err = got(capsysbinary, "photo.jpg")
    assert (code, out) == (2, b"")
    other = f"{drone}-0123abcd-{first}"
    assert f"several files have this name: 7-0123abcd-0, {other}" in err
    assert got(capsysbinary, other) == (0, PHOTO[1:], "")
    assert main(["export", "rass-1.db", "--format", "files", "-o", "out"]) == 0
    assert {path.name: path.stat().st_size for path in Path("out").glob("*.jpg")} == {
        "7-0123abcd-0-photo.jpg": len(PHOTO), f"{other}-photo.jpg": len(PHOTO) - 1
    }  # fmt: skip


def test_the_same_file_from_two_drones_is_taken_from_the_one_that_is_whole(capsysbinary: CaptureBytes) -> None:
    store(data_of("photo.jpg", PHOTO)[:-2], data_of("photo.jpg", PHOTO, drone=8))
    assert got(capsysbinary, "photo.jpg") == (0, PHOTO, "")


def test_a_file_that_was_put_twice_with_different_redundancy_is_one(capsysbinary: CaptureBytes) -> None:
    pytest.importorskip("zfec")
    first, again = data_of("photo.jpg", PHOTO), data_of("photo.jpg", PHOTO, 30, redundancy=(4, 7))
    store(first[:4], [again[0]], again[4:])
    assert [entry["parts"]["there"] for entry in listed(capsysbinary)["data"]] == [3, 8]
    assert got(capsysbinary, "photo.jpg") == (0, PHOTO, "")


def test_without_manifests_the_drone_that_has_all_parts_is_taken(capsysbinary: CaptureBytes) -> None:
    store(data_of("photo.jpg", PHOTO)[3:], data_of("photo.jpg", PHOTO, drone=8)[1:])
    name = f"file-{cut_of(PHOTO).key.hex()}"
    assert [(each["name"], each["drone"]) for each in listed(capsysbinary)["without_manifest"]] == [
        (name, 7),
        (name, 8),
    ]
    assert got(capsysbinary, name) == (0, PHOTO, "")


@pytest.mark.parametrize("redundancy", [None, (4, 7)])
def test_without_its_manifest_a_file_is_still_checked(
    redundancy: tuple[int, int] | None, capsysbinary: CaptureBytes
) -> None:
    pytest.importorskip("zfec")
    cut = cut_of(PHOTO, redundancy=redundancy)
    _, *parts = data_of("photo.jpg", PHOTO, redundancy=redundancy)
    store([part(cut, 0, bytes(cut.size(0)), 50)], parts[1:])
    code, out, err = got(capsysbinary, f"file-{cut.key.hex()}")
    assert (code, out) == (1, b"")
    assert "its SHA-256 does not match" in err


# -- names -------------------------------------------------------------------------------------------------------------


def test_names_lead_nowhere_and_do_nothing_on_a_terminal(capsys: Capture) -> None:
    data: list[Datum] = []
    for number, name in enumerate(HOSTILE):
        content = PHOTO + bytes([number])
        data += data_of(name, content, 20 * number, most=1 << 16)
        # And one of which a part is missing.
        data += data_of(name, content[1:], 20 * number + 10, most=1 << 16)[:-1]
    store(data)
    said = output(capsys, "ls", "rass-1.db").out
    for number in range(len(HOSTILE)):
        for first in (20 * number, 20 * number + 10):
            assert main(["get", "-c", "rass-1.db", f"7-0123abcd-{first}", "-o", "got"]) == (1 if first % 20 else 0)
            said += capsys.readouterr().err
        assert Path("got").read_bytes() == PHOTO + bytes([number])
    assert said.count("1 of 2 parts have arrived") == len(HOSTILE)
    assert all(character.isprintable() for line in said.split("\n") for character in line)
    before = {path.name for path in Path().iterdir()}
    assert json_output(capsys, "export", "rass-1.db", "--format", "files", "-o", "out")["data"] == len(HOSTILE)
    assert {path.name for path in Path().iterdir()} == before | {"out"}
    assert len([path for path in Path("out").iterdir() if path.name != "index.csv"]) == len(HOSTILE)
    assert all(path.is_file() for path in Path("out").iterdir())


# -- in part -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("packing", [PLAIN, ZLIB])
@pytest.mark.parametrize("with_manifest", [True, False])
def test_without_its_first_part_a_file_has_no_beginning(
    packing: int, with_manifest: bool, capsysbinary: CaptureBytes
) -> None:
    manifest, _, *parts = data_of("log.txt", LOG, packing=packing, most=200)
    store([manifest] if with_manifest else [], parts)
    Path("before.txt").write_bytes(b"of before")
    name = "log.txt" if with_manifest else f"file-{cut_of(LOG, packing=packing, most=200).key.hex()}"
    code, out, err = got(capsysbinary, name, "--partial", "-o", "before.txt")
    assert (code, out) == (1, b"")
    assert f"{len(parts)} of {len(parts) + 1} parts have arrived, none of them at the beginning" in err
    assert Path("before.txt").read_bytes() == b"of before"


def test_the_beginning_of_a_redundant_file_ends_where_too_few_shares_are_there(capsysbinary: CaptureBytes) -> None:
    pytest.importorskip("zfec")
    cut = cut_of(PHOTO, redundancy=(4, 7))
    manifest, *shares = data_of("photo.jpg", PHOTO, redundancy=(4, 7))
    # All computed shares of the first stripe and one part; of the second stripe too few.
    store([manifest], shares[3:7], shares[8:10])
    code, out, err = got(capsysbinary, "photo.jpg", "--partial")
    assert (code, out) == (0, PHOTO[: 4 * cut.part_bytes])
    assert "6 of 8 parts have arrived" in err


# -- while they arrive -------------------------------------------------------------------------------------------------


def test_follow_shows_a_file_when_its_manifest_is_there_and_once_more_when_it_is_whole(tmp_path: Path) -> None:
    """Not again for each datum that it does not need."""
    pytest.importorskip("zfec")
    redundant = data_of("a.jpg", PHOTO, redundancy=(4, 7))
    twice = data_of("b.jpg", PHOTO[1:], 30)
    again = [put(60 + number, each.kind, each.payload) for number, each in enumerate(twice[1:])]
    store(redundant, twice, again, [put(90, Kind.BYTES, b"the last")])
    with said_by(tmp_path, "ls", "rass-1.db", "--follow", "--json") as lines:
        shown: list[dict[str, Any]] = []
        while not shown or shown[-1]["kind"] != "bytes":
            shown.append(json.loads(next(lines)))
    assert [(entry.get("name"), entry.get("parts", {}).get("there")) for entry in shown] == [
        ("a.jpg", 0), ("a.jpg", 8), ("b.jpg", 0), ("b.jpg", 7), (None, None)
    ]  # fmt: skip


def test_a_cut_is_of_one_file_and_one_way_to_cut_it() -> None:
    cuts: list[Cut] = [
        cut_of(PHOTO), cut_of(PHOTO[1:]), cut_of(PHOTO, most=1 << 13), cut_of(PHOTO, packing=ZLIB),
        cut_of(PHOTO, redundancy=(4, 7)), cut_of(PHOTO, redundancy=(4, 8)),
    ]  # fmt: skip
    assert len({cut.key for cut in cuts}) == len(cuts)

"""Manifests and parts that do not fit each other, because somebody forged some: the true file is found where it is
there, and nothing else is given in its name."""

from __future__ import annotations

import json
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest

from rass_mav.cli import main
from rass_mav.core.datum import Datum, Kind
from rass_mav.wire.file import PLAIN, ZLIB, Cut, Manifest, cut_file, encode_manifest
from tests.app.app_nodes import said_by

from .cut_files import PHOTO, cut_of, data_of, got, manifest_of, part, store
from .mission_stores import HOSTILE, put

Capture = pytest.CaptureFixture[str]
CaptureBytes = pytest.CaptureFixture[bytes]
LOG = b"a line of a log\n" * 20_000


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def listed(capture: CaptureBytes) -> dict[str, Any]:
    assert main(["ls", "rass-1.db", "--json"]) == 0
    found: dict[str, Any] = json.loads(capture.readouterr().out)
    return found


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
    assert "its SHA-256 does not match" in err
    assert not Path("out.jpg").exists()


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


def test_the_same_name_from_two_drones_is_no_one_file(capsysbinary: CaptureBytes) -> None:
    store(data_of("photo.jpg", PHOTO), data_of("photo.jpg", PHOTO[1:], drone=8))
    code, out, err = got(capsysbinary, "photo.jpg")
    assert (code, out) == (2, b"")
    assert "several files have this name: 7-0123abcd-0, 8-0123abcd-0" in err
    assert got(capsysbinary, "8-0123abcd-0") == (0, PHOTO[1:], "")
    assert main(["export", "rass-1.db", "--format", "files", "-o", "out"]) == 0
    assert {path.name: path.stat().st_size for path in Path("out").glob("*.jpg")} == {
        "7-0123abcd-0-photo.jpg": len(PHOTO), "8-0123abcd-0-photo.jpg": len(PHOTO) - 1
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
    assert main(["ls", "rass-1.db"]) == 0
    said = capsys.readouterr().out
    for number in range(len(HOSTILE)):
        for first in (20 * number, 20 * number + 10):
            assert main(["get", "-c", "rass-1.db", f"7-0123abcd-{first}", "-o", "got"]) == (1 if first % 20 else 0)
            said += capsys.readouterr().err
        assert Path("got").read_bytes() == PHOTO + bytes([number])
    assert said.count("1 of 2 parts are here") == len(HOSTILE)
    assert all(character.isprintable() for line in said.split("\n") for character in line)
    before = {path.name for path in Path().iterdir()}
    assert main(["export", "rass-1.db", "--format", "files", "-o", "out", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["data"] == len(HOSTILE)
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
    assert f"{len(parts)} of {len(parts) + 1} parts are here, and nothing of its beginning" in err
    assert Path("before.txt").read_bytes() == b"of before"


def test_the_beginning_of_a_redundant_file_ends_where_too_few_shares_are_there(capsysbinary: CaptureBytes) -> None:
    pytest.importorskip("zfec")
    cut = cut_of(PHOTO, redundancy=(4, 7))
    manifest, *shares = data_of("photo.jpg", PHOTO, redundancy=(4, 7))
    # All computed shares of the first stripe and one part; of the second stripe too few.
    store([manifest], shares[3:7], shares[8:10])
    code, out, err = got(capsysbinary, "photo.jpg", "--partial")
    assert (code, out) == (0, PHOTO[: 4 * cut.part_bytes])
    assert "6 of 8 parts are here" in err


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

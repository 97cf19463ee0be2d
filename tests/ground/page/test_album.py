"""Photographs and lines that operators have put: what of them browsers get."""

from __future__ import annotations

import hashlib
import io
import json
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from rass_mav.core.datum import DatumId, Kind
from rass_mav.ground.album import MOST_LISTED, MOST_OF_DRONE, MOST_PARTS, Album
from rass_mav.ground.archive import Archive
from rass_mav.ground.attention.watch import Rules
from rass_mav.ground.entry import Entry
from rass_mav.ground.page.follow import Follower
from rass_mav.ground.page.model import Mission
from rass_mav.ground.pictures import MOST_BYTES, MOST_SIDE, kind_of
from rass_mav.wire.file import PLAIN, Cut, Manifest, Part, PartHead, encode_manifest, encode_part, key_of
from tests.ground.missions import EPOCH, HERE, Base

from .images import image, png_head

# -- which images ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("format", "kind"),
    [("PNG", "image/png"), ("JPEG", "image/jpeg"), ("WEBP", "image/webp"), ("GIF", None), ("BMP", None)],
)
def test_their_type_is_that_of_their_contents(format: str, kind: str | None) -> None:
    assert kind_of(image(format)) == kind


def test_a_webp_without_loss_and_one_with_more_to_it() -> None:
    pillow = pytest.importorskip("PIL.Image", reason="pillow is not installed (extra dev)")
    for mode, options in (("RGB", {"lossless": True}), ("RGBA", {"exif": b"Exif\0\0II*\0\x08\0\0\0\0\0"})):
        out = io.BytesIO()
        pillow.new(mode, (30, 20)).save(out, "WEBP", **options)
        assert kind_of(out.getvalue()) == "image/webp"


@pytest.mark.parametrize(
    "forged",
    [
        b"", b"\x89PNG", b"\x89PNG\r\n\x1a\n", b"<svg xmlns='http://www.w3.org/2000/svg' onload='alert(1)'/>",
        b"\xff\xd8\xff", b"\xff\xd8" + b"\xff" * 300, b"\xff\xd8\xff\xe0\0\0" * 50, b"\xff\xd8\xff\xe0\0\2" * 600,
        b"\xff\xd8\xff\xda\0\2", b"\xff\xd8\xff\xe0 a picture", b"RIFF\0\0\0\0WEBP", b"<html>",
        b"RIFF\0\0\0\0WAVEfmt ", b"GIF89a\1\0\1\0",
        b"RIFF\0\0\0\0WEBPVP8X" + bytes(5), b"RIFF\0\0\0\0WEBPVP8L" + bytes(3), b"%PDF-1.7", b"BM" + bytes(60),
    ],
)  # fmt: skip
def test_what_is_no_image_is_none(forged: bytes) -> None:
    assert kind_of(forged) is None


def test_one_that_would_fill_the_memory_of_a_browser_is_none() -> None:
    assert kind_of(png_head(4000, 3000)) == "image/png"
    for size in ((MOST_SIDE, MOST_SIDE), (2**31 - 1, 1), (MOST_SIDE + 1, 1), (0, 5), (5, 0)):
        assert kind_of(png_head(*size)) is None
    assert kind_of(b"\xff\xd8\xff\xc0\0\x11\x08" + b"\xff\xff\xff\xff" + bytes(20)) is None
    assert kind_of(b"RIFF\0\0\0\0WEBPVP8X" + bytes(8) + b"\xff" * 6) is None
    assert kind_of(png_head(10, 10) + bytes(MOST_BYTES)) is None, "too many bytes"


@given(
    st.sampled_from([b"\x89PNG\r\n\x1a\n\0\0\0\x0dIHDR", b"\xff\xd8\xff", b"RIFF\1\1\1\1WEBPVP8X", b""]),
    st.binary(max_size=400),
)
@example(b"\xff\xd8", b"\xff" * 400)
def test_whatever_bytes_come_there_is_an_answer(start: bytes, rest: bytes) -> None:
    assert kind_of(start + rest) in ("image/png", "image/jpeg", "image/webp", None)


# -- which of them are listed, and read --------------------------------------------------------------------------------


def pieces(content: bytes, part_bytes: int = 1000, name: str = "gate.jpg") -> tuple[bytes, list[bytes]]:
    """The payloads of a photograph that is cut into parts."""
    digest = hashlib.sha256(content).digest()
    cut = Cut(PLAIN, 0, 0, part_bytes, len(content), b"")
    cut = cut._replace(key=key_of(digest, *cut[:5]))
    parts = [
        encode_part(Part(cut, number, content[number * part_bytes : (number + 1) * part_bytes]))
        for number in range(cut.parts)
    ]
    return encode_manifest(Manifest(cut, name, len(content), digest, None, (47.4, 8.6, 400.0))), parts


@pytest.fixture
def base(tmp_path: Path) -> Base:
    return Base(tmp_path / "rass-1.db")


def follower(base: Base) -> Follower:
    found = Follower(lambda: Archive(base.path, now=lambda: base.wall))
    found.look()
    return found


def test_a_photograph_and_a_line_are_where_their_drone_was(base: Base) -> None:
    base.arrive(
        base.measurement(7, 0, HERE, age_s=100.0), base.measurement(7, 1, HERE._replace(latitude=47.5), age_s=50.0),
        base.file(7, 2, "gate.JPG", image("JPEG")), base.datum(7, 3, Kind.BYTES, b"fire at the north gate", age_s=80.0),
        base.datum(8, 0, Kind.BYTES, b"nobody knows where I am"), base.file(7, 4, "notes.txt", b"no photograph"),
    )  # fmt: skip
    found = follower(base)
    first, *others = found.mission.snapshot()["notes"]
    assert (first["text"], first["place"], first["drone"]) == ("fire at the north gate", [47.3769, 8.5417], 7)
    assert {one["name"] or one["text"]: one["place"] for one in others} == {
        "gate.JPG": [47.5, 8.5417], "nobody knows where I am": None,
    }  # fmt: skip
    [photo] = [one for one in others if one["name"]]
    assert found.picture(photo["id"]) == (image("JPEG"), "image/jpeg")
    assert found.picture(first["id"]) is None
    assert found.picture("7-00000000-9") is None


def test_a_line_of_the_base_is_at_the_base(base: Base) -> None:
    base.arrive(base.datum(1, 0, Kind.BYTES, b"all well"))
    mission = Mission()
    mission.rules = Rules(base=(1, (47.38, 8.55)))
    with Archive(base.path, now=lambda: base.wall) as archive:
        mission.take(archive.entries())
    assert mission.snapshot()["notes"][0]["place"] == [47.38, 8.55]


def test_a_photograph_in_parts_is_shown_when_all_are_there_whatever_came_first(base: Base) -> None:
    content = image("PNG", (900, 700)) + bytes(3000)
    manifest, parts = pieces(content)
    data = [base.datum(7, number, Kind.PART, part) for number, part in enumerate(parts)]
    base.arrive(*data[1:])
    found = follower(base)
    assert found.mission.snapshot()["notes"] == [], "without its manifest nobody knows that it is one"
    base.arrive(base.datum(7, 500, Kind.MANIFEST, manifest))
    found.look()
    [photo] = found.mission.snapshot()["notes"]
    assert (photo["shown"], photo["parts"], photo["place"]) == (False, [len(parts) - 1, len(parts)], [47.4, 8.6])
    assert found.picture(photo["id"]) is None
    base.arrive(data[0])
    found.look()
    [photo] = found.mission.changes()["notes"]
    assert photo["shown"]
    assert found.picture(photo["id"]) == (content, "image/png")
    assert "notes" not in found.mission.changes(), "they are sent when they change"


def test_one_whose_parts_are_not_what_was_put_is_not_shown(base: Base) -> None:
    content = image("PNG")
    manifest, parts = pieces(content)
    forged = bytearray(parts[0])
    forged[-1] ^= 1
    base.arrive(base.datum(7, 0, Kind.MANIFEST, manifest), base.datum(7, 1, Kind.PART, bytes(forged)))
    base.arrive(
        base.file(8, 0, "page.jpg", b"<html><script>alert(1)</script>"),
        base.file(8, 1, "a.png", png_head(60_000, 60_000)),
    )
    found = follower(base)
    names = [one["id"] for one in found.mission.snapshot()["notes"]]
    assert len(names) == 3
    assert [found.picture(name) for name in names] == [None] * 3
    base.arrive(base.file(9, 0, "good.png", content))
    found.look()
    assert found.picture(f"9-{EPOCH:08x}-0") == (content, "image/png"), "what is forged stops nothing"


@pytest.mark.parametrize(
    ("payload", "text"),
    [
        (b"plain", "plain"), (b"\xff\xfe", None), (b"a\0b", None), (b"\x1b[31mred", None), ("é🔥".encode(), "é🔥"),
        ("left\u202eright".encode(), "left\ufffdright"), (b"two\nlines", "two\nlines"), (b"\xed\xa0\x80", None),
        ("👩\u200d🚒".encode(), "👩\u200d🚒"),
    ],
)  # fmt: skip
def test_a_line_is_text_or_nothing(base: Base, payload: bytes, text: str | None) -> None:
    base.arrive(base.datum(7, 0, Kind.BYTES, payload))
    assert [one["text"] for one in follower(base).mission.snapshot()["notes"]] == ([] if text is None else [text])


def test_of_a_long_line_the_beginning_is_kept_and_no_half_character(base: Base) -> None:
    base.arrive(base.datum(7, 0, Kind.BYTES, "é".encode() * 5000))
    [line] = follower(base).mission.snapshot()["notes"]
    assert set(line["text"]) == {"é"}
    assert 100 < len(line["text"]) < 300
    assert line["size"] == 10_000


def entry(drone: int, number: int, **more: object) -> Entry:
    plain = Entry(number, DatumId(drone, EPOCH, number), 0, Kind.BYTES, 10, 1, float(number), 1.0, False, 0.0)
    return plain._replace(**more)  # type: ignore[arg-type]


def test_one_drone_fills_neither_the_list_nor_the_memory() -> None:
    album = Album()
    for number in range(500):
        album.take(entry(66, number, text="buy now"))
    album.take(entry(7, 3, text="fire at the north gate"))
    found = album.plain(lambda _: None)
    assert sum(one["drone"] == 66 for one in found) == MOST_OF_DRONE
    assert sum(one["drone"] == 7 for one in found) == 1
    for drone in range(100, 200):
        album.take(entry(drone, 1000 + drone, text="x"))
    found = json.loads(json.dumps(album.plain(lambda _: None), allow_nan=False))
    assert len(found) == MOST_LISTED
    assert [one["utc"] for one in found] == sorted(one["utc"] for one in found)


@pytest.mark.parametrize(
    "cut",
    [
        Cut(PLAIN, 0, 0, 1, MOST_PARTS + 1, b"k" * 8), Cut(PLAIN, 1, 255, 1 << 16, MOST_BYTES, b"k" * 8),
        Cut(PLAIN, 0, 0, 1 << 16, MOST_BYTES + 1, b"k" * 8), Cut(PLAIN, 0, 0, 1, 1 << 45, b"k" * 8),
    ],
)  # fmt: skip
def test_parts_of_what_is_too_large_are_not_kept(cut: Cut) -> None:
    album = Album()
    for number in range(3000):
        album.take(entry(7, number, part=PartHead(cut, number)))
    manifest = Manifest(cut, "a.jpg", min(cut.length, 1 << 40), bytes(32), None, None)
    album.take(entry(7, 9000, file="a.jpg", manifest=manifest, size=manifest.size))
    [one] = album.plain(lambda _: None)
    assert (one["shown"], one["parts"][0]) == (False, 0)
    assert album.find(one["id"]) is None

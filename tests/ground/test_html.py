"""The report as one file."""

from __future__ import annotations

import base64
import re
import struct
from html.parser import HTMLParser
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.cli import main
from rass_mav.core.datum import DatumId, Fate, Kind
from rass_mav.ground import html
from rass_mav.ground.archive import Archive
from rass_mav.ground.attention.conditions import Level, Row
from rass_mav.ground.attention.watch import Rules, Watch
from rass_mav.ground.commands.report import attention_lines
from rass_mav.ground.enclosed import MOST_ENCLOSED
from rass_mav.ground.pictures import kind_of, small_of
from rass_mav.wire.nodestatus import NodeStatus, encode_status
from tests.commands import json_output, output

from .mission_stores import archive, mission, stored
from .missions import EPOCH, HERE, Base
from .page.flights import Flight
from .page.images import image

#: Elements without an end.
_VOID = {"meta", "br", "img"}


class Strict(HTMLParser):
    """Collects the text, the elements, and whether each is closed."""

    def __init__(self) -> None:
        super().__init__()
        self.text: list[str] = []
        self.tags: list[str] = []
        self.links: list[str] = []
        self._open: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.links += [value or "" for name, value in attrs if name in ("href", "src", "action", "xlink:href")]
        assert not [name for name, _ in attrs if name.startswith("on")]
        if tag not in _VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        self._open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append(data)

    @classmethod
    def of(cls, text: str) -> Strict:
        parser = cls()
        parser.feed(text)
        parser.close()
        assert not parser._open
        return parser


def report(path: Path, out: Path, now: float) -> str:
    with Archive(path, now=lambda: now) as found:
        html.write(found, out, now)
    return out.read_text(encoding="utf-8")


def test_it_has_a_map_and_tables_and_needs_nothing_else(base: Base, tmp_path: Path) -> None:
    said = NodeStatus(5, 3, 0, None, 0.2, 1, 60, (47.378, 8.543), {}, {7: 3})
    base.arrive(
        base.measurement(7, 0, HERE, age_s=100.0),
        base.measurement(7, 1, HERE._replace(latitude=47.3775, reading=2000.0), age_s=80.0),
        base.datum(7, 5, Kind.STATUS, encode_status(said), age_s=60.0),
        base.datum(1, 0, Kind.STATUS, encode_status(said._replace(base=True)), age_s=30.0),
    )
    base.store.lose(DatumId(7, EPOCH, 2), Fate.OVERFLOW)
    base.store.lose(DatumId(7, EPOCH, 9), Fate.UNKNOWN)
    base.arrive(base.measurement(8, 0, HERE))
    text = report(base.path, tmp_path / "report.html", base.wall)
    found = Strict.of(text)
    words = " ".join(found.text)
    assert found.links == []
    assert "script" not in found.tags
    assert found.tags.count("svg") == 1
    assert found.tags.count("polyline") == 3
    assert "2,000 uSv/h" in words
    assert "abc00001-3..4" in words
    assert "1 overflow" in words
    assert "Drone 7 may have created data that no node knows of" in words
    at_risk = "3 or more data lost, of those older than 60 s"
    assert at_risk in words, "its numbers are in doubt, so all that it had alone"
    assert "1 (base)" in words


def test_the_base_is_on_the_map_and_said_to_be_a_guess(base: Base, tmp_path: Path) -> None:
    said = NodeStatus(0, 0, 0, None, 0.2, 0, None, None, {7: 0.9}, {}, base=True)
    base.arrive(base.measurement(7, 0, HERE, age_s=60.0), base.datum(1, 0, Kind.STATUS, encode_status(said)))
    text = report(base.path, tmp_path / "guess.html", base.wall)
    assert "The position of base 1 is a guess" in text
    marks = re.findall(r'<text x="(.*?)" y="(.*?)".*?>(.*?)</text>', text)
    places = {mark: (float(x), float(y)) for x, y, mark in marks}
    assert places["1?"] == (places["7"][0] - 20, places["7"][1]), "beside the drone from which it was guessed"
    with Archive(base.path, now=lambda: base.wall) as found:
        html.write(found, tmp_path / "set.html", base.wall, Rules(base=(1, (47.38, 8.55))))
    text = (tmp_path / "set.html").read_text(encoding="utf-8")
    assert 'text-anchor="middle">1</text>' in text
    assert "guess" not in text


def test_contours_and_hot_spots_are_on_the_map_and_in_a_list(tmp_path: Path) -> None:
    flight = Flight(tmp_path / "rass-1.db", drones=10)
    flight.fly(600)
    flight.close()
    with Archive(flight.base.path, now=lambda: flight.base.wall) as found:
        html.write(found, tmp_path / "report.html", flight.base.wall, Rules(above=50.0, contours=(2.0, 20.0)))
    parsed = Strict.of((tmp_path / "report.html").read_text(encoding="utf-8"))
    words = " ".join(parsed.text)
    assert re.search(r"Lines: where readings are 2, 20(, 50)? uSv/h", words)
    spots = re.findall(r"(47\.\d{6}, 8\.\d{6}), ([\d,]+) uSv/h, drone \d+, 2026-11-22 10:", words)
    assert spots
    assert f"{len(spots)}, the highest first." in words
    assert f"spot {len(spots)}" in words
    assert f"spot {len(spots) + 1}" not in words


def test_what_drones_say_is_text(tmp_path: Path) -> None:
    path = stored(tmp_path / "a<script>alert(1)<&'\".db", mission())
    with archive(path) as found:
        found.remarks.append("<img src=x onerror=alert(1)>\x07</script>")
        html.write(found, tmp_path / "report.html", 1.8e9)
    parsed = Strict.of((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert not {"script", "img"} & set(parsed.tags)
    assert any("<img src=x onerror=alert(1)>\ufffd</script>" in text for text in parsed.text)


def test_what_needs_attention_is_text_too(base: Base, capsys: pytest.CaptureFixture[str]) -> None:
    base.arrive(base.measurement(7, 0, HERE))
    with Archive(base.path, now=lambda: base.wall) as found:
        plain = Watch.of(found).plain(base.wall)
    hostile = Row(Level.ALARM, "node", "link <script>alert(1)</script>\x1b[31m", "<img src=x onerror=y>", ())
    parsed = Strict.of(html.page(plain, [hostile], html.Drawing(), "store", [], base.wall))
    assert not {"script", "img"} & set(parsed.tags)
    assert any("\ufffd[31m" in text for text in parsed.text)
    [line] = list(attention_lines(plain, [hostile]))
    assert line.isprintable()
    assert r"\x1b[31m" in line


def test_an_empty_store_and_one_without_places(base: Base, tmp_path: Path) -> None:
    base.arrive()
    text = report(base.path, tmp_path / "empty.html", base.wall)
    assert "No position is known" in text
    base.arrive(base.measurement(7, 0, HERE._replace(latitude=None, longitude=None, altitude=None)))
    assert "No position is known" in report(base.path, tmp_path / "nowhere.html", base.wall)


def test_one_place_is_in_the_middle_and_the_180th_meridian_is_no_gap(base: Base, tmp_path: Path) -> None:
    base.arrive(
        base.measurement(7, 0, HERE._replace(longitude=179.9999, reading=None)),
        base.measurement(8, 0, HERE._replace(longitude=-179.9999, reading=0.0)),
    )
    text = report(base.path, tmp_path / "report.html", base.wall)
    points = [float(x) for x in re.findall(r'<circle cx="([\d.]+)"', text)]
    assert len(points) == 2
    assert 300 < min(points) < max(points) < 600, "20 metres apart, not once around the world"


def test_the_command_writes_it_and_overwrites_nothing(
    base: Base, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    base.arrive(base.measurement(7, 0, HERE))
    out = tmp_path / "out.html"
    assert json_output(capsys, "report", str(base.path), "--html", str(out))["arrived"] == 1
    assert out.read_text(encoding="utf-8").startswith("<!doctype html>")
    assert "already exists" in output(capsys, "report", str(base.path), "--html", str(out), code=2).err
    assert main(["report", str(base.path), "--html", str(tmp_path / "no" / "out.html")]) == 1


def photograph(small: bytes, size: int, order: str = "<") -> bytes:
    """A JPEG of so many bytes at least, with a small picture in its Exif data."""
    tiff = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(
        f"{order}IHIHHHIIHHIII", 8, 0, 14, 2, 0x0201, 4, 1, 44, 0x0202, 4, 1, len(small), 0
    )
    exif = b"Exif\0\0" + tiff + small
    head = b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif
    return b"\xff\xd8" + head + image("JPEG")[2:] + bytes(size)


def test_photographs_and_lines_are_at_their_places_and_in_a_list(base: Base, tmp_path: Path) -> None:
    small, png = image("JPEG", (16, 12)), image("PNG")
    base.arrive(
        base.measurement(7, 0, HERE, age_s=100.0), base.measurement(7, 1, HERE._replace(latitude=47.38), age_s=50.0),
        base.datum(7, 2, Kind.BYTES, b"fire at the <b>north</b> gate", age_s=90.0), base.file(7, 3, "gate.png", png),
        base.file(8, 0, "big.jpg", photograph(small, 900 << 10)), base.file(8, 1, "page.jpg", b"<html>"),
    )  # fmt: skip
    parsed = Strict.of(report(base.path, tmp_path / "report.html", base.wall))
    words = " ".join(parsed.text)
    assert "4, in chronological order" in words
    assert "fire at the <b>north</b> gate" in words
    assert "note 1" in words, "on the map"
    images = {base64.b64decode(link.partition(",")[2]) for link in parsed.links if link.startswith("data:image/")}
    assert images == {png, small}, "of a large one the small picture that its camera made"
    assert "left out: not a PNG, JPEG or WebP image that browsers display" in words
    assert "1 photograph is left out" in words


def test_a_report_has_two_mebibytes_of_photographs_the_latest_and_names_the_others(base: Base, tmp_path: Path) -> None:
    one = image("PNG") + bytes(700 << 10)
    base.arrive(*(base.file(7, number, f"{number}.png", one) for number in range(4)))
    text = report(base.path, tmp_path / "report.html", base.wall)
    parsed = Strict.of(text)
    assert len(parsed.links) == 2
    assert len(text) < MOST_ENCLOSED + 50_000
    words = " ".join(parsed.text)
    assert "2 photographs are left out" in words
    for number in (0, 1):
        assert re.search(rf"\b{number}\.png, 71\d,\d+ bytes, left out: this report has 2 MiB of photographs", words)


@pytest.mark.parametrize("order", ["<", ">"])
def test_the_small_picture_of_a_photograph_is_found_whatever_its_byte_order(order: str) -> None:
    small = image("JPEG", (16, 12))
    assert small_of(photograph(small, 10, order)) == small


@given(st.integers(0, 400), st.binary(max_size=40))
def test_whatever_is_wrong_with_exif_data_there_is_an_answer(at: int, forged: bytes) -> None:
    whole = photograph(b"\xff\xd8\xff\xc0\0\x11\x08\0\x10\0\x10" + bytes(20), 0)
    found = small_of(whole[:at] + forged + whole[at + len(forged) :])
    assert found is None or kind_of(found) == "image/jpeg"
    assert small_of(whole[:at]) is None or at >= 87, "its last byte is the 87th"

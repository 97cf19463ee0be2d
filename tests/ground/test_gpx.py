"""GPX: tracks and waypoints, as GDAL reads them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.core.datum import Datum, Kind, make_datum
from rass_mav.wire.nodestatus import NodeStatus, encode_status

from .cut_files import HERE, cut_of, data_of, manifest_of
from .exports import exported, features, gdal, needs_gdal
from .mission_stores import EPOCH, HOSTILE, PLACED, measured, mission, nowhere, put

GPX = {"g": "http://www.topografix.com/GPX/1/1"}


def read(folder: Path, data: list[Datum], **options: Any) -> ElementTree.Element:
    return ElementTree.parse(exported(folder, "gpx", data, **options)[0]).getroot()


def said(root: ElementTree.Element, path: str) -> list[str]:
    return [element.text or "" for element in root.findall(path, GPX)]


def status(sequence: int, place: tuple[float, float] | None, ago_s: float = 100.0) -> Datum:
    found = NodeStatus(1, 0, 0, None, 0.0, 1, 80, place, {}, {})
    return put(sequence, Kind.STATUS, encode_status(found), ago_s=ago_s)


def test_it_holds_all_that_has_a_place(tmp_path: Path) -> None:
    data = mission()
    out, done = exported(tmp_path, "gpx", data)
    assert (done.data, done.left_out) == (PLACED, {"no position": len(data) - PLACED})
    root = ElementTree.parse(out).getroot()
    # One is of unknown age, so its place in the track is unknown too; two units have a hot spot each.
    assert sorted(said(root, "g:wpt/g:type")) == ["hot spot", "measurement"]
    assert len(root.findall("g:trk/g:trkseg/g:trkpt", GPX)) == PLACED - 1


def test_a_drone_has_a_track_in_order_of_time(tmp_path: Path) -> None:
    data = [measured(n, ago, drone=drone) for drone in (12, 7) for n, ago in enumerate((100.0, 300.0, 200.0))]
    root = read(tmp_path, [*data, status(9, (47.0, 8.0), 250.0), status(10, None)])
    assert said(root, "g:trk/g:name") == ["drone 7", "drone 12"]
    first, second = root.findall("g:trk", GPX)
    assert [name[-2:] for name in said(first, "g:trkseg/g:trkpt/g:name")] == ["-1", "-9", "-2", "-0"]
    assert [name[-2:] for name in said(second, "g:trkseg/g:trkpt/g:name")] == ["-1", "-2", "-0"]
    times = said(first, "g:trkseg/g:trkpt/g:time")
    assert times == sorted(times)


def test_a_new_epoch_is_a_new_segment(tmp_path: Path) -> None:
    data = [measured(n, 500.0 - n) for n in range(2)]
    later = (measured(n, 400.0 - n) for n in range(3))
    data += [make_datum(one.id._replace(epoch=EPOCH + 1), one.kind, one.created, one.payload) for one in later]
    root = read(tmp_path, data)
    assert [len(segment) for segment in root.findall("g:trk/g:trkseg", GPX)] == [2, 3]


def test_without_a_date_there_is_a_track_and_no_time(tmp_path: Path) -> None:
    data = [measured(n, ago) for n, ago in enumerate((100.0, 300.0))]
    root = read(tmp_path, data, now=0.0, trusted=False)
    assert [name[-2:] for name in said(root, "g:trk/g:trkseg/g:trkpt/g:name")] == ["-1", "-0"]
    assert said(root, ".//g:time") == []


def test_second_contents_and_data_of_unknown_age_bend_no_track(tmp_path: Path) -> None:
    data = [measured(0, 200.0), measured(1), measured(2, latitude=10.0)._replace(at_least=True)]
    root = read(tmp_path, data, apart=[measured(1, latitude=-80.0)])
    assert len(root.findall("g:trk/g:trkseg/g:trkpt", GPX)) == 2
    assert [point.get("lat") for point in root.findall("g:wpt", GPX)] == ["10.0000000", "-80.0000000"]
    assert said(root, "g:wpt/g:desc")[0].endswith("0.75 uSv/h, possibly older than its date")
    assert said(root, "g:wpt[1]/g:time") == []


def test_a_photo_is_a_waypoint_where_and_when_it_was_taken(tmp_path: Path) -> None:
    root = read(tmp_path, [*data_of("roof.jpg", b"x" * 20_000), nowhere(9)])
    (photo,) = root.findall("g:wpt", GPX)
    assert (photo.get("lat"), photo.get("lon")) == (f"{HERE[0]:.7f}", f"{HERE[1]:.7f}")
    assert said(photo, "g:name") == ["roof.jpg"]
    assert said(photo, "g:time") == ["2026-11-22T10:00:00.000Z"]
    assert said(photo, "g:type") == ["file"]
    assert root.findall("g:trk", GPX) == []


def test_hot_spots_are_waypoints_the_highest_first(tmp_path: Path) -> None:
    hot = [(0, 47.0, 5.0), (1, 47.1, 9.0), (2, 47.1, 8.0), (3, 47.2, 7.0)]
    data = [measured(n, latitude=latitude, reading=reading, risk=1.0) for n, latitude, reading in hot]
    root = read(tmp_path, [*data, measured(9, latitude=47.3, reading=99.0, risk=0.5)])
    assert said(root, "g:wpt/g:name") == ["hot spot 1", "hot spot 2", "hot spot 3"]
    assert [point.get("lat") for point in root.findall("g:wpt", GPX)] == ["47.1000000", "47.2000000", "47.0000000"]
    assert said(root, "g:wpt/g:desc")[0] == "drone 7, 7-0123abcd-1, 9 uSv/h"
    assert [float(one.text or "") for one in root.iterfind("g:wpt/g:extensions/{urn:rass-mav:gpx:1}reading", GPX)] == [
        9.0, 7.0, 5.0,
    ]  # fmt: skip


def test_the_elements_of_a_point_are_in_the_order_of_the_schema(tmp_path: Path) -> None:
    root = read(tmp_path, [measured(0), *data_of("a.jpg", b"x", 1)])
    order = ["ele", "time", "name", "desc", "type", "extensions"]
    for point in (*root.findall("g:wpt", GPX), *root.iter("{http://www.topografix.com/GPX/1/1}trkpt")):
        found = [child.tag.split("}")[1] for child in point]
        assert found == [name for name in order if name in found]
    assert [child.tag.split("}")[1] for child in root] == ["wpt", "trk"]


def test_the_meridian_of_180_degrees_is_west(tmp_path: Path) -> None:
    """The schema has -180, and no 180."""
    root = read(tmp_path, [measured(0, longitude=180.0), measured(1, longitude=-180.0)])
    assert {point.get("lon") for point in root.iter("{http://www.topografix.com/GPX/1/1}trkpt")} == {"-180.0000000"}


@given(st.text(min_size=1, max_size=60))
def test_any_name_is_a_name_of_a_waypoint(tmp_path_factory: pytest.TempPathFactory, name: str) -> None:
    name = name.encode(errors="replace").decode()
    root = read(tmp_path_factory.mktemp("gpx"), [manifest_of(cut_of(b"x"), name, b"x")])
    (shown,) = said(root, "g:wpt/g:name")
    forbidden = "[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]"
    assert shown == re.sub("\r\n?", "\n", re.sub(forbidden, "", name)) or not shown


def test_what_flipped_bits_make_of_numbers_is_no_file_that_cannot_be_read(tmp_path: Path) -> None:
    wild = [
        measured(0, altitude=-2147483.648),
        measured(1, reading=-3.4e38),
        measured(2)._replace(created=float("inf")),
    ]
    root = read(tmp_path, [*wild, measured(3)._replace(created=float("-inf"))])
    assert len(root.findall(".//g:trkpt", GPX)) + len(root.findall("g:wpt", GPX)) == 4
    numbers = [*said(root, ".//g:ele"), *(element.text or "" for element in root.iter("{urn:rass-mav:gpx:1}reading"))]
    assert not [text for text in numbers if re.search("nan|inf", text, re.I)]


@needs_gdal
def test_gdal_reads_tracks_and_waypoints_with_their_readings(tmp_path: Path) -> None:
    photos = [datum for n, name in enumerate(HOSTILE) for datum in data_of(name, b"x", 100 + 10 * n)]
    out = exported(tmp_path, "gpx", [*mission()[:11], *photos])[0].rename(tmp_path / "out.gpx")
    assert "Feature Count: 1" in gdal("ogrinfo", "-so", out, "tracks")
    (track,) = features(out, "tracks")
    assert track["properties"]["name"] == "drone 7"
    first, second, *_ = points = features(out, "track_points")
    assert len(points) == PLACED - 1
    assert first["geometry"]["coordinates"][:2] == [8.25, 47.5]
    assert first["properties"]["ele"] == 412.5
    assert first["properties"]["time"].startswith("2026-11-22T11:58:20")
    assert (first["properties"]["rass_reading"], first["properties"]["rass_unit"]) == (0.75, "usvh")
    assert second["properties"]["rass_position_error_m"] == 2.5
    names = [point["properties"]["name"] for point in features(out, "waypoints")]
    assert len(names) == 2 + len(HOSTILE)
    assert "hot spot 1" in names
    assert "photo 🛸.jpg" in names
    assert "bell" in names

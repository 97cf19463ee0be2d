"""What each format holds, what it leaves out, and whether other programs read it."""

from __future__ import annotations

import csv
import io
import json
import os
import re
import resource
import sqlite3
import tracemalloc
import unicodedata
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from itertools import islice
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.app.payloads import pack_file
from rass_mav.core.datum import Datum, Kind
from rass_mav.ground.archive import Archive
from rass_mav.ground.entry import iso
from rass_mav.ground.formats import Exported, format_of, names
from rass_mav.ground.formats.csv import COLUMNS
from rass_mav.ground.formats.files import MOST_BYTES, safe_name
from rass_mav.ground.formats.kml import COLOURS, step_of, text_of
from rass_mav.sensor.bgeigie import decode_record
from rass_mav.sensor.bgeigie_log import read_bgeigie
from tests.some import some

from .exports import exported, features, gdal, needs_gdal
from .mission_stores import (
    FILES,
    HOSTILE,
    LIVED_S,
    NOW,
    PLACED,
    SAFECAST,
    archive,
    measured,
    mission,
    nowhere,
    put,
    stored,
)

KML = {"k": "http://www.opengis.net/kml/2.2"}
#: Colours of a symbol in QGIS.
VIRIDIS = [f"{red},{green},{blue},255" for red, green, blue in COLOURS]


@pytest.mark.parametrize("name", names())
def test_every_format_says_what_it_holds_and_takes_no_data_too(name: str, tmp_path: Path) -> None:
    out, done = exported(tmp_path, name, [])
    assert (done.data, done.left_out) == (0, {})
    assert out.exists()
    assert format_of(name).holds
    assert out.is_dir() is (not format_of(name).ending)


# -- CSV ---------------------------------------------------------------------------------------------------------------


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8-sig", newline="") as file:
        return list(csv.DictReader(file))


def test_csv_holds_everything(tmp_path: Path) -> None:
    data = mission()
    out, done = exported(tmp_path, "csv", data)
    assert (done.data, done.left_out) == (len(data), {})
    found = rows(out)
    assert [row["id"] for row in found] == [str(datum.id) for datum in data]
    assert found[0]["created_utc"] == "2026-11-22T11:58:20.000Z"
    assert (found[0]["latitude"], found[0]["reading"], found[0]["unit"]) == ("47.5", "0.75", "usvh")
    assert (found[9]["latitude"], found[9]["north_m"], found[9]["east_m"], found[9]["down_m"]) == (
        "", "1.5", "-2.5", "-30.0",
    )  # fmt: skip
    assert [row["file"] for row in found if row["kind"] == "file" and row["file"]] == [
        "'=cmd()" if name == "=cmd()" else name for name in HOSTILE
    ]


def test_a_reading_is_written_as_the_sensor_showed_it(tmp_path: Path) -> None:
    data = [measured(0, reading=0.12), measured(1, reading=1234567.0), nowhere(2, reading=None)]
    out, _ = exported(tmp_path, "csv", data)
    assert [row["reading"] for row in rows(out)] == ["0.12", "1234567.0", ""]
    with archive(stored(tmp_path / "rass-1.db", data)) as opened:
        assert [entry.plain()["measurement"]["reading"] for entry in opened.entries()] == [0.12, 1234567.0, None]


@pytest.mark.no_cover
@given(st.text(min_size=1, max_size=60))
def test_csv_gives_back_every_name_and_no_formula(tmp_path_factory: pytest.TempPathFactory, name: str) -> None:
    folder = tmp_path_factory.mktemp("csv")
    out, _ = exported(folder, "csv", [put(0, Kind.FILE, pack_file(name, b""))])
    (row,) = rows(out)
    assert row["file"].replace("'", "") == name.encode(errors="replace").decode().replace("'", "")
    assert not row["file"].startswith(("=", "+", "-", "@"))


@pytest.mark.parametrize(
    "before",
    ["", " ", "  ", "\t", "\r", "\n", "\r\n", "\0", "\x0b", "\x1f", "\x7f", "\x85", "\xa0", "\xad", "\u200b", "\u200f",
     "\u2028", "\u3000", "\ufeff", "a;", "a; ", 'a";', "a\t", "a\n", "a\r ", "'", '"'],
)  # fmt: skip
def test_csv_marks_what_a_spreadsheet_takes_for_a_formula(before: str, tmp_path: Path) -> None:
    """A spreadsheet ignores what is before it, and may cut at semicolons, tabs and line ends, whatever is quoted."""
    signs = "=+-@\uff1d\uff0b\uff0d\uff20\ufe66\ufe62\ufe63\ufe6b\u207c\u208a\u2212\ufb29"
    names = [f"{before}{sign}1+1" for sign in signs]
    out, _ = exported(tmp_path, "csv", [put(n, Kind.FILE, pack_file(name, b"")) for n, name in enumerate(names)])
    found = [re.split(r"[;\t\r\n]", row["file"])[-1] for row in rows(out)]
    assert len(found) == len(names)
    for cell in found:
        plain = unicodedata.normalize("NFKC", cell.replace("\u2212", "-"))
        assert re.sub(r"[\W_]*?(?=['=+@-])", "", plain, count=1).startswith("'"), cell


def test_csv_leaves_other_names_alone(tmp_path: Path) -> None:
    names = ["2026-11-22 a=b+c.jpg", "a;b.txt", "a @ b", "IMG_0001-2.JPG", "\xfcber \uff1d.txt", "it's"]
    out, _ = exported(tmp_path, "csv", [put(n, Kind.FILE, pack_file(name, b"")) for n, name in enumerate(names)])
    assert [row["file"] for row in rows(out)] == names


def test_the_index_of_files_has_no_formula_and_names_what_is_there(tmp_path: Path) -> None:
    names = ["a;=1+1", "=1+1", "\uff1d1+1", "a\t=1"]
    out, _ = exported(tmp_path, "files", [put(n, Kind.FILE, pack_file(name, b"x")) for n, name in enumerate(names)])
    found = [row["file"] for row in rows(out / "index.csv")]
    assert all((out / name).is_file() for name in found)
    assert not any(re.search(r"[;\t]\W*=", name) for name in found)


# -- GeoJSON -----------------------------------------------------------------------------------------------------------


def test_geojson_holds_what_has_a_place_on_earth(tmp_path: Path) -> None:
    data = mission()
    out, done = exported(tmp_path, "geojson", data)
    assert (done.data, done.left_out.total()) == (PLACED, len(data) - PLACED)
    found = json.loads(out.read_text(encoding="ascii"))
    assert found["type"] == "FeatureCollection"
    first, second, *_, southern, _ = found["features"]
    assert first["geometry"] == {"type": "Point", "coordinates": [8.25, 47.5, 412.5]}
    assert southern["geometry"]["coordinates"] == [-70.654321, -33.123456, -12.5]
    assert first["id"] == first["properties"]["id"] == "7-0123abcd-0"
    assert first["properties"]["created_utc"] == "2026-11-22T11:58:20.000Z"
    assert second["properties"]["position_error_m"] == 2.5
    for feature in found["features"]:
        assert feature["properties"].keys() <= set(COLUMNS)
        assert None not in feature["properties"].values()


def test_geojson_has_the_contours_of_what_is_exported(tmp_path: Path) -> None:
    step = 10.0 / 111_320.0
    data = [
        # The first place is the corner of its square; the others are not on a border.
        measured(row * 9 + column, latitude=47.5 + (row + 0.4 * (row > 0)) * step,
                 longitude=8.25 + (column + 0.4 * (column > 0)) * step / 0.6756,
                 reading=300.0 if (row, column) == (4, 4) else 0.2)
        for row in range(9) for column in range(9)
    ]  # fmt: skip
    out, done = exported(tmp_path, "geojson", data)
    found = json.loads(out.read_text())["features"]
    lines = [feature for feature in found if feature["geometry"]["type"] == "LineString"]
    assert (done.data, len(found) - len(lines)) == (81, 81), "lines are no data"
    assert [line["properties"] for line in lines] == [
        {"what": "contour", "level": level, "unit": "usvh", "closed": True} for level in (1.0, 25.0, 100.0)
    ]
    assert all(line["geometry"]["coordinates"][0] == line["geometry"]["coordinates"][-1] for line in lines)


def test_geojson_has_a_feature_a_line(tmp_path: Path) -> None:
    out, _ = exported(tmp_path, "geojson", mission())
    head, *lines, tail = out.read_text(encoding="ascii").splitlines()
    assert (head, tail) == ('{"type": "FeatureCollection", "features": [', "]}")
    assert [json.loads(line.rstrip(","))["type"] for line in lines] == ["Feature"] * PLACED


def test_an_infinite_time_is_no_number_of_json(tmp_path: Path) -> None:
    """A flipped bit on the disk makes one."""
    out, _ = exported(tmp_path, "geojson", [measured(0)._replace(created=float("-inf"))])

    def refuse(constant: str) -> None:
        raise AssertionError(constant)

    (feature,) = json.loads(out.read_text(encoding="ascii"), parse_constant=refuse)["features"]
    assert feature["properties"]["at_least_so_old"] == 1
    assert "time_error_s" not in feature["properties"]


# -- KML ---------------------------------------------------------------------------------------------------------------


def test_kml_has_a_placemark_for_each_place(tmp_path: Path) -> None:
    data = mission()
    out, done = exported(tmp_path, "kml", data)
    assert (done.data, done.left_out.total()) == (PLACED, len(data) - PLACED)
    (document,) = ElementTree.parse(out).getroot()
    marks = document.findall("k:Placemark", KML)
    assert len(marks) == PLACED
    first, second, third, *_ = marks
    assert first.findtext("k:name", namespaces=KML) == "7-0123abcd-0"
    assert first.findtext("k:TimeStamp/k:when", namespaces=KML) == "2026-11-22T11:58:20.000Z"
    assert first.findtext("k:Point/k:coordinates", namespaces=KML) == "8.2500000,47.5000000,412.500"
    assert first.findtext("k:Point/k:altitudeMode", namespaces=KML) == "absolute"
    columns = {
        data.get("name"): data.findtext("k:value", namespaces=KML)
        for data in first.findall("k:ExtendedData/k:Data", KML)
    }
    assert (columns["reading"], columns["unit"], columns["hops"]) == ("0.75", "usvh", "0")
    styles = {style.get("id"): style.findtext("k:IconStyle/k:color", namespaces=KML) for style in document}
    used = [mark.findtext("k:styleUrl", namespaces=KML) for mark in (first, second, third)]
    assert used == ["#risk2", "#risk0", "#risk4"]
    # Alpha, blue, green, red.
    assert [styles[(style or "#")[1:]] for style in used] == ["ff8c9121", "ff540144", "ff25e7fd"]


def test_kml_sends_nobody_to_the_network(tmp_path: Path) -> None:
    """A viewer fetches what a file names, and a crew in the field has no network."""
    text = exported(tmp_path, "kml", mission())[0].read_text(encoding="utf-8")
    assert re.findall(r"[\w+.-]*:?//[^\"'<>\s]*", text) == [KML["k"]]
    tags = {element.tag.split("}")[1] for element in ElementTree.fromstring(text.encode()).iter()}
    assert not tags & {"Icon", "href", "NetworkLink", "Link", "GroundOverlay", "description"}


@pytest.mark.parametrize(("risk", "step"), [(0.0, 0), (0.19, 0), (0.2, 1), (0.79, 3), (0.8, 4), (1.0, 4)])
def test_a_fifth_of_the_risk_has_a_colour(risk: float, step: int) -> None:
    assert step_of(risk) == step


@given(st.text())
def test_any_text_is_content_of_an_element(text: str) -> None:
    document = ElementTree.fromstring(f"<a>{text_of(text)}</a>".encode(errors="replace"))
    assert len(document) == 0
    # A parser makes all ends of lines the same.
    kept = "".join(c for c in text if c in "\t\n\r" or (c >= " " and unicodedata.category(c) != "Cs"))
    kept = re.sub("[\ufffe\uffff]", "", kept)
    assert (document.text or "") == re.sub("\r\n?", "\n", kept)


@needs_gdal
@pytest.mark.parametrize(("name", "time"), [("geojson", "created_utc"), ("kml", "timestamp")])
def test_gdal_reads_points_with_their_times(name: str, time: str, tmp_path: Path) -> None:
    out = exported(tmp_path, name, mission())[0].rename(tmp_path / f"out.{name}")
    first, second, *_ = found = features(out, "")
    assert len(found) == PLACED
    assert first["geometry"] == {"type": "Point", "coordinates": [8.25, 47.5, 412.5]}
    assert "7-0123abcd-0" in (first.get("id"), first["properties"].get("id"))
    assert second["properties"][time].startswith("2026-11-22T11:58:20")
    assert f"{time}: DateTime" in gdal("ogrinfo", "-so", "-al", out)


# -- GeoPackage --------------------------------------------------------------------------------------------------------


def styled(path: Path) -> tuple[str | None, list[tuple[float, float]], list[str | None]]:
    """The value by which QGIS colours the points, its classes, and the colours."""
    with closing(sqlite3.connect(path)) as db:
        ((table, column, default, qml),) = db.execute(
            "SELECT f_table_name, f_geometry_column, useAsDefault, styleQML FROM layer_styles"
        )
    assert (table, column, default) == ("measurements", "geom", 1)
    (renderer,) = ElementTree.fromstring(qml)
    assert renderer.get("type") == "graduatedSymbol"
    ranges = [(float(r.get("lower", "")), float(r.get("upper", ""))) for r in renderer.iter("range")]
    symbols = [r.get("symbol") for r in renderer.iter("range")]
    assert symbols == [symbol.get("name") for symbol in renderer.iter("symbol")]
    colours = [option.get("value") for option in renderer.iter("Option") if option.get("name") == "color"]
    return renderer.get("attr"), ranges, colours


def test_a_geopackage_has_the_tables_of_its_standard(tmp_path: Path) -> None:
    data = mission()
    out, done = exported(tmp_path, "gpkg", data)
    assert (done.data, done.left_out.total()) == (len(data), 0)
    assert out.read_bytes()[68:72] == b"GPKG"
    with closing(sqlite3.connect(out)) as db:
        assert db.execute("PRAGMA user_version").fetchall() == [(10300,)]
        assert db.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
        assert db.execute("PRAGMA foreign_key_check").fetchall() == []
        assert db.execute("SELECT srs_id FROM gpkg_spatial_ref_sys ORDER BY srs_id").fetchall() == [
            (-1,),
            (0,),
            (4326,),
        ]
        contents = db.execute("SELECT table_name, data_type, min_x, min_y, max_x, max_y FROM gpkg_contents").fetchall()
        assert contents[0] == ("measurements", "features", -70.654321, -33.123456, 8.25, 47.5)
        assert [row[:2] for row in contents[1:]] == [("data", "attributes"), ("layer_styles", "attributes")]
        blob, id = db.execute("SELECT geom, id FROM measurements").fetchone()
        # By hand: GP, version 0, little endian without an envelope, 4326; PointZ 8.25 47.5 412.5.
        assert blob.hex() == (
            "4750" "00" "01" "e6100000" "01" "e9030000" "0000000000802040" "0000000000c04740" "0000000000c87940"
        )  # fmt: skip
        assert id == "7-0123abcd-0"
        names = db.execute("SELECT file FROM data WHERE file IS NOT NULL ORDER BY fid").fetchall()
        assert [name for (name,) in names] == list(HOSTILE)


@needs_gdal
def test_gdal_reads_a_geopackage(tmp_path: Path) -> None:
    out, _ = exported(tmp_path, "gpkg", mission())
    out = out.rename(tmp_path / "out.gpkg")
    said = gdal("ogrinfo", "-so", out, "measurements")
    assert f"Feature Count: {PLACED}" in said
    assert "Geometry: 3D Point" in said
    assert "Extent: (-70.654321, -33.123456) - (8.250000, 47.500000)" in said
    assert "created_utc: DateTime" in said
    assert 'ID["EPSG",4326]' in said
    first, *_ = features(out, "measurements")
    assert first["geometry"]["coordinates"] == [8.25, 47.5, 412.5]
    assert (first["properties"]["id"], first["properties"]["risk"]) == ("7-0123abcd-0", pytest.approx(0.5, abs=1e-4))
    others = features(out, "data")
    assert len(others) == len(mission()) - PLACED
    assert {other["geometry"] for other in others} == {None}
    assert "=cmd()" in [other["properties"]["file"] for other in others]


def test_readings_of_one_unit_have_the_colours_of_their_dose(tmp_path: Path) -> None:
    readings = [0.125] * 50 + [0.25] * 25 + [0.5] * 15 + [4.0] * 8 + [64.0, 1e30]
    data = [measured(n, reading=reading) for n, reading in enumerate(readings)]
    out, _ = exported(tmp_path, "gpkg", [*data, measured(200, reading=None)])
    value, ranges, colours = styled(out)
    assert value == 'coalesce("reading", -1)'
    # One wild reading takes no colour away from the others.
    assert ranges == [(-1, -1), (0.125, 0.25), (0.25, 0.25), (0.25, 0.5), (0.5, 4), (4, pytest.approx(1e30))]
    assert colours[1:] == VIRIDIS
    with closing(sqlite3.connect(out)) as db:
        least, most = db.execute("SELECT min(reading), max(reading) FROM measurements").fetchone()
    assert (least, most) == (ranges[1][0], ranges[-1][1])


@pytest.mark.parametrize("data", [[], [nowhere(0)], [measured(0), measured(1, unit="cpm")]], ids=["none", "one", "two"])
def test_readings_that_cannot_be_compared_have_the_colours_of_their_risk(data: list[Datum], tmp_path: Path) -> None:
    out, _ = exported(tmp_path, "gpkg", data)
    value, ranges, colours = styled(out)
    assert value == "risk"
    assert ranges == [(n / 5, (n + 1) / 5) for n in range(5)]
    assert colours == VIRIDIS


# -- bGeigie -----------------------------------------------------------------------------------------------------------


def test_a_sentence_is_that_of_a_bgeigie(tmp_path: Path) -> None:
    out, _ = exported(tmp_path, "bgeigie", [measured(0, reading=0.75)])
    (log,) = out.iterdir()
    assert log.name == "drone-7-2026-11-22.LOG"
    *head, line = log.read_bytes().split(b"\r\n")[:-1]
    assert head == [b"# NEW LOG", b"# format=1.3.5nano", b"# deadtime=on"]
    # 0.75 uSv/h are 250.5 counts a minute; 47.5 degrees are 47 degrees and 30 minutes.
    body = b"BNRDD,7,2026-11-22T11:58:20Z,250,21,250,A,4730.0000,N,00815.0000,E,412.50,A,0,0"
    checksum = 0
    for byte in body:
        checksum ^= byte
    assert line == b"$" + body + b"*" + f"{checksum:02X}".encode()


@pytest.mark.parametrize(("unit", "reading", "cpm"), [("cpm", 40.4, 40), ("cps", 2.0, 120), ("usvh", 1.0, 334)])
def test_readings_become_counts_a_minute(unit: str, reading: float, cpm: int, tmp_path: Path) -> None:
    out, _ = exported(tmp_path, "bgeigie", [measured(0, reading=reading, unit=unit)])
    (log,) = out.iterdir()
    (record,) = read_bgeigie(io.BytesIO(log.read_bytes())).records
    assert record.cpm == cpm


@pytest.mark.parametrize(
    ("datum", "why"),
    [
        (measured(0, unit="counts"), "unit counts"),
        (measured(0, unit=None), "unit unknown: set risk.unit on the drone"),
        (measured(0, reading=None), "no reading"),
        (measured(0, reading=-1.0), "reading below 0 or too high"),
        (measured(0, reading=1e9, unit="cpm"), "reading below 0 or too high"),
        (measured(0, latitude=91.0), "no position"),
        (measured(0, longitude=-181.0), "no position"),
        (measured(0, altitude=1e6), "altitude too high"),
        (measured(0)._replace(at_least=True), "possibly older than its date"),
        (measured(0)._replace(hops=255), "time not known to 60 s"),
        (measured(0, ago_s=-1e13), "possibly older than its date"),
        (nowhere(0, local=(1.0, 2.0, 3.0)), "no position"),
        (put(0, Kind.BYTES, b"hello"), "no measurement"),
    ],
    ids=str,
)
def test_what_a_log_cannot_hold_is_left_out_and_why(datum: Datum, why: str, tmp_path: Path) -> None:
    out, done = exported(tmp_path, "bgeigie", [datum])
    assert done == Exported(0, Counter([why]), [])
    assert list(out.iterdir()) == []


def test_without_a_date_nothing_can_be_uploaded(tmp_path: Path) -> None:
    _, done = exported(tmp_path, "bgeigie", [measured(0)], trusted=False)
    assert (done.data, done.left_out) == (0, {"time unknown: set node.clock": 1})


def test_each_drone_and_day_has_a_log_in_order_of_time(tmp_path: Path) -> None:
    ago = (3600.0, 100.0, 60_000.0, 7200.0, 200.0)
    data = [measured(n, s, drone=drone, reading=n) for drone in (7, 12) for n, s in enumerate(ago)]
    out, done = exported(tmp_path, "bgeigie", data)
    assert (done.data, done.left_out.total()) == (10, 0)
    assert sorted(done.files) == sorted(out.iterdir())
    for drone in (7, 12):
        for day, expected in (("2026-11-21", [2]), ("2026-11-22", [3, 0, 4, 1])):
            log = read_bgeigie(io.BytesIO((out / f"drone-{drone}-{day}.LOG").read_bytes()))
            assert (log.rejected, [record.device for record in log.records]) == (0, [drone] * len(expected))
            lines = (out / f"drone-{drone}-{day}.LOG").read_text().splitlines()[3:]
            assert [line.split(",")[3] for line in lines] == [str(round(n * 334)) for n in expected]


def test_many_logs_need_few_open_files(tmp_path: Path) -> None:
    data = [measured(n, drone=drone, ago_s=ago) for drone in range(200) for n, ago in enumerate((100.0, 60_000.0))]
    stored(tmp_path / "base.db", data)
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(map(int, os.listdir("/dev/fd"))) + 20, before[1]))
    try:
        with archive(tmp_path / "base.db") as source:
            done = format_of("bgeigie").write(source.entries(), tmp_path / "out", source)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)
    assert (done.data, len(done.files)) == (400, 400)


def test_the_whole_mission_is_read_back(tmp_path: Path) -> None:
    out, done = exported(tmp_path, "bgeigie", mission())
    assert (done.data, done.left_out.total()) == (SAFECAST, len(mission()) - SAFECAST)
    (log,) = out.iterdir()
    found = read_bgeigie(io.BytesIO(log.read_bytes()))
    assert (found.read, found.rejected, found.trouble) == (SAFECAST, 0, "")
    southern = found.records[-1].place
    assert southern == pytest.approx((-33.123456, -70.654321, -12.5), abs=1e-6)


def test_pynmeagps_takes_every_line_for_a_sentence(tmp_path: Path) -> None:
    """Its frame and its checksum are those of NMEA 0183."""
    nmea: Any = pytest.importorskip("pynmeagps", reason="pynmeagps is not installed (extra interop)")
    out, _ = exported(tmp_path, "bgeigie", mission())
    (log,) = out.iterdir()
    lines = [line for line in log.read_bytes().splitlines(keepends=True) if line.startswith(b"$")]
    found = [nmea.NMEAReader.parse(line, validate=nmea.VALCKSUM) for line in lines]
    assert [one.identity for one in found] == ["BNRDD"] * SAFECAST
    assert found[0].payload[:3] == ["7", "2026-11-22T11:58:20Z", "250"]
    with pytest.raises(nmea.NMEAParseError):
        nmea.NMEAReader.parse(lines[0].replace(b",250,", b",251,", 1), validate=nmea.VALCKSUM)


@given(st.floats(-90.0, 90.0), st.floats(-180.0, 180.0), st.integers(-(1 << 31), (1 << 31) - 1))
def test_every_place_on_earth_is_read_back(
    tmp_path_factory: pytest.TempPathFactory, latitude: float, longitude: float, millimetres: int
) -> None:
    datum = measured(0, latitude=latitude, longitude=longitude, altitude=millimetres / 1000)
    out, done = exported(tmp_path_factory.mktemp("log"), "bgeigie", [datum])
    if abs(millimetres) > 999_999_000:
        assert done.left_out.total() == 1
        return
    (log,) = out.iterdir()
    record = some(decode_record(log.read_bytes().splitlines()[3]))
    # A ten-thousandth of a minute.
    assert record.place is not None
    assert record.place[:2] == pytest.approx((latitude, longitude), abs=1e-6)
    assert record.place.altitude == pytest.approx(millimetres / 1000, abs=0.006)


# -- files -------------------------------------------------------------------------------------------------------------


def test_files_come_out_under_safe_names(tmp_path: Path) -> None:
    data = mission()
    out, done = exported(tmp_path, "files", data)
    assert (done.data, done.left_out.total()) == (FILES, len(data) - FILES)
    index = rows(out / "index.csv")
    assert {path.name for path in out.iterdir()} == {"index.csv", *(row["file"] for row in index)}
    content = {row["id"]: (out / row["file"]).read_bytes() for row in index}
    for number, name in enumerate(HOSTILE):
        assert content[f"7-0123abcd-{20 + number}"] == name.encode() * 2
    assert content["7-0123abcd-40"] == b"\0\1\2 a line"
    names = [row["file"] for row in index]
    assert names[:3] == ["7-0123abcd-20-_.._etc_passwd", "7-0123abcd-21-=cmd()", "7-0123abcd-22-CON"]
    assert names[7:] == [
        "7-0123abcd-27.bin", "7-0123abcd-28-C__autoexec.bat", "7-0123abcd-29-bell_", "7-0123abcd-30-gpj._exe",
        "7-0123abcd-31-nul_", "7-0123abcd-40.bin",
    ]  # fmt: skip
    assert not (tmp_path.parent / "etc").exists()


def test_a_file_is_as_old_as_its_datum(tmp_path: Path) -> None:
    old = put(1, Kind.BYTES, b"x")._replace(created=LIVED_S - NOW - 1000.0)
    out, _ = exported(tmp_path, "files", [put(0, Kind.BYTES, b"x", ago_s=500.0), old])
    assert (out / "7-0123abcd-0.bin").stat().st_mtime == NOW - 500.0
    assert (out / "7-0123abcd-1.bin").stat().st_mtime == 0.0


def test_second_contents_are_files_of_their_own(tmp_path: Path) -> None:
    first, second = (put(0, Kind.FILE, pack_file("a.txt", text)) for text in (b"one", b"two"))
    stored(tmp_path / "base.db", [first])
    with closing(sqlite3.connect(tmp_path / "base.db")) as db, db:
        columns = "origin, epoch, sequence, kind, created, hops, crc, size, at_least, payload"
        db.execute(f"INSERT INTO apart ({columns}) SELECT {columns} FROM datum")
        db.execute("UPDATE apart SET crc = ?, payload = ?", (second.crc, second.payload))
    with archive(tmp_path / "base.db") as source:
        done = format_of("files").write(source.entries(), tmp_path / "out", source)
    assert done.data == 2
    found = {path.name: path.read_bytes() for path in (tmp_path / "out").glob("7-*")}
    assert found == {"7-0123abcd-0-a.txt": b"one", f"7-0123abcd-0#{second.crc:08x}-a.txt": b"two"}


@given(st.text(max_size=300), st.sampled_from(["", ".jpg", ".tar.gz", ".", ". ", "/..", "\\", "." + "x" * 300]))
def test_a_safe_name_is_safe(text: str, ending: str) -> None:
    name = safe_name("7-0123abcd-42", text.encode(errors="replace").decode() + ending)
    assert name.startswith(("7-0123abcd-42-", "7-0123abcd-42."))
    assert len(name.encode()) <= MOST_BYTES
    assert not set(name) & set('<>:"/\\|?*')
    assert name.isprintable()
    assert not name.endswith((".", " "))


@given(st.lists(st.tuples(st.integers(0, 99), st.text("0-.#aA/", max_size=5)), unique_by=lambda pair: pair[0]))
def test_safe_names_never_collide(data: list[tuple[int, str]]) -> None:
    names = {safe_name(f"7-0123abcd-{sequence}", name).casefold() for sequence, name in data}
    assert len(names) == len(data)


def test_a_long_name_keeps_its_ending() -> None:
    name = safe_name("7-0123abcd-42", "é" * 120 + ".jpg")
    assert name.endswith("é.jpg")
    assert MOST_BYTES - 1 <= len(name.encode()) <= MOST_BYTES


# -- memory ------------------------------------------------------------------------------------------------------------

FEW, MANY = 800, 5_000


def flight(number: int) -> Iterator[Datum]:
    """Measurements and files of some drones."""
    for n in range(number):
        drone, ago = n % 7, float(n * 7919 % 99_000)
        if n % 5 == 0:
            yield put(n, Kind.FILE, pack_file(f"photo-{n}.jpg", b"jpg"), drone=drone, ago_s=ago)
        elif n % 5 == 1:
            yield nowhere(n)
        else:
            yield measured(n, ago, drone=drone, latitude=47.0 + n * 1e-6, reading=n % 1000 / 100)


@pytest.fixture(scope="module")
def flights(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("flights")
    return stored(folder / "few.db", flight(FEW)), stored(folder / "many.db", flight(MANY))


@pytest.mark.no_cover
@pytest.mark.parametrize("name", names())
def test_memory_does_not_grow_with_the_data(name: str, flights: tuple[Path, Path], tmp_path: Path) -> None:
    peaks = []
    # The first time a little, for what is loaded only once.
    for number, (store, most) in enumerate(((flights[0], 100), (flights[0], FEW), (flights[1], MANY))):
        with Archive(store, lambda: NOW) as source:
            tracemalloc.start()
            try:
                done = format_of(name).write(islice(source.entries(), most), tmp_path / str(number), source)
                peaks.append(tracemalloc.get_traced_memory()[1])
            finally:
                tracemalloc.stop()
        assert done.data + done.left_out.total() == most
    # Below a MiB Python's own caches are what differs. 4,200 data more would show if so much as their ids were kept.
    assert peaks[2] < 1.3 * max(peaks[1], 1 << 20)


def test_the_date_of_the_mission() -> None:
    assert iso(NOW) == "2026-11-22T12:00:00.000Z"

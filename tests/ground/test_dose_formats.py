"""ANSI N42.42, IRIX and ERS: dose rates, as programs of others read them, and by the schemas that are published."""

from __future__ import annotations

import csv
import io
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from lxml import etree

from rass_mav.core.datum import Datum, Kind
from rass_mav.ground.formats import format_of
from tests.extent import extents
from tests.patience import PATIENCE_S
from tests.some import some

from .exports import exported
from .mission_stores import archive, measured, mission, nowhere, put, stored
from .published import breaks, ers_breaks

#: What others have published, and is not part of the repository: n42.xsd of NIST, the folder of the IAEA's IRIX.xsd,
#: gpx.xsd of Topografix, and for ERS the source of SURO's converter.
PUBLISHED = Path(__file__).parents[3] / "shared" / "data" / "formats"
N42 = {"n": "http://physics.nist.gov/N42/2011/N42"}
IRIX = {
    name: f"http://www.iaea.org/2012/IRIX/Format/{space}"
    for name, space in (("id", "Identification"), ("meas", "Measurements"), ("loc", "Locations"))
}
NAMES = ("ers", "irix", "n42")
#: Of `mission`: the dose rates with a time, and those of them with a place on Earth.
DATED, PLACED = 5, 2


def adversary() -> list[Datum]:
    """Dose rates at the ends of what the wire can carry, and second contents of ids."""
    return [
        *mission(),
        measured(100, reading=3.4028234663852886e38, altitude=2147483.647, longitude=180.0, latitude=90.0),
        measured(101, reading=1e-45, altitude=-2147483.648, longitude=-180.0, latitude=-90.0),
        measured(102, reading=0.0, error_m=6553.5, drone=65534),
        measured(103, reading=-0.0),
        measured(104, reading=-1.0),
        measured(105, reading=float("nan")),
        measured(106)._replace(created=float("-inf")),
        measured(107)._replace(created=float("inf")),
        measured(108, ago_s=-1e13),
    ]


def schema(path: str) -> etree.XMLSchema:
    if not (PUBLISHED / path).exists():
        pytest.skip("needs ../shared/data/formats, which is not part of the repository")
    return etree.XMLSchema(etree.parse(PUBLISHED / path))


@pytest.mark.parametrize(("name", "xsd"), [("n42", "n42.xsd"), ("irix", "irix-1.0/IRIX.xsd"), ("gpx", "gpx.xsd")])
def test_the_published_schema_accepts_it(name: str, xsd: str, tmp_path: Path) -> None:
    valid = schema(xsd)
    out, done = exported(tmp_path, name, adversary(), apart=[measured(0, reading=9.0)])
    assert done.data > PLACED
    valid.assertValid(etree.parse(out))


@pytest.mark.parametrize("name", ["n42", "irix", "gpx"])
def test_elements_are_in_the_published_order_and_have_what_they_must(name: str, tmp_path: Path) -> None:
    out, _ = exported(tmp_path, name, adversary(), apart=[measured(0, reading=9.0)])
    assert breaks(name, ElementTree.parse(out).getroot()) == []


def test_a_break_of_the_published_order_is_noticed(tmp_path: Path) -> None:
    out, _ = exported(tmp_path, "n42", [measured(0)])
    root = ElementTree.parse(out).getroot()
    one = some(root.find("n:RadMeasurement", N42))
    one.append(some(one.find("n:StartDateTime", N42)))
    one.remove(some(one.find("n:RealTimeDuration", N42)))
    del one.attrib["id"]
    found = breaks("n42", root)
    assert "RadMeasurement: no id" in found
    assert "RadMeasurement: no RealTimeDuration" in found
    assert any(text.startswith("RadMeasurement: order of ") for text in found)


@pytest.mark.parametrize("name", NAMES)
def test_what_is_left_out_is_counted_by_reason(name: str, tmp_path: Path) -> None:
    data = mission()
    _, done = exported(tmp_path, name, data)
    placed = name != "n42"
    assert done.data == (PLACED if placed else DATED)
    assert done.left_out.total() == len(data) - done.data
    assert done.left_out["no measurement"] == 17
    assert done.left_out["no position"] == (DATED - PLACED if placed else 0)
    assert done.left_out["unit cpm, no dose rate: set sensor.unit on the drone to usvh"] == 1
    assert done.left_out["unit unknown: set risk.unit on the drone"] == 1
    assert done.left_out["possibly older than its date"] == 1


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    ("datum", "why"),
    [
        (measured(0, reading=-1.0), "reading below 0"),
        (measured(0, reading=float("nan")), "no reading"),
        (measured(0, ago_s=-1e13), "possibly older than its date"),
        (measured(0)._replace(hops=255), "time not known to 60 s"),
        (put(0, Kind.MEASUREMENT, b"\1"), "no measurement"),
    ],
    ids=str,
)
def test_no_wild_value_gets_in(name: str, datum: Datum, why: str, tmp_path: Path) -> None:
    out, done = exported(tmp_path, name, [datum])
    assert (done.data, done.left_out) == (0, {why: 1})
    assert out.exists()


@pytest.mark.parametrize("name", NAMES)
def test_without_a_date_a_setting_is_named(name: str, tmp_path: Path) -> None:
    _, done = exported(tmp_path, name, [measured(0), measured(1)], trusted=False)
    assert (done.data, done.left_out) == (0, {"time unknown: set node.clock": 2})


# -- N42 ---------------------------------------------------------------------------------------------------------------


def test_n42_has_a_detector_a_drone_and_ids_of_their_own(tmp_path: Path) -> None:
    data = [measured(n, drone=drone) for drone in (12, 7) for n in range(3)]
    out, _ = exported(tmp_path, "n42", data, apart=[measured(0, reading=9.0)])
    root = ElementTree.parse(out).getroot()
    assert [one.get("id") for one in root.findall("n:RadDetectorInformation", N42)] == ["drone-7", "drone-12"]
    ids = [element.get("id", "") for element in root.iter() if element.get("id")]
    assert len(ids) == len(set(ids))
    assert all(re.fullmatch(r"[A-Za-z][\w.-]*", id, re.ASCII) for id in ids)
    rates = [float(value.text or "") for value in root.iterfind(".//n:DoseRateValue", N42)]
    assert sorted(rates) == [0.75] * 6 + [9.0]


def test_n42_says_what_is_a_placeholder(tmp_path: Path) -> None:
    """A reader must not take an element for measured that only the schema or a program demands."""
    out, _ = exported(tmp_path, "n42", [measured(0)])
    root = ElementTree.parse(out).getroot()
    said = " ".join(remark.text or "" for remark in root.findall("n:Remark", N42))
    assert "No spectra were measured" in said
    assert "RealTimeDuration is a placeholder" in said
    (spectrum,) = root.iterfind(".//n:Spectrum", N42)
    assert [spectrum.findtext(f"n:{name}", namespaces=N42) for name in ("LiveTimeDuration", "ChannelData")] == [
        "PT0S",
        "0",
    ]


def test_specutils_reads_n42(tmp_path: Path) -> None:
    """SpecUtils, with which InterSpec and Cambio read it."""
    specutils: Any = pytest.importorskip("SpecUtils", reason="sandiaspecutils is not installed (extra interop)")
    data = [measured(0, error_m=2.5), measured(1, 50.0, reading=0.001, drone=12), nowhere(2, reading=7.0)]
    out, _ = exported(tmp_path, "n42", [*data, *adversary()[11:]])
    found = specutils.SpecFile()
    found.loadFile(str(out), specutils.ParserType.Auto)
    assert found.parseWarnings() == []
    first, second, third, *_ = (
        one for one in found.measurements() if one.remarks()[0] in {str(datum.id) for datum in data}
    )
    assert str(first.startTime()) == "2026-11-22 11:58:20"
    assert (first.latitude(), first.longitude(), first.detectorName()) == (47.5, 8.25, "drone-7")
    assert first.remarks()[1:3] == ["412.50 m above mean sea level", "position right to 2.5 m"]
    assert (first.gammaCountSum(), first.liveTime()) == (0.0, 0.0)
    assert not second.hasGpsInfo()
    assert (third.detectorName(), str(third.startTime())) == ("drone-12", "2026-11-22 11:59:10")
    # It shows no dose rates in Python, but keeps them.
    again = io.BytesIO()
    n42 = specutils.SaveSpectrumAsType.N42_2012
    found.writeToStream(again, found.sampleNumbers(), found.detectorNumbers(), n42)
    rates = [float(rate) for rate in re.findall("<DoseRateValue>(.*?)<", again.getvalue().decode())]
    assert sorted(rates)[:3] == pytest.approx([0.0, 0.0, 0.001], abs=1e-9)
    assert {0.75, 7.0} <= set(rates)


# -- IRIX --------------------------------------------------------------------------------------------------------------


def test_irix_has_a_data_set_a_second_in_sieverts_per_second(tmp_path: Path) -> None:
    data = [measured(n, 100.0 - n / 4, drone=7 + n % 2, reading=3.6) for n in range(8)]
    out, done = exported(tmp_path, "irix", data)
    assert done.data == 8
    root = ElementTree.parse(out).getroot()
    sets = root.findall("meas:Measurements/meas:DoseRate", IRIX)
    starts = [one.findtext("meas:MeasuringPeriod/meas:StartTime", namespaces=IRIX) for one in sets]
    assert starts == ["2026-11-22T11:58:20Z", "2026-11-22T11:58:21Z"]
    assert [len(one.findall("meas:Measurements/meas:Measurement", IRIX)) for one in sets] == [4, 4]
    for value in root.iterfind(".//meas:Value", IRIX):
        assert value.get("Unit") == "Sv/s"
        assert float(value.text or "") == pytest.approx(1e-9)
    section = root.find("meas:Measurements", IRIX)
    assert section is not None
    assert section.get("ValidAt") == "2026-11-22T11:58:21Z"


def test_irix_names_no_organisation_and_calls_nothing_an_emergency(tmp_path: Path) -> None:
    """Whoever sends the report states that."""
    reports = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        out, _ = exported(tmp_path / name, "irix", [measured(0)])
        reports.append(ElementTree.parse(out).getroot())
    first, second = (report.findtext("id:Identification/id:ReportUUID", namespaces=IRIX) for report in reports)
    assert first != second
    identification = reports[0].find("id:Identification", IRIX)
    assert identification is not None
    assert identification.findtext("id:OrganisationReporting", namespaces=IRIX) == "not-stated.invalid"
    assert identification.findtext("id:ReportContext", namespaces=IRIX) == "Test"


# -- ERS ---------------------------------------------------------------------------------------------------------------


def test_ers_has_the_same_identifiers_in_each_line(tmp_path: Path) -> None:
    out, done = exported(tmp_path, "ers", adversary(), apart=[measured(0, reading=9.0)])
    text = out.read_bytes().decode("ascii")
    assert "\r" not in text
    assert ers_breaks(text) == []
    lines = [line for line in text.splitlines() if line.startswith("PA ")]
    assert len(lines) == done.data
    for line in lines:
        fields = dict(field.split(" ", 1) for field in line.split(";"))
        assert abs(float(fields["PN"])) <= 90.0
        assert 0.0 <= float(fields["DHSR"]) < float("inf")


def test_a_break_of_ers_is_noticed(tmp_path: Path) -> None:
    out, _ = exported(tmp_path, "ers", [measured(0), measured(1)])
    text = out.read_text()
    first, second = (line for line in text.splitlines() if line.startswith("PA "))
    for line, other, found in (
        (second, second.replace(";PZ ", ";PQ "), "PQ is not known"),
        (second, second.replace(";PB drone 7", ""), "other identifiers: PA CD CT PE PN PZ DHSR"),
        (second, ";".join(second.split(";")[1:]), "PB begins a record"),
        (second, second.replace("drone 7", "drone 7, a counter"), "a comma in a record"),
        (first, re.sub("CT [^;]*", "CT 11h58", first), "CT: 11h58"),
        ("IPC WGS84\n", "", "no IPC before the records"),
    ):
        assert found in ers_breaks(text.replace(line, other))


def test_ers_is_in_order_of_time_for_each_drone(tmp_path: Path) -> None:
    data = [measured(n, ago, drone=drone) for drone in (12, 7) for n, ago in enumerate((100.0, 300.0, 200.0))]
    out, _ = exported(tmp_path, "ers", data)
    names = [line.split(";")[0] for line in out.read_text().splitlines() if line.startswith("PA ")]
    assert names == [f"PA {drone}-0123abcd-{n}" for drone in (7, 12) for n in (1, 2, 0)]


@pytest.mark.skipif(
    not (PUBLISHED / "ERS2CSV-converter.cpp").exists(),
    reason="needs ../shared/data/formats, which is not part of the repository",
)
@pytest.mark.skipif(shutil.which("g++") is None, reason="g++ is not installed (Debian: apt install g++)")
def test_suros_converter_reads_ers(tmp_path: Path) -> None:
    program = tmp_path / "ERS2CSV-converter"
    source = PUBLISHED / "ERS2CSV-converter.cpp"
    subprocess.run(["g++", "-std=c++17", "-o", program, source], check=True, timeout=PATIENCE_S)
    out, done = exported(tmp_path, "ers", adversary())
    (tmp_path / "input").mkdir()
    out.rename(tmp_path / "input" / "mission.ers")
    subprocess.run([program], cwd=tmp_path, check=True, timeout=PATIENCE_S, stdin=subprocess.DEVNULL)
    with (tmp_path / "output" / "mission_2_data.csv").open(newline="") as file:
        found = list(csv.DictReader(file))
    assert len(found) == done.data
    first = next(row for row in found if row["PA"] == "7-0123abcd-0")
    assert (first["CD"], first["CT"], first["PB"]) == ("2026-11-22", "11:58:20", "drone 7")
    assert [float(first[name]) for name in ("PE", "PN", "PZ", "DHSR")] == [8.25, 47.5, 412.5, 0.75]


# -- tens of thousands -------------------------------------------------------------------------------------------------


@pytest.mark.no_cover
@pytest.mark.parametrize("number", extents(3_000, 20_000))
def test_thousands_of_dose_rates(number: int, tmp_path: Path) -> None:
    """Their memory is in tests/ground/test_formats.py."""
    store = stored(tmp_path / "base.db", (measured(n, n * 7919 % 90_000 / 10, drone=n % 5) for n in range(number)))
    for name in NAMES:
        with archive(store) as source:
            assert format_of(name).write(source.entries(), tmp_path / name, source).data == number
    lines = (tmp_path / "ers").read_text().splitlines()
    assert sum(line.startswith("PA ") for line in lines) == number

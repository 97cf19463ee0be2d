"""Cursor on Target: what a mission shows on a map of TAK."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from xml.etree import ElementTree

import pytest
from lxml import etree

from rass_mav.core.datum import Datum, Kind
from rass_mav.ground.attention.watch import Rules
from rass_mav.ground.cot import (
    BASE,
    DELETION,
    DRONE,
    LINE,
    MOST_LINES,
    MOST_NODES,
    MOST_POINTS,
    SPOT,
    STALE_S,
    Event,
    Picture,
    deletion,
)
from rass_mav.ground.entry import iso
from rass_mav.wire.nodestatus import NodeStatus, encode_status

from .cut_files import data_of
from .mission_stores import HOSTILE, NOW, archive, measured, mission, nowhere, put, stored
from .published import breaks
from .test_dose_formats import PUBLISHED

TAKCOT = PUBLISHED / "takcot"
MITRE = TAKCOT / "mitre" / "CoT Base-Event Schema  (PUBLIC RELEASE).xsd"
PLACE = (47.25, 8.5)


def picture(folder: Path, data: Iterable[Datum], rules: Rules | None = None) -> Picture:
    found = Picture(1)
    found.rules = rules or Rules()
    with archive(stored(folder / "base.db", data)) as source:
        found.take(source.entries())
    return found


def shown(found: Picture, now: float = NOW) -> dict[str, ElementTree.Element]:
    return {event.uid: ElementTree.fromstring(event.xml(now)) for event in found.events(now)}


def of_type(events: dict[str, ElementTree.Element], type: str) -> list[ElementTree.Element]:
    return [event for event in events.values() if event.get("type") == type]


def status(drone: int, place: tuple[float, float] | None, battery: int | None = None, *, base: bool = False) -> Datum:
    found = NodeStatus(1, 0, 0, None, 0.0, 1, battery, place, {}, {}, base=base)
    return put(50, Kind.STATUS, encode_status(found), drone=drone, ago_s=10.0)


def hot(step: float = 1e-4) -> list[Datum]:
    """Readings that rise towards the middle of a square of 20 by 20 places."""
    return [
        measured(
            row * 20 + column, 60.0, latitude=47.0 + row * step, longitude=8.0 + column * step,
            reading=500.0 / (1 + (row - 10) ** 2 + (column - 10) ** 2), risk=1.0 if row == column == 10 else 0.5,
        )
        for row in range(20) for column in range(20)
    ]  # fmt: skip


def test_a_drone_is_where_it_was_last_with_its_last_reading(tmp_path: Path) -> None:
    data = [measured(0, 100.0), measured(1, 20.0, latitude=47.6, error_m=2.5), measured(2, 60.0, latitude=1.0)]
    (event,) = shown(picture(tmp_path, [*data, status(7, None, 80)])).values()
    assert (event.get("uid"), event.get("type"), event.get("how")) == ("rass-7", DRONE, "m-g")
    assert (event.get("start"), event.get("stale")) == (iso(NOW - 20.0), iso(NOW - 20.0 + STALE_S))
    point = event.find("point")
    assert point is not None
    assert (point.get("lat"), point.get("lon"), point.get("ce")) == ("47.6000000", "8.2500000", "2.5")
    # CoT means the height above the ellipsoid, which nobody knows here.
    assert point.get("hae") == "9999999.0"
    assert event.findtext("detail/remarks") == "0.75 uSv/h, risk 0.50"
    assert [one.get("callsign") for one in event.iter("contact")] == ["drone 7"]
    assert [one.get("battery") for one in event.iter("status")] == ["80"]


def test_a_place_that_is_too_old_is_not_sent(tmp_path: Path) -> None:
    found = picture(tmp_path, [measured(0, 100.0)])
    assert list(shown(found, NOW - 100.0 + STALE_S)) == ["rass-7"]
    assert list(shown(found, NOW - 99.0 + STALE_S)) == []


def test_the_base_is_where_it_says_or_where_its_configuration_does(tmp_path: Path) -> None:
    data = [status(3, PLACE, base=True), measured(0)]
    (heard,) = of_type(shown(picture(tmp_path, data)), BASE)
    assert (heard.get("uid"), heard.findtext("detail/remarks")) == ("rass-3", "")
    (tmp_path / "a").mkdir()
    (fixed,) = shown(picture(tmp_path / "a", [], Rules(base=(1, (1.0, 2.0))))).values()
    point = fixed.find("point")
    assert point is not None
    assert (fixed.get("uid"), point.get("lat"), point.get("lon")) == ("rass-1", "1.0000000", "2.0000000")


def test_hot_spots_and_contours(tmp_path: Path) -> None:
    found = picture(tmp_path, hot())
    events = shown(found)
    (spot,) = of_type(events, SPOT)
    assert spot.get("uid") == "rass-hot-spot-7-0123abcd-210"
    assert spot.findtext("detail/remarks") == "hot spot: 500 uSv/h, drone 7"
    lines = of_type(events, LINE)
    assert {event.get("uid") for event in lines} == {f"rass-1-contour-usvh-{level}-1" for level in (25, 100)} | {
        event.get("uid") for event in lines if "-usvh-1-" in (event.get("uid") or "")
    }
    for event in lines:
        places = [one.get("point", "") for one in event.iter("link")]
        assert 2 <= len(places) <= MOST_POINTS
        assert all(re.fullmatch(r"47\.\d{7},8\.\d{7}|46\.99\d{5},8\.\d{7}|47\.\d{7},7\.99\d{5}", one) for one in places)
    assert [event.findtext("detail/remarks") for event in lines if "-100-" in (event.get("uid") or "")] == [
        "along this line 100 uSv/h"
    ]


def test_contours_are_drawn_again_only_after_a_change(tmp_path: Path) -> None:
    found = picture(tmp_path, hot())
    first = [event for event in found.events(NOW) if event.type == LINE]
    again = [event for event in found.events(NOW + 1) if event.type == LINE]
    assert [id(event) for event in again] == [id(event) for event in first]
    found.rules = Rules(contours=(50.0,))
    at_once = [event for event in found.events(NOW + 0.1) if event.type == LINE]
    assert [id(event) for event in at_once] == [id(event) for event in first]
    (later,) = {event.uid.rsplit("-", 1)[0] for event in found.events(NOW + 60) if event.type == LINE}
    assert later == "rass-1-contour-usvh-50"


@pytest.mark.no_cover
def test_what_is_forged_stays_within_bounds_and_is_well_formed(tmp_path: Path) -> None:
    flood = [measured(0, drone=drone, latitude=drone * 1e-3, risk=1.0, reading=drone) for drone in range(1, 700)]
    noise = [
        measured(n, drone=7, latitude=47 + n % 61 * 1e-4, longitude=8 + n // 61 * 1e-4, reading=n * 7919 % 200)
        for n in range(1, 4000)
    ]
    names = [datum for n, name in enumerate(HOSTILE) for datum in data_of(name, b"x", 5000 + 10 * n)]
    wild = [measured(9000, reading=3.4e38, risk=1.0, longitude=180.0, drone=9), nowhere(9001, drone=9)]
    events = shown(picture(tmp_path, [*mission(), *flood, *noise, *names, *wild]))
    assert len(of_type(events, DRONE)) == MOST_NODES
    assert len(of_type(events, SPOT)) <= 20
    assert len(of_type(events, LINE)) <= MOST_LINES
    for event in events.values():
        text = ElementTree.tostring(event)
        # An event fits a datagram.
        assert len(text) < 20_000
        assert not re.search(rb'="(nan|-?inf)"', text)


def test_a_deletion_names_what_goes() -> None:
    event = ElementTree.fromstring(deletion("rass-1-contour-usvh-25-1").xml(NOW))
    assert event.get("type") == DELETION
    assert event.get("uid") != "rass-1-contour-usvh-25-1"
    assert [one.get("uid") for one in event.iter("link")] == ["rass-1-contour-usvh-25-1"]
    assert len(list(event.iter("__forcedelete"))) == 1


def test_a_start_in_the_future_is_now() -> None:
    """The clocks of a drone and of this computer may differ."""
    event = ElementTree.fromstring(Event("a", DRONE, "m-g", PLACE, "", None, NOW + 5.0).xml(NOW))
    assert event.get("start") == event.get("time") == iso(NOW)


def schemas_of_atak(folder: Path) -> dict[str, etree.XMLSchema]:
    """Its schemas of a marker and of a drawing, by type, with what keeps them from use corrected: the colour of a line
    has 32 bits, where a byte has room for white only; that of links, which no marker of ours has, is well-formed."""
    for file in (TAKCOT / "xsd").rglob("*.xsd"):
        copy = folder / file.relative_to(TAKCOT / "xsd")
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_text(file.read_text())
    stroke, link = (folder / "details" / f"{name}.xsd" for name in ("strokeColor", "link"))
    assert "xs:byte" in stroke.read_text()
    stroke.write_text(stroke.read_text().replace("xs:byte", "xs:int"))
    link.write_text('<xs:schema xmlns:xs="http://www.w3.org/2001/XMLSchema"><xs:complexType name="link"/></xs:schema>')
    marker, line = (
        etree.XMLSchema(etree.parse(folder / f"{name}.xsd")) for name in ("Marker - Spot", "Drawing Shapes - Free Form")
    )
    return {DRONE: marker, BASE: marker, SPOT: marker, LINE: line}


def test_events_have_what_the_published_schema_of_an_event_demands(tmp_path: Path) -> None:
    found = picture(tmp_path, [*hot(), status(3, PLACE, base=True), status(8, PLACE, 50)])
    events = [*found.events(NOW), deletion("rass-1")]
    assert {event.type for event in events} == {DRONE, BASE, SPOT, LINE, DELETION}
    assert [breaks("cot", ElementTree.fromstring(event.xml(NOW))) for event in events] == [[]] * len(events)


@pytest.mark.skipif(not TAKCOT.exists(), reason="needs ../shared/data/formats, which is not part of the repository")
def test_the_published_schemas_accept_the_events(tmp_path: Path) -> None:
    """MITRE's of an event and its list of types, and ATAK's of each kind."""
    schemas = schemas_of_atak(tmp_path / "xsd")
    found = picture(tmp_path, [*hot(), status(3, PLACE, base=True), status(8, PLACE, 50)])
    events = [*found.events(NOW), deletion("rass-1")]
    assert {event.type for event in events} == {DRONE, BASE, SPOT, LINE, DELETION}
    every = etree.XMLSchema(etree.parse(MITRE))
    for event in events:
        parsed = etree.fromstring(event.xml(NOW))
        every.assertValid(parsed)
        if event.type in schemas:
            schemas[event.type].assertValid(parsed)
    types = (PUBLISHED / "CoTtypes.xml").read_text()
    for type in (DRONE, BASE):
        assert f'cot="{type.replace("a-f-", "a-.-")}"' in types

"""Whatever drones say, the page and the report go on, and what they show is bounded and can be read."""

from __future__ import annotations

import json
import re
import struct
from typing import Any, NamedTuple

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from rass_mav.app.payloads import pack_file
from rass_mav.core.datum import DatumId, Fate, Kind, datum_crc
from rass_mav.core.store import StoredInfo
from rass_mav.ground import field, html
from rass_mav.ground.archive import content
from rass_mav.ground.attention.conditions import rows
from rass_mav.ground.attention.watch import Watch
from rass_mav.ground.entry import Entry
from rass_mav.ground.page import model
from rass_mav.ground.page.model import Mission
from rass_mav.wire.measurement import UNITS, Measurement
from tests.ground.test_html import Strict

from .test_model import NOW, Browser

SMALL = {"MOST_DRONES": 4, "MOST_PLACES": 6, "MOST_STATUSES": 5, "MOST_COUNTS": 5, "MOST_DRAWN": 5}
SQUARES = 8

ends_16, ends_32 = st.sampled_from((0, 1, 2, 0xFFFE, 0xFFFF)), st.sampled_from((0, 1, 2, 0xFFFFFFFE, 0xFFFFFFFF))
ids = st.builds(DatumId, ends_16 | st.integers(0, 9), ends_32, ends_32 | st.integers(0, 9))
times = st.sampled_from((NOW, NOW + 1, NOW - 1e7, 0.0, -0.0, 1e300, -1e300, 5e-324)) | st.floats(-1e300, 1e300)
latitudes = st.sampled_from((90.0, -90.0, 0.0, 47.0, 1e300, float("nan"))) | st.floats(-100, 100)
longitudes = st.sampled_from((180.0, -180.0, 0.0, 8.0, -1e300, float("inf"))) | st.floats(-200, 200)
readings = (
    st.none() | st.sampled_from((3.4028234663852886e38, -3.4e38, 1e308, -1e308, 1e-45, 5e-324, 0.0)) | st.floats()
)
measurements = st.builds(
    Measurement, latitudes, longitudes, st.just(0.0), readings, st.floats(0, 1),
    unit=st.none() | st.sampled_from(sorted(UNITS)),
)  # fmt: skip
#: As they are on the wire, with all that the format can hold.
raw_measurements = st.builds(
    lambda flags, latitude, longitude, bits, unit: (
        struct.pack("<BBiiiIHBH", 1, flags, latitude, longitude, 0, bits, 0, unit, 0)
    ),
    st.integers(0, 31), st.integers(-(2**31), 2**31 - 1), st.integers(-(2**31), 2**31 - 1),
    st.sampled_from((0x7F7FFFFF, 0xFF7FFFFF, 1, 0x7F800000, 0x7FC00000)) | st.integers(0, 2**32 - 1),
    st.integers(0, 6),
)  # fmt: skip
raw_statuses = st.builds(
    lambda flags, head, neighbours, origins: (
        bytes([1, flags])
        + head
        + bytes([len(neighbours) // 3])
        + neighbours[: len(neighbours) // 3 * 3]
        + bytes([len(origins) // 4])
        + origins[: len(origins) // 4 * 4]
    ),
    st.integers(0, 255), st.binary(min_size=20, max_size=20), st.binary(max_size=40), st.binary(max_size=40),
)  # fmt: skip
files = st.builds(pack_file, st.text(min_size=1, max_size=20).filter(lambda name: "\0" not in name), st.just(b""))
contents = st.one_of(
    st.tuples(st.just(int(Kind.MEASUREMENT)), raw_measurements),
    st.tuples(st.just(int(Kind.STATUS)), raw_statuses),
    st.tuples(st.just(int(Kind.FILE)), st.binary(max_size=20)),
    st.tuples(st.integers(0, 255), st.binary(max_size=60)),
)


class Arrival(NamedTuple):
    """A datum that comes, or that is said to be lost."""

    id: DatumId
    utc: float
    delay_s: float | None
    said: tuple[int, bytes] | Measurement | Fate
    apart: bool = False

    def entry(self, number: int) -> Entry:
        arrived = None if self.delay_s is None else self.utc + self.delay_s
        entry = Entry(
            number, self.id, 0, Kind.MEASUREMENT, 24, 1, self.utc, 1.0, False, 0.0, arrived=arrived, apart=self.apart
        )
        if isinstance(self.said, Measurement):
            return entry._replace(measurement=self.said)
        assert isinstance(self.said, tuple)
        kind, payload = self.said
        info = StoredInfo(self.id, kind, 0.0, 1, datum_crc(self.id, kind, payload), len(payload))
        return entry._replace(**{"kind": kind, **content(info, payload, bytes, None)})


arrivals = st.builds(
    Arrival, ids, times, st.none() | st.sampled_from((0.0, 5.0, 1e8, 1e300)),
    contents | measurements | st.sampled_from(list(Fate)), st.booleans(),
)  # fmt: skip
HERE = Measurement(47.0, 8.0, 0.0, 1e308, 0.5, unit="usvh")


@pytest.fixture(scope="module", autouse=True)
def small() -> Any:
    """Bounds that are soon reached."""
    with pytest.MonkeyPatch.context() as patch:
        for name, most in SMALL.items():
            patch.setattr(model, name, most)
        patch.setattr(field, "MOST_SQUARES", SQUARES)
        yield


def is_json(plain: object) -> None:
    json.loads(json.dumps(plain, allow_nan=False, separators=(",", ":")).encode("ascii"))


def is_bounded(shown: dict[str, Any]) -> None:
    assert len(shown["drones"]) + len(shown.get("unheard", ())) <= SMALL["MOST_DRONES"]
    assert all(len(track["points"]) <= SMALL["MOST_PLACES"] for track in shown.get("tracks", {}).values())
    assert len(shown["fields"]) <= len(UNITS) + 1
    assert all(len(found["squares"]) <= 13 * SQUARES for found in shown["fields"].values())


@pytest.mark.no_cover
@given(st.lists(st.lists(arrivals, max_size=6), max_size=8))
@example([[Arrival(DatumId(7, 1, n), NOW, 1.0, HERE) for n in range(3)]])
@example([[Arrival(DatumId(7, 1, n), NOW, 1.0, HERE._replace(reading=x)) for n, x in enumerate((1e308, -1e308))]])
@example([[Arrival(DatumId(id, 1, 0), NOW, 1.0, Fate.OVERFLOW) for id in range(9)]])
def test_the_page_shows_it_or_leaves_it_out(batches: list[list[Arrival]]) -> None:
    mission = Mission()
    browser = Browser(mission.snapshot())
    number = 0
    for batch in batches:
        mission.hear([(arrival.id, arrival.said) for arrival in batch if isinstance(arrival.said, Fate)])
        come = [arrival for arrival in batch if not isinstance(arrival.said, Fate)]
        mission.take([arrival.entry(number + n) for n, arrival in enumerate(come)])
        number += len(come)
        browser.take(mission.changes())
        for arrival in batch[:2]:
            then = mission.at(arrival.utc)
            is_json(then)
            is_bounded(then)
            is_json(mission.drone(arrival.id.origin))
    shown = mission.snapshot()
    is_json(shown)
    is_bounded(shown)
    late = Browser(shown)
    assert (browser.drones, browser.frame, browser.squares) == (late.drones, late.frame, late.squares)
    assert mission.changes()["drones"] == []
    for figures in shown["drones"]:
        assert 0 <= figures["missing"] <= figures["created"]


@given(st.lists(arrivals, max_size=12), st.sampled_from(("store", "\ud800\x07<b>")))
@example([Arrival(DatumId(7, 1, n), NOW, 1.0, HERE) for n in range(3)], "store")
@example([Arrival(DatumId(7, 1, 0), NOW, 1.0, HERE._replace(reading=5e-324))], "store")
def test_the_report_can_be_read(come: list[Arrival], name: str) -> None:
    drawing, watch = html.Drawing(), Watch()
    entries = [arrival.entry(n) for n, arrival in enumerate(come) if not isinstance(arrival.said, Fate)]
    watch.take(drawing.watch(entries))
    watch.hear([(arrival.id, arrival.said) for arrival in come if isinstance(arrival.said, Fate)])
    plain = watch.plain(NOW)
    is_json(plain)
    text = html.page(plain, rows(watch.conditions(NOW), NOW), drawing, name, [name], NOW)
    text.encode()
    Strict.of(text)
    assert not re.search(r"[\s\">,:-](nan|inf)\b", text)

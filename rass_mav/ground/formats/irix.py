"""IRIX 1.0 (IAEA), in which authorities exchange radiological reports: dose rates with their times and places."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable, Iterator
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from uuid import uuid4

from rass_mav.ground.demands import DoseRate, dose_rates
from rass_mav.ground.entry import Data, Entry, iso
from rass_mav.ground.sorting import Sorter, sorting

from . import Exported, Format
from .kml import text_of

#: Stands for the organisation that reports, which whoever sends the report has to name.
ORGANISATION = "not-stated.invalid"
_FORMAT = "http://www.iaea.org/2012/IRIX/Format"
_HEAD = f"""<?xml version="1.0" encoding="UTF-8"?>
<Report xmlns="{_FORMAT}" xmlns:id="{_FORMAT}/Identification" xmlns:base="{_FORMAT}/Base" \
xmlns:meas="{_FORMAT}/Measurements" xmlns:loc="{_FORMAT}/Locations" version="1.0">
<!-- Before it is sent: state the organisation, twice, its name and country, and whether this is an Emergency, \
Routine, an Exercise or a Test. -->
<id:Identification>
<id:OrganisationReporting>{ORGANISATION}</id:OrganisationReporting>
<id:DateAndTimeOfCreation>{{created}}</id:DateAndTimeOfCreation>
<id:ReportContext>Test</id:ReportContext>
<id:ReportUUID>{{uuid}}</id:ReportUUID>
<id:Identifications><base:OrganisationContactInfo><base:Name>not stated</base:Name>\
<base:OrganisationID>{ORGANISATION}</base:OrganisationID><base:Country>00</base:Country>\
</base:OrganisationContactInfo></id:Identifications>
</id:Identification>
<meas:Measurements ValidAt="{{valid}}">
"""
_TAIL = "</meas:Measurements>\n</Report>\n"
#: Sieverts per second in one uSv/h: IRIX has no other unit of ambient dose equivalent rates.
_SV_S = 1e-6 / 3600


def write(entries: Iterable[Entry], out: Path, source: Data) -> Exported:
    """A data set for each second in which there are dose rates. Altitudes are above mean sea level."""
    left_out = Counter[str]()
    count, latest = 0, 0.0
    with out.open("x", encoding="utf-8") as file, sorting(out) as sorter:
        for rate in dose_rates(entries, left_out, placed=True):
            sorter.add(_second(rate.utc), rate.entry.id.origin, rate.utc, _measurement(rate))
            count, latest = count + 1, max(latest, rate.utc)
        file.write(_HEAD.format(created=_second(time.time()), uuid=uuid4(), valid=_second(latest)))
        file.writelines(_sets(sorter))
        file.write(_TAIL)
    return Exported(count, left_out, [out])


def _sets(sorter: Sorter) -> Iterator[str]:
    for second, rates in groupby(sorter.sorted(), itemgetter(0)):
        yield (
            "<meas:DoseRate><meas:DoseRateType>Gamma</meas:DoseRateType>"
            f"<meas:MeasuringPeriod><meas:StartTime>{second}</meas:StartTime><meas:EndTime>{second}</meas:EndTime>"
            "</meas:MeasuringPeriod><meas:Description>Measured by drones where they flew, not converted to another "
            "height</meas:Description><meas:Measurements>\n"
        )
        yield from (text for *_, text in rates)
        yield "</meas:Measurements></meas:DoseRate>\n"


def _measurement(rate: DoseRate) -> str:
    entry = rate.entry
    assert entry.place is not None
    latitude, longitude = entry.place
    # The schema has no 180 degrees east.
    longitude = -180.0 if longitude == 180.0 else longitude
    height = "" if entry.altitude is None else f'<loc:Height Above="Sea" Unit="m">{entry.altitude:.2f}</loc:Height>'
    return (
        f"<meas:Measurement><loc:Location><loc:Name>{text_of(entry.name)}</loc:Name><loc:GeographicCoordinates>"
        f"<loc:Latitude>{latitude:.7f}</loc:Latitude><loc:Longitude>{longitude:.7f}</loc:Longitude>{height}"
        "</loc:GeographicCoordinates></loc:Location>"
        f'<meas:Value Unit="Sv/s">{rate.value * _SV_S:.9g}</meas:Value>'
        f"<meas:Description>drone {entry.id.origin}</meas:Description></meas:Measurement>\n"
    )


def _second(utc: float) -> str:
    """A date without fractions of a second, as IRIX wants it."""
    return iso(utc)[:19] + "Z"


FORMAT = Format(".irix", "dose rates in uSv/h with a position on Earth and a time known to 60 s", write)

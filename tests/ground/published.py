"""What published schemas and documents say of the elements that we write, as far as we write them: which children, in
which order, which of them must be there, and which attributes. Facts, not their files, so that they are checked
everywhere."""

from __future__ import annotations

import re
from typing import NamedTuple
from xml.etree.ElementTree import Element


class Fact(NamedTuple):
    """Of an element."""

    children: str = ""
    """In their order; one with a `!` must be there, one with a `*` may be there more than once. Empty: text only."""
    attributes: str = ""
    """Those that must be there."""


_POINT = (
    "ele time magvar geoidheight name cmt desc src link* sym type fix sat hdop vdop pdop ageofdgpsdata dgpsid "
    "extensions"
)

#: By the element's name without its namespace; of two with the same name, that with its parent's name.
FACTS: dict[str, dict[str, Fact]] = {
    # ANSI N42.42-2012, n42.xsd of NIST.
    "n42": {
        "RadInstrumentData": Fact(
            "Remark* RadInstrumentDataCreatorName RadInstrumentInformation! RadDetectorInformation* EnergyCalibration* "
            "RadMeasurement*"
        ),
        "RadInstrumentInformation": Fact(
            "Remark* RadInstrumentManufacturerName! RadInstrumentModelName! "
            "RadInstrumentDescription RadInstrumentClassCode! RadInstrumentVersion*",
            "id",
        ),
        "RadInstrumentVersion": Fact("RadInstrumentComponentName! RadInstrumentComponentVersion!"),
        "RadDetectorInformation": Fact(
            "Remark* RadDetectorName RadDetectorCategoryCode! RadDetectorKindCode! RadDetectorDescription", "id"
        ),
        "EnergyCalibration": Fact("Remark* CoefficientValues!", "id"),
        "RadMeasurement": Fact(
            "Remark* MeasurementClassCode! StartDateTime! RealTimeDuration! Spectrum* DoseRate* RadInstrumentState",
            "id",
        ),
        "Spectrum": Fact("Remark* LiveTimeDuration! ChannelData!", "id radDetectorInformationReference"),
        "DoseRate": Fact("Remark* DoseRateValue!", "id radDetectorInformationReference"),
        "RadInstrumentState": Fact("StateVector"),
        "StateVector": Fact("GeographicPoint"),
        "GeographicPoint": Fact("LatitudeValue! LongitudeValue!"),
    },
    # IRIX 1.0 of the IAEA.
    "irix": {
        "Report": Fact("Identification! Measurements", "version"),
        "Identification": Fact(
            "OrganisationReporting! DateAndTimeOfCreation! ReportContext! ReportUUID! Identifications!"
        ),
        "Identifications": Fact("OrganisationContactInfo*"),
        "OrganisationContactInfo": Fact("Name! OrganisationID! Country!"),
        "Report/Measurements": Fact("DoseRate*", "ValidAt"),
        "DoseRate": Fact("DoseRateType! MeasuringPeriod! Description Measurements!"),
        "MeasuringPeriod": Fact("StartTime! EndTime!"),
        "DoseRate/Measurements": Fact("Measurement*"),
        "Measurement": Fact("Location! Value Description"),
        "Location": Fact("Name GeographicCoordinates"),
        "GeographicCoordinates": Fact("Latitude! Longitude! Height"),
        "Height": Fact("", "Above Unit"),
        "Value": Fact("", "Unit"),
    },
    # GPX 1.1 of Topografix.
    "gpx": {
        "gpx": Fact("metadata wpt* rte* trk* extensions", "version creator"),
        "metadata": Fact("name desc author copyright link* time keywords bounds extensions"),
        "wpt": Fact(_POINT, "lat lon"),
        "trk": Fact("name cmt desc src link* number type extensions trkseg*"),
        "trkseg": Fact("trkpt* extensions"),
        "trkpt": Fact(_POINT, "lat lon"),
    },
    # Cursor on Target, MITRE's event of version 2.0.
    "cot": {
        "event": Fact("point! detail", "version type uid time start stale how"),
        "point": Fact("", "lat lon hae ce le"),
    },
}
_TEXT, _NUMBER = r"\S.*", r"-?\d+(\.\d+)?(e[+-]\d+)?"
#: ERS 2.0, PSI Bericht 18-04: identifiers of the header and of a record that we write, and what their values are. A
#: record is a line, begins with PA, and its identifiers stand between semicolons, each before a blank and its value.
ERS_HEADER = {
    "V": r"2\.0", "HSW": _TEXT, "HSURVEY": _TEXT, "HTZ": _NUMBER, "IAR": _TEXT, "ICA": _TEXT, "IPC": _TEXT,
    "IPU": _TEXT,
}  # fmt: skip
ERS_RECORD = {
    "PA": _TEXT, "PB": _TEXT, "CD": r"\d{4}-\d\d-\d\d", "CT": r"\d\d:\d\d:\d\d", "PE": _NUMBER, "PN": _NUMBER,
    "PZ": _NUMBER, "DHSR": _NUMBER,
}  # fmt: skip
#: What is in these is of others.
FREE = {"extensions", "detail"}


def breaks(format: str, root: Element) -> list[str]:
    """What an element and those in it break; an element with children of which there is no fact, too."""
    return list(dict.fromkeys(_breaks(FACTS[format], root, "")))


def _breaks(facts: dict[str, Fact], element: Element, parent: str) -> list[str]:
    name = _name(element)
    if name in FREE:
        return []
    fact = facts.get(f"{parent}/{name}") or facts.get(name) or Fact()
    order = [child.rstrip("!*") for child in fact.children.split()]
    found = [f"{name}: no {one}" for one in fact.attributes.split() if one not in element.attrib]
    children = [_name(child) for child in element]
    found += [f"{name}: {child} is not known" for child in children if child not in order]
    known = [child for child in children if child in order]
    if known != sorted(known, key=order.index):
        found.append(f"{name}: order of {' '.join(known)}")
    for one in fact.children.split():
        bare = one.rstrip("!*")
        if one.endswith("!") and bare not in children:
            found.append(f"{name}: no {bare}")
        if not one.endswith("*") and children.count(bare) > 1:
            found.append(f"{name}: more than one {bare}")
    for child in element:
        found += _breaks(facts, child, name)
    return found


def _name(element: Element) -> str:
    return element.tag.rpartition("}")[2]


def ers_breaks(text: str) -> list[str]:
    """What a text breaks of ERS, and of how the converter to CSV reads it: identifiers of the first record name the
    columns of all, and a value has no comma."""
    lines = [line for line in text.splitlines() if not line.startswith("/*")]
    first = next((n for n, line in enumerate(lines) if line.startswith("PA ")), len(lines))
    header, records = lines[:first], [line.split(";") for line in lines[first:]]
    found = [*_ers_breaks(header, ERS_HEADER)]
    for record in records:
        found += _ers_breaks(record, ERS_RECORD)
        names = [field.partition(" ")[0] for field in record]
        if names[0] != "PA":
            found.append(f"{names[0]} begins a record")
        if names != [field.partition(" ")[0] for field in records[0]]:
            found.append(f"other identifiers: {' '.join(names)}")
        if any("," in field for field in record):
            found.append("a comma in a record")
    # It says what the coordinates mean.
    if not any(line.startswith("IPC ") for line in header):
        found.append("no IPC before the records")
    return list(dict.fromkeys(found))


def _ers_breaks(fields: list[str], known: dict[str, str]) -> list[str]:
    found = []
    for field in fields:
        name, _, value = field.partition(" ")
        if name not in known:
            found.append(f"{name} is not known")
        elif not re.fullmatch(known[name], value, re.ASCII):
            found.append(f"{name}: {value}")
    return found

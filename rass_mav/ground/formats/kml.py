"""KML 2.2 (OGC): a placemark for each datum with a position, coloured by risk, for Google Earth and other globes."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from html import escape
from pathlib import Path

from rass_mav.ground.entry import Data, Entry, iso

from . import Exported, Format
from .geojson import known, placed

#: From low to high, as red, green and blue: steps of viridis, which also people who are colour-blind can tell apart.
COLOURS = ((68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37))

# What XML 1.0 can have in no way, not even as a reference.
_FORBIDDEN = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
_HEAD = """<?xml version="1.0" encoding="UTF-8"?>
<kml xmlns="http://www.opengis.net/kml/2.2">
<Document>
"""
# It names no picture, which a viewer would fetch from the network: viewers have markers of their own.
_STYLE = """<Style id="risk{}"><IconStyle><color>ff{:02x}{:02x}{:02x}</color><scale>0.6</scale></IconStyle>\
<LabelStyle><scale>0</scale></LabelStyle></Style>
"""
_TAIL = "</Document>\n</kml>\n"


def write(entries: Iterable[Entry], out: Path, source: Data) -> Exported:
    """A placemark a line: its time, the columns of CSV that are known, and a style for each fifth of the risk.

    Altitudes are absolute, above mean sea level.
    """
    count, left_out = 0, Counter[str]()
    with out.open("x", encoding="utf-8") as file:
        file.write(_HEAD)
        for step, (red, green, blue) in enumerate(COLOURS):
            file.write(_STYLE.format(step, blue, green, red))
        for entry, point in placed(entries, left_out):
            file.write(_placemark(entry, point))
            count += 1
        file.write(_TAIL)
    return Exported(count, left_out, [out])


def _placemark(entry: Entry, point: tuple[float, float, float]) -> str:
    longitude, latitude, altitude = point
    risk = 0.0 if entry.measurement is None else entry.measurement.risk
    data = "".join(
        f'<Data name="{name}"><value>{text_of(str(value))}</value></Data>' for name, value in known(entry).items()
    )
    return (
        f"<Placemark><name>{text_of(entry.name)}</name><TimeStamp><when>{iso(entry.utc)}</when></TimeStamp>"
        f"<styleUrl>#risk{step_of(risk)}</styleUrl><ExtendedData>{data}</ExtendedData>"
        f"<Point><altitudeMode>absolute</altitudeMode>"
        f"<coordinates>{longitude:.7f},{latitude:.7f},{altitude:.3f}</coordinates></Point></Placemark>\n"
    )


def step_of(risk: float) -> int:
    """The index in `COLOURS` for a risk, 0 to 1."""
    return min(int(risk * len(COLOURS)), len(COLOURS) - 1)


def text_of(text: str) -> str:
    """Untrusted text as the content of an element: escaped, without the characters that XML forbids."""
    return escape(_FORBIDDEN.sub("", text), quote=False)


FORMAT = Format(".kml", "measurements and files with a position on Earth", write)

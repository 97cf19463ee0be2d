"""ERS 2.0 (European Radiometric and Spectrometry format), as tools for mobile gamma spectrometry read it, among them
those of the Czech National Radiation Protection Institute, SURO.

A text of identifiers and values: a header, then a line for each measurement (PSI Bericht 18-04; the list of identifiers
that SURO publishes is at https://github.com/juhele/opengeodata).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from pathlib import Path

from rass_mav.ground.demands import DoseRate, dose_rates
from rass_mav.ground.entry import Data, Entry, iso
from rass_mav.ground.sorting import sorting

from . import Exported, Format

# A dose rate is by definition one at 1 m above ground, unless the header says otherwise.
_HEAD = """/*
/* header data
/*
V 2.0
HSW rass-mav
HSURVEY ambient dose equivalent rates measured by drones where they flew, not converted to 1 m above ground
HTZ 0
/*
/* measuring equipment
/*
IAR counters on drones
ICA drones
IPC WGS84
IPU deg
/*
/* data
/*
"""


def write(entries: Iterable[Entry], out: Path, source: Data) -> Exported:
    """A line for each dose rate, by drone and time.

    Each line has the same identifiers in the same order: SURO's converter to CSV reads their names in the first one
    only. Altitudes are above mean sea level.
    """
    left_out = Counter[str]()
    count = 0
    with out.open("x", encoding="ascii") as file, sorting(out) as sorter:
        for rate in dose_rates(entries, left_out, placed=True):
            sorter.add(rate.entry.id.origin, rate.utc, 0, _line(rate))
            count += 1
        file.write(_HEAD)
        file.writelines(text for *_, text in sorter.sorted())
    return Exported(count, left_out, [out])


def _line(rate: DoseRate) -> str:
    entry = rate.entry
    assert entry.place is not None
    latitude, longitude = entry.place
    day, time = iso(rate.utc)[:10], iso(rate.utc)[11:19]
    return (
        f"PA {entry.name};PB drone {entry.id.origin};CD {day};CT {time};PE {longitude:.7f};PN {latitude:.7f};"
        f"PZ {entry.altitude or 0.0:.2f};DHSR {rate.value:.6e}\n"
    )


FORMAT = Format(".ers", "dose rates in uSv/h with a position on Earth and a time known to 60 s", write)

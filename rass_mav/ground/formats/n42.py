"""ANSI N42.42 (2012), the XML of radiation instruments: dose rates with their times and places."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from pathlib import Path

from rass_mav.ground.demands import DoseRate, dose_rates
from rass_mav.ground.entry import Data, Entry, iso
from rass_mav.ground.sorting import sorting

from . import Exported, Format
from .kml import text_of

# What the schema demands and nobody here knows has the value that it provides for that, or says so.
_HEAD = """<?xml version="1.0" encoding="UTF-8"?>
<RadInstrumentData xmlns="http://physics.nist.gov/N42/2011/N42">
<Remark>Ambient dose equivalent rates that drones measured where they flew, not converted to another height.</Remark>
<Remark>How long each measurement took is not known: RealTimeDuration is a placeholder.</Remark>
<Remark>No spectra were measured: Spectrum and EnergyCalibration are placeholders for readers that need one. Each \
spectrum has one channel without counts, and no live time.</Remark>
<RadInstrumentDataCreatorName>rass-mav</RadInstrumentDataCreatorName>
<RadInstrumentInformation id="swarm">
<RadInstrumentManufacturerName>Unknown</RadInstrumentManufacturerName>
<RadInstrumentModelName>Unknown</RadInstrumentModelName>
<RadInstrumentDescription>Counters on drones</RadInstrumentDescription>
<RadInstrumentClassCode>Other</RadInstrumentClassCode>
<RadInstrumentVersion><RadInstrumentComponentName>Firmware</RadInstrumentComponentName>\
<RadInstrumentComponentVersion>Unknown</RadInstrumentComponentVersion></RadInstrumentVersion>
</RadInstrumentInformation>
"""
_DETECTOR = """<RadDetectorInformation id="drone-{0}"><RadDetectorName>drone {0}</RadDetectorName>\
<RadDetectorCategoryCode>Gamma</RadDetectorCategoryCode><RadDetectorKindCode>Other</RadDetectorKindCode>\
<RadDetectorDescription>The counter of drone {0}</RadDetectorDescription></RadDetectorInformation>
"""
_CALIBRATION = """<EnergyCalibration id="none"><Remark>A placeholder</Remark>\
<CoefficientValues>0 3000 0</CoefficientValues></EnergyCalibration>
"""
_TAIL = "</RadInstrumentData>\n"


def write(entries: Iterable[Entry], out: Path, source: Data) -> Exported:
    """A detector for each drone, and a measurement for each dose rate, by drone and time.

    A place is no must. Altitudes are above mean sea level, which N42 has no element for: they are remarks.
    """
    left_out, drones = Counter[str](), Counter[int]()
    with out.open("x", encoding="utf-8") as file, sorting(out) as sorter:
        for rate in dose_rates(entries, left_out, placed=False):
            drones[rate.entry.id.origin] += 1
            sorter.add(rate.entry.id.origin, rate.utc, 0, _measurement(rate))
        file.write(_HEAD)
        file.writelines(_DETECTOR.format(drone) for drone in sorted(drones))
        file.write(_CALIBRATION)
        file.writelines(text for *_, text in sorter.sorted())
        file.write(_TAIL)
    return Exported(drones.total(), left_out, [out])


def _measurement(rate: DoseRate) -> str:
    entry = rate.entry
    detector = f'radDetectorInformationReference="drone-{entry.id.origin}"'
    # An xsd:ID begins with a letter, and has no #.
    id = f"m-{entry.name.replace('#', '.')}"
    return (
        f'<RadMeasurement id="{id}">{_remarks(entry)}<MeasurementClassCode>Foreground</MeasurementClassCode>'
        f"<StartDateTime>{iso(rate.utc)}</StartDateTime><RealTimeDuration>PT1S</RealTimeDuration>"
        f'<Spectrum id="{id}-s" {detector} energyCalibrationReference="none">'
        "<LiveTimeDuration>PT0S</LiveTimeDuration><ChannelData>0</ChannelData></Spectrum>"
        f'<DoseRate id="{id}-d" {detector}><DoseRateValue>{rate.value:.9g}</DoseRateValue></DoseRate>'
        f"{_state(entry)}</RadMeasurement>\n"
    )


def _remarks(entry: Entry) -> str:
    m = entry.measurement
    said = [entry.name]
    if entry.place is not None and entry.altitude is not None:
        said.append(f"{entry.altitude:.2f} m above mean sea level")
    if m is not None and m.error_m is not None:
        said.append(f"position right to {m.error_m:g} m")
    if entry.error_s is not None:
        said.append(f"time right to {entry.error_s:.3g} s")
    return "".join(f"<Remark>{text_of(one)}</Remark>" for one in said)


def _state(entry: Entry) -> str:
    if entry.place is None:
        return ""
    latitude, longitude = entry.place
    return (
        '<RadInstrumentState radInstrumentInformationReference="swarm"><StateVector><GeographicPoint>'
        f"<LatitudeValue>{latitude:.7f}</LatitudeValue><LongitudeValue>{longitude:.7f}</LongitudeValue>"
        "</GeographicPoint></StateVector></RadInstrumentState>"
    )


FORMAT = Format(".n42", "dose rates in uSv/h with a time known to 60 s", write)

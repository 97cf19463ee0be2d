"""The parameter files load: their syntax is what the ground stations read, and they hold what the companion needs."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

FOLDER = Path(__file__).parents[1] / "firmware_params"
OLD = FOLDER / "ardupilot-4.6.parm"
NEW = FOLDER / "ardupilot-4.7.parm"
PX4 = FOLDER / "px4.params"
#: The same with MAVLink signing.
SIGNING = {path: path.with_stem(f"{path.stem}-signing") for path in (OLD, NEW, PX4)}
FILES = (OLD, NEW, PX4, *SIGNING.values())
#: What real firmware was measured to do, beside the project; not part of the repository.
FIRMWARE = Path(__file__).parents[2] / "shared" / "FIRMWARE.md"

#: The vehicle's system id: in ArduPilot before and since 4.7, and in PX4. No file names it.
SYSTEM_ID = {"SYSID_THISMAV", "MAV_SYSID", "MAV_SYS_ID"}
#: The other parameters of ArduPilot that 4.7 renamed.
RENAMED = {
    "SYSID_MYGCS": "MAV_GCS_SYSID",
    "SR2_POSITION": "MAV3_POSITION",
    "SERIAL2_OPTIONS": "MAV3_OPTIONS",
    "TELEM_DELAY": "MAV_TELEM_DELAY",
}
UNCHANGED = {
    "SERIAL1_PROTOCOL": 2.0,
    "SERIAL1_BAUD": 57.0,
    "SERIAL2_PROTOCOL": 2.0,
    "SERIAL2_BAUD": 921.0,
    "BRD_SER2_RTSCTS": 0.0,
    "SCR_ENABLE": 1.0,
}

#: MAV_PARAM_TYPE_INT32 (MAVLink common, MAV_PARAM_TYPE): PX4 has only this and REAL32.
INT32 = "6"


class Entry(NamedTuple):
    """One parameter of a file."""

    name: str
    value: float
    comment: str


def entries(path: Path) -> list[Entry]:
    """What a ground station reads: lines that start with # are comments, nothing else may follow the last field."""
    found = []
    comment: list[str] = []
    for line in path.read_text("ascii").splitlines():
        if not line:
            comment = []
        elif line.startswith("#"):
            comment.append(line.lstrip("# "))
        else:
            if path.suffix == ".params":
                vehicle, component, name, value, kind = line.split("\t")
                assert (vehicle, component, kind) == ("1", "1", INT32)
                assert value == str(int(value))
            else:
                name, value = line.split(" ")
            found.append(Entry(name, float(value), " ".join(comment)))
            comment = []
    return found


def values(path: Path) -> dict[str, float]:
    return {entry.name: entry.value for entry in entries(path)}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_names_fit_into_param_set_and_occur_once(path: Path) -> None:
    names = [entry.name for entry in entries(path)]
    assert names
    assert len(names) == len(set(names))
    assert all(re.fullmatch(r"[A-Z][A-Z0-9_]{0,15}", name) for name in names)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_every_parameter_is_explained_just_above_it(path: Path) -> None:
    for entry in entries(path):
        assert len(entry.comment.split()) >= 8, entry.name


def test_the_two_generations_of_ardupilot_differ_in_the_renamed_parameters_only() -> None:
    old, new = values(OLD), values(NEW)
    assert set(old) - set(new) == set(RENAMED)
    assert set(new) - set(old) == set(RENAMED.values())
    assert {RENAMED.get(name, name): value for name, value in old.items()} == new


@pytest.mark.parametrize("path", [OLD, NEW], ids=lambda path: path.name)
def test_ardupilot_speaks_mavlink_2_to_a_companion_on_telem2(path: Path) -> None:
    assert UNCHANGED.items() <= values(path).items()


def test_px4_speaks_mavlink_to_a_companion_on_telem2() -> None:
    px4 = values(PX4)
    assert (px4.pop("MAV_0_CONFIG"), px4.pop("MAV_1_CONFIG")) == (101, 102)
    assert px4.pop("SER_TEL1_BAUD") == 57600
    assert px4.pop("MAV_0_RADIO_CTL") == 1
    assert px4.pop("SER_TEL2_BAUD") == 1000 * UNCHANGED["SERIAL2_BAUD"] + 600
    assert px4.pop("MAV_1_MODE") == 2
    assert px4.pop("MAV_1_RATE") == 0
    # A frame passes only when both links forward.
    assert px4.pop("MAV_0_FORWARD") == px4.pop("MAV_1_FORWARD") == 1
    assert px4.pop("MAV_1_FLOW_CTRL") == UNCHANGED["BRD_SER2_RTSCTS"]
    assert set(px4) == {"MAV_1_RADIO_CTL"}


#: What signing changes, file by file: name -> value without and with it.
CHANGES: dict[Path, dict[str, tuple[float | None, float]]] = {
    OLD: {"SERIAL2_OPTIONS": (0.0, 1 << 10)},
    NEW: {"MAV3_OPTIONS": (0.0, 1 << 1), "MAV2_OPTIONS": (None, 0.0)},
    PX4: {"MAV_0_FORWARD": (1.0, 0.0), "MAV_1_FORWARD": (1.0, 0.0)},
}


@pytest.mark.parametrize("path", SIGNING, ids=lambda path: path.name)
def test_with_signing_the_swarm_is_not_forwarded_and_nothing_else_changes(path: Path) -> None:
    plain, signing = values(path), values(SIGNING[path])
    for name, (without, with_it) in CHANGES[path].items():
        assert (plain.pop(name, None), signing.pop(name)) == (without, with_it)
    assert plain == signing


def measured() -> Iterator[tuple[set[str], set[str], set[str]]]:
    """The rows of the table of parameters: names for ArduPilot to 4.6, for 4.7 and for PX4."""
    table = FIRMWARE.read_text("utf-8").split("## Parameters for a companion on TELEM2")[1].split("\n## ")[0]
    for row in table.splitlines():
        cells = [cell.strip() for cell in row.strip("|").split("|")]
        if len(cells) == 4 and cells[0] not in ("purpose", "---"):
            old, new, px4 = (set(re.findall(r"\b[A-Z][A-Z0-9]*_[A-Z0-9_]+", cell)) for cell in cells[1:])
            yield old, old if cells[2] == "same" else new, px4


@pytest.mark.skipif(not FIRMWARE.exists(), reason="needs ../shared/FIRMWARE.md, which is not part of the repository")
def test_the_names_are_those_that_were_found_in_real_firmware() -> None:
    rows = list(measured())
    assert len(rows) == 8
    # Of the radio on TELEM1, about which that table says nothing: named as for TELEM2.
    ardupilot = {name.replace("SERIAL2", "SERIAL1") for name in ("SERIAL2_PROTOCOL", "SERIAL2_BAUD")}
    for place, radio, paths in (
        (0, ardupilot, (OLD, SIGNING[OLD])),
        (1, {*ardupilot, "MAV2_OPTIONS"}, (NEW, SIGNING[NEW])),
        (2, {"MAV_0_CONFIG", "SER_TEL1_BAUD", "MAV_0_RADIO_CTL", "MAV_0_FORWARD"}, (PX4, SIGNING[PX4])),
    ):
        names = set().union(*(row[place] for row in rows)) - SYSTEM_ID
        for path in paths:
            assert names <= set(values(path)) <= names | radio, path.name


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_no_file_gives_a_vehicle_another_system_id(path: Path) -> None:
    assert not SYSTEM_ID & set(values(path))
    # But whoever reads the file is told what it is called.
    assert SYSTEM_ID & set(re.findall(r"\w+", path.read_text("ascii")))


def test_the_readme_names_every_file_and_every_renamed_parameter() -> None:
    text = (FOLDER / "README.md").read_text("utf-8")
    for name in [path.name for path in FILES] + [*RENAMED, *RENAMED.values(), *SYSTEM_ID]:
        assert f"`{name}" in text, name
    assert {path.name for path in FOLDER.iterdir()} == {"README.md", "rass_rad.lua", *(path.name for path in FILES)}

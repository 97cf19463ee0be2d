"""The parameter files load: their syntax is what the ground stations read, and they hold what the companion needs."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import pytest

FOLDER = Path(__file__).parents[1] / "firmware_params"
OLD = FOLDER / "ardupilot-4.6.parm"
NEW = FOLDER / "ardupilot-4.7.parm"
PX4 = FOLDER / "px4.params"
FILES = (OLD, NEW, PX4)

#: The parameters of ArduPilot that 4.7 renamed.
RENAMED = {
    "SYSID_THISMAV": "MAV_SYSID",
    "SYSID_MYGCS": "MAV_GCS_SYSID",
    "SR2_POSITION": "MAV3_POSITION",
    "SERIAL2_OPTIONS": "MAV3_OPTIONS",
    "TELEM_DELAY": "MAV_TELEM_DELAY",
}
UNCHANGED = {"SERIAL2_PROTOCOL": 2.0, "SERIAL2_BAUD": 921.0, "BRD_SER2_RTSCTS": 0.0, "SCR_ENABLE": 1.0}

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
    assert px4.pop("MAV_1_CONFIG") == 102
    assert px4.pop("SER_TEL2_BAUD") == 1000 * UNCHANGED["SERIAL2_BAUD"] + 600
    assert px4.pop("MAV_1_MODE") == 2
    assert px4.pop("MAV_1_RATE") == 0
    # A frame passes only when both links forward.
    assert px4.pop("MAV_0_FORWARD") == px4.pop("MAV_1_FORWARD") == 1
    assert px4.pop("MAV_1_FLOW_CTRL") == UNCHANGED["BRD_SER2_RTSCTS"]
    assert set(px4) == {"MAV_SYS_ID", "MAV_1_RADIO_CTL"}


def test_system_ids_are_those_of_a_vehicle_and_of_a_ground_station() -> None:
    old = values(OLD)
    assert old["SYSID_THISMAV"] == values(PX4)["MAV_SYS_ID"] == 1
    assert 1 <= old["SYSID_MYGCS"] <= 255
    assert old["SYSID_MYGCS"] != old["SYSID_THISMAV"]
    # A vehicle that takes its new id at once no longer hears what is sent to the old one.
    assert [entries(path)[-1].name for path in (OLD, NEW)] == ["SYSID_THISMAV", "MAV_SYSID"]


def test_the_readme_names_every_file_and_every_renamed_parameter() -> None:
    text = (FOLDER / "README.md").read_text("utf-8")
    for name in [path.name for path in FILES] + list(RENAMED) + list(RENAMED.values()):
        assert f"`{name}" in text, name
    assert {path.name for path in FOLDER.iterdir()} == {"README.md", *(path.name for path in FILES)}

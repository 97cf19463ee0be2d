"""Parameter files: what is read, and what is refused with the line."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.errors import ConfigError
from rass_mav.mavlink.firmware import ARDUPILOT, PX4, Firmware
from rass_mav.params.files import parse_text, read_file
from rass_mav.params.names import fitting_file, made_for, other_name

FOLDER = Path(__file__).parents[2] / "firmware_params"
SHIPPED = sorted(path for path in FOLDER.iterdir() if path.suffix in (".parm", ".params"))


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.name)
def test_the_files_that_ship(path: Path) -> None:
    file = read_file(path)
    assert len(file.entries) >= 9
    px4 = path.suffix == ".params"
    assert file.format == ("qgroundcontrol" if px4 else "ardupilot")
    assert {entry.kind for entry in file.entries} == {6 if px4 else None}
    assert made_for(frozenset(entry.name for entry in file.entries)) == (PX4 if px4 else ARDUPILOT)
    # Some take effect after a reboot, and the comments say which.
    assert any(entry.reboot for entry in file.entries)


def test_both_formats() -> None:
    file = parse_text("# a rate\r\n# Takes effect after a reboot.\r\nSR2_POSITION 1\r\nA,2.5\n\n# x\n\nB\t-3e2\n")
    assert [entry[:4] for entry in file.entries] == [
        ("SR2_POSITION", 1.0, 3, None), ("A", 2.5, 4, None), ("B", -300.0, 8, None),
    ]  # fmt: skip
    assert [entry.reboot for entry in file.entries] == [True, False, False]
    file = parse_text("# Vehicle-Id Component-Id Name Value Type\n1\t1\tMAV_1_MODE\t2\t6\n1\t1\tX\t0.5\t9\n")
    assert [entry[:4] for entry in file.entries] == [("MAV_1_MODE", 2.0, 2, 6), ("X", 0.5, 3, 9)]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "contains no parameters"),
        ("# nothing\n", "contains no parameters"),
        ("A 1\nB\n", "line 2: expected NAME VALUE"),
        ("A 1 # why\n", "line 1: expected NAME VALUE, and comments on separate lines"),
        ("A 1\n\nA 2\n", "line 3: A appears twice, first in line 1"),
        ("1A 2\n", "line 1: expected a name of 1 to 16 letters"),
        ("A2345678901234567 2\n", "line 1: expected a name of 1 to 16 letters"),
        ("A nan\n", "line 1: expected a number that fits 32 bits, got 'nan'"),
        ("A 1e39\n", "line 1: expected a number that fits 32 bits"),
        ("A 1_0\n", "line 1: expected a number"),
        ("A ٣\n", "line 1: expected a number"),
        ("1\t1\tA\t2\n", "line 1: expected vehicle id, component id, name, value and type"),
        ("1\t1\tA\t2\t6\nB 2\n", "line 2: expected vehicle id"),
        ("1\t1\tA\t2\t8\n", "line 1: expected a type, 6 for INT32 or 9 for REAL32, got '8'"),
        ("1\t1\tA\t2.5\t6\n", "line 1: A: 2.5 is not a value of type 6"),
        ("999\t1\tA\t2\t6\n", "line 1: expected a vehicle id 0..255, got '999'"),
    ],
)
def test_what_is_refused_says_where_and_what_was_expected(text: str, said: str) -> None:
    with pytest.raises(ConfigError) as refused:
        parse_text(text)
    assert str(refused.value).startswith(said)


def test_what_counts_after_a_reboot_is_known_without_a_comment() -> None:
    text = "SERIAL3_OPTIONS 0\nSYSID_THISMAV 2\nMAV_1_FORWARD 1\nRADS_SOURCE 2\nRADS_EDGES 2\nTELEM_DELAY 0\n"
    assert [entry.reboot for entry in parse_text(text).entries] == [True] * 4 + [False] * 2


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    missing = tmp_path / "gone.parm"
    with pytest.raises(ConfigError, match=f"{missing}: no such file"):
        read_file(missing)
    missing.write_bytes(b"A 1\n\xff\n")
    with pytest.raises(ConfigError, match="not UTF-8 text"):
        read_file(missing)
    missing.write_bytes(b"A 1\n" * 300_000)
    with pytest.raises(ConfigError, match="larger than"):
        read_file(missing)


@given(st.text(max_size=200))
def test_any_text_is_a_file_or_refused(text: str) -> None:
    try:
        file = parse_text(text)
    except ConfigError:
        return
    assert len({entry.name for entry in file.entries}) == len(file.entries)


def test_names_before_and_since_4_7_lead_to_each_other() -> None:
    pairs = {
        "SYSID_THISMAV": "MAV_SYSID", "SYSID_MYGCS": "MAV_GCS_SYSID", "TELEM_DELAY": "MAV_TELEM_DELAY",
        "SR2_POSITION": "MAV3_POSITION", "SR0_EXTRA1": "MAV1_EXTRA1",
    }  # fmt: skip
    for old, new in pairs.items():
        assert (other_name(old), other_name(new)) == (new, old)
    assert other_name("MAV_1_CONFIG") == "SER_TEL2_PROTO"
    assert {other_name(name) for name in ("SERIAL2_OPTIONS", "MAV3_OPTIONS", "SERIAL2_BAUD", "MAV_1_MODE")} == {None}
    before, since = (
        {entry.name for entry in read_file(FOLDER / f"ardupilot-{version}.parm").entries} for version in ("4.6", "4.7")
    )
    assert {other_name(name) for name in before - since - {"SERIAL2_OPTIONS"}} <= since


@pytest.mark.parametrize(
    ("firmware", "version", "names", "file"),
    [
        (PX4, (1, 15, 0), (), "px4.params"),
        (ARDUPILOT, (4, 6, 3), (), "ardupilot-4.6.parm"),
        (ARDUPILOT, (4, 7, 0), (), "ardupilot-4.7.parm"),
        (ARDUPILOT, (5, 0, 0), (), "ardupilot-4.7.parm"),
        (ARDUPILOT, (0, 0, 0), ("MAV_SYSID",), "ardupilot-4.7.parm"),
        (ARDUPILOT, (0, 0, 0), ("SYSID_THISMAV",), "ardupilot-4.6.parm"),
        (ARDUPILOT, (0, 0, 0), (), None),
        (0, (1, 0, 0), (), None),
    ],
)
def test_which_file_fits(
    firmware: int, version: tuple[int, int, int], names: tuple[str, ...], file: str | None
) -> None:
    assert fitting_file(Firmware(firmware, version), frozenset(names)) == file
    if file is not None:
        assert (FOLDER / file).exists()

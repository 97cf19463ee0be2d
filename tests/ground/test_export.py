"""`rass-mav export`: which data, into which file, and what happens if it goes wrong."""

from __future__ import annotations

import argparse
import csv
import fcntl
import json
import os
import pty
import signal
import struct
import subprocess
import sys
import termios
import time
from pathlib import Path
from typing import Any

import pytest

from rass_mav.cli import main
from rass_mav.core.datum import Kind
from rass_mav.errors import ConfigError
from rass_mav.ground.commands.filters import add_filters, wanted
from rass_mav.ground.entry import ALL, Filter
from rass_mav.ground.formats import format_of, names
from tests.commands import json_output, output
from tests.patience import PATIENCE_S
from tests.some import some

from .mission_stores import FILES, LIVED_S, SAFECAST, measured, mission, nowhere, put, stored

Capture = pytest.CaptureFixture[str]
ENDINGS = ", ".join(filter(None, (format_of(name).ending for name in names())))


@pytest.fixture
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The store of a mission that has just ended, in the working directory."""
    monkeypatch.chdir(tmp_path)
    return stored(tmp_path / "base.db", mission(), time.time())


def plain(capsys: Capture, *words: str) -> Any:
    """What `export --json` prints."""
    return json_output(capsys, "export", *words)


def refused(capsys: Capture, *words: str) -> str:
    """What is said of a command that is not carried out."""
    printed = output(capsys, "export", *words, code=2)
    assert printed.out == ""
    (line,) = printed.err.splitlines()
    return line


def here() -> list[str]:
    """What is in the working directory, without stores and what belongs to them."""
    return sorted(name for name in os.listdir() if ".db" not in name)


def ids(path: Path) -> list[str]:
    with path.open(encoding="utf-8-sig", newline="") as file:
        return [row["id"].replace("-0123abcd", "") for row in csv.DictReader(file)]


# -- where to, and in which format -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "out", "files"),
    [
        ("csv", "base.csv", 1),
        ("geojson", "base.geojson", 1),
        ("gpx", "base.gpx", 1),
        ("n42", "base.n42", 1),
        ("irix", "base.irix", 1),
        ("ers", "base.ers", 1),
        ("kml", "base.kml", 1),
        ("gpkg", "base.gpkg", 1),
        ("bgeigie", "base-bgeigie", 1),
        ("files", "base-files", FILES + 1),
    ],
)
def test_without_a_name_it_is_that_of_the_store(name: str, out: str, files: int, store: Path, capsys: Capture) -> None:
    found = plain(capsys, "base.db", "--format", name)
    assert sum(found.pop("left_out_why").values()) == found["left_out"]
    assert found.pop("left_out") == len(mission()) - found.pop("data")
    # A log is one of a drone and a day, and midnight may lie between the measurements.
    assert found.pop("files") in ((files, files + 1) if name == "bgeigie" else (files,))
    assert found == {"out": out, "format": name, "sealed": 0}
    assert here() == [out]


def test_the_ending_names_the_format(store: Path, capsys: Capture) -> None:
    assert plain(capsys, "base.db", "-o", "a.geojson")["format"] == "geojson"
    assert json.loads(Path("a.geojson").read_text())["type"] == "FeatureCollection"
    assert plain(capsys, "base.db", "-o", "b.geojson", "--format", "csv")["format"] == "csv"
    assert len(ids(Path("b.geojson"))) == len(mission())


def test_people_are_told_in_one_line(store: Path, capsys: Capture) -> None:
    said = output(capsys, "export", "base.db", "-o", "safecast", "--format", "bgeigie").out
    assert said.startswith(f"safecast: {SAFECAST} data; {len(mission()) - SAFECAST} left out: ")
    assert said.endswith(
        " (bgeigie holds measurements in cpm, cps or uSv/h with a position on Earth and a time known to 60 s, for "
        "Safecast)\n"
    )
    assert output(capsys, "export", "base.db", "-o", "all.csv").out == f"all.csv: {len(mission())} data\n"


def test_a_configuration_names_the_store_too(store: Path, capsys: Capture) -> None:
    Path("base.yaml").write_text("node: {id: 1, role: base}\nstore: {path: base.db}\n")
    assert plain(capsys, "base.yaml", "--format", "csv")["out"] == "base.csv"


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ([], f"expected --format, one of {', '.join(names())}, or -o with an extension that implies it"),
        (["-o", "out"], f"out: expected --format, one of {', '.join(names())}, "
         f"or one of the extensions {ENDINGS}"),
        (["-o", "out.xls"], f"out.xls: expected --format, one of {', '.join(names())}, "
         f"or one of the extensions {ENDINGS}"),
        (["--format", "shp"], f"--format: expected one of {', '.join(names())}, got 'shp'"),
    ],
)  # fmt: skip
def test_a_format_that_is_not_known(words: list[str], expected: str, store: Path, capsys: Capture) -> None:
    assert refused(capsys, "base.db", *words) == expected


@pytest.mark.parametrize("name", ["csv", "files"])
def test_nothing_is_overwritten(name: str, store: Path, capsys: Capture) -> None:
    Path("file").write_text("mine")
    Path("folder").mkdir()
    Path("dangling").symlink_to("nowhere")
    for out in ("file", "folder", "dangling", ".", "base.db"):
        assert refused(capsys, "base.db", "-o", out, "--format", name) == (
            f"{out}: already exists; choose another name or delete it"
        )
    assert Path("file").read_text() == "mine"
    assert here() == ["dangling", "file", "folder"]


def test_a_store_that_is_not_there(store: Path, capsys: Capture) -> None:
    assert refused(capsys, "none.db", "-o", "a.csv") == "none.db: no such store"


def test_a_place_that_is_not_there(store: Path, capsys: Capture) -> None:
    assert main(["export", "base.db", "-o", "none/a.csv"]) == 1
    assert capsys.readouterr().err == f"none/a.csv: there is no folder {Path('none').absolute()}\n"


# -- nothing to export -------------------------------------------------------------------------------------------------


def test_where_nothing_is_exported_the_run_has_failed_and_each_reason_is_counted(store: Path, capsys: Capture) -> None:
    data = [measured(0, unit="counts"), measured(1, unit="counts"), measured(2, reading=None), nowhere(3)]
    stored(store.with_name("poor.db"), [*data, put(4, Kind.BYTES, b"x")], time.time())
    assert main(["export", "poor.db", "--format", "bgeigie", "-o", "logs"]) == 1
    said = capsys.readouterr()
    assert said.err == (
        "logs: nothing to export, so it was not created: 2: unit counts; 1: no measurement; 1: no position; "
        "1: no reading (bgeigie holds measurements in cpm, cps or uSv/h with a position on Earth and a time known to "
        "60 s, for Safecast)\n"
    )
    assert said.out == ""
    assert here() == []


def test_what_can_be_mended_is_said_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    """The clock of this base was never set: with one setting its data are good."""
    monkeypatch.chdir(tmp_path)
    data = [*(measured(n) for n in range(226)), *(nowhere(n) for n in range(300, 700)), measured(900, unit=None)]
    stored(Path("base.db"), data, time.time(), trusted=False)
    assert main(["export", "base.db", "--format", "bgeigie"]) == 1
    unit = "1: unit unknown: set risk.unit on the drone"
    said = capsys.readouterr().err
    assert f": 226: time unknown: set node.clock; {unit}; 400: no position (" in said
    stored(Path("set.db"), data, time.time())
    said = output(capsys, "export", "set.db", "--format", "bgeigie").out
    assert said.startswith(f"set-bgeigie: 226 data; 401 left out: {unit}; 400: no position (")


@pytest.mark.parametrize("name", names())
def test_no_format_creates_a_file_of_nothing(name: str, store: Path, capsys: Capture) -> None:
    stored(store.with_name("empty.db"), [], time.time())
    (line,) = json_output(capsys, "export", "empty.db", "--format", name, "-o", "out", code=1)["error"]
    assert line == "out: nothing to export, so it was not created: the store holds no data"
    (line,) = json_output(capsys, "export", "base.db", "--format", name, "-o", "out", "--drone", "999", code=1)["error"]
    assert line == "out: nothing to export, so it was not created: no data match the options"
    assert here() == []


# -- what goes wrong ---------------------------------------------------------------------------------------------------


def test_a_damaged_store_gives_what_it_still_holds_and_a_warning(store: Path, capsys: Capture) -> None:
    with store.open("r+b") as file:
        file.seek(100)
        file.write(bytes(30))
    assert main(["export", "base.db", "-o", "a.csv"]) == 0
    said = capsys.readouterr()
    assert said.err.startswith("WARNING: base.db: ")
    # Salvage leaves out only what is corrupt.
    assert said.out == f"a.csv: {len(mission()) - 1} data\n"


@pytest.mark.parametrize("name", ["csv", "gpkg", "bgeigie", "files", "gpx", "n42", "irix", "ers"])
def test_a_full_disk_leaves_nothing_behind(name: str, store: Path) -> None:
    """As far as a limit on the size of files is like one."""
    data = [measured(n) for n in range(3000)] + [put(9000, Kind.BYTES, bytes(300_000))]
    path = stored(store.with_name("large.db"), data, time.time())
    limited = (
        "import resource, signal, sys; from rass_mav.cli import main; signal.signal(signal.SIGXFSZ, signal.SIG_IGN); "
        "resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000)); sys.exit(main(sys.argv[1:]))"
    )
    done = subprocess.run(
        [sys.executable, "-c", limited, "export", str(path), "-o", "out", "--format", name, "--json"],
        check=False, capture_output=True, text=True, timeout=PATIENCE_S,
    )  # fmt: skip
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith("out: ")
    assert json.loads(done.stdout) == {"error": [line]}
    assert here() == []


def test_an_interrupted_export_leaves_nothing_behind(store: Path) -> None:
    stored(store.with_name("large.db"), (measured(n) for n in range(20_000)), time.time())
    words = [sys.executable, "-m", "rass_mav", "export", "large.db", "-o", "out.kml"]
    with subprocess.Popen(words, stderr=subprocess.PIPE, text=True) as process:
        try:
            deadline = time.monotonic() + PATIENCE_S
            while not list(Path().glob(".rass-mav-*/out.kml")):
                assert process.poll() is None
                assert time.monotonic() < deadline
            process.send_signal(signal.SIGINT)
            _, said = process.communicate(timeout=PATIENCE_S)
        finally:
            process.kill()
    assert (process.returncode, said) == (130, "interrupted\n")
    assert here() == []


def test_a_terminal_shows_how_far_it_is(store: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    ours, theirs = pty.openpty()
    # Rows and columns; a terminal without any gets no bar.
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("4H", 24, 80, 0, 0))
    with os.fdopen(ours, "rb", buffering=0) as screen:
        with os.fdopen(theirs, "w") as terminal, monkeypatch.context() as patched:
            patched.setattr(sys, "stderr", terminal)
            assert main(["export", "base.db", "-o", "a.csv"]) == 0
        # Its other end is closed, so this does not wait for more.
        assert f"/{len(mission())} ".encode() in screen.read(1 << 16)
    assert output(capsys, "export", "base.db", "-o", "b.csv").err == ""


def test_the_logs_can_be_replayed(store: Path, capsys: Capture) -> None:
    data = [measured(n, 300.0 - n, drone=7, latitude=47.5 + n * 1e-5) for n in range(60)]
    stored(store.with_name("flight.db"), data, time.time())
    assert plain(capsys, "flight.db", "-o", "logs", "--format", "bgeigie")["data"] == 60
    replayed = json_output(capsys, "replay", *map(str, Path("logs").iterdir()), "--range", "10000")
    assert replayed["records"] == {"read": 60, "used": 60, "rejected": 0}
    assert replayed["delivered_with_reading"] > 0


# -- which data --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ([], ["7-0", "7-1", "8-2", "65534-3", "7-4", "7-5"]),
        (["--drone", "8", "65534"], ["8-2", "65534-3"]),
        (["--kind", "bytes"], ["7-5"]),
        (["--since", "10m"], ["7-1", "8-2", "65534-3", "7-4", "7-5"]),
        (["--until", "10m"], ["7-0"]),
        (["--since", "0.5h", "--until", "1.5m"], ["7-1"]),
        (["--box", "-34,-71,-33,-70"], ["8-2"]),
        (["--box", "-90,179,90,-70"], ["8-2", "65534-3"]),
        (["--above", "0.75"], ["7-1"]),
        (["--above", "-1", "--kind", "measurement", "--drone", "7"], ["7-0", "7-1", "7-4"]),
    ],
)
def test_only_what_was_asked_for(words: list[str], expected: list[str], tmp_path: Path, capsys: Capture) -> None:
    data = [
        measured(0, 3000.0),
        measured(1, 200.0, reading=0.8),
        measured(2, 20.0, drone=8, latitude=-33.5, longitude=-70.5),
        measured(3, 20.0, drone=65534, longitude=179.5),
        nowhere(4, ago_s=20.0),
        put(5, Kind.BYTES, b"x", ago_s=20.0),
    ]
    path = stored(tmp_path / "base.db", data, time.time())
    found = plain(capsys, str(path), "-o", str(tmp_path / "a.csv"), *words)
    assert ids(tmp_path / "a.csv") == expected
    assert (found["data"], found["left_out"]) == (len(expected), 0)


def chosen(*words: str) -> Filter:
    parser = argparse.ArgumentParser()
    add_filters(parser)
    return wanted(parser.parse_args(words))


def test_without_options_all_data_are_wanted() -> None:
    assert chosen() == ALL


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("2026-11-22", 1_795_305_600.0),
        ("2026-11-22T12:00", 1_795_348_800.0),
        ("2026-11-22 12:00:00.500", 1_795_348_800.5),
        ("2026-11-22T12:00:00Z", 1_795_348_800.0),
        ("2026-11-22T12:00:00z", 1_795_348_800.0),
        ("2026-11-22T13:00:00+01:00", 1_795_348_800.0),
    ],
)
def test_dates(text: str, expected: float) -> None:
    assert chosen("--since", text, "--until", text)[2:4] == (expected, expected)


@pytest.mark.parametrize(("text", "seconds"), [("90s", 90), ("10m", 600), ("2h", 7200), ("1d", 86400), ("0.5h", 1800)])
def test_ages(text: str, seconds: float) -> None:
    earliest = time.time() - seconds
    since = some(chosen("--since", text).since)
    assert earliest <= since <= time.time() - seconds


TIME = "expected a date like 2026-11-22T10:30 (UTC) or an age like 90s, 10m, 2h, 1d"


@pytest.mark.parametrize(
    ("option", "text", "expected"),
    [
        ("--drone", "x", "--drone: expected the id of a node, 0 to 65534, got 'x'"),
        ("--drone", "65535", "--drone: expected the id of a node, 0 to 65534, got '65535'"),
        ("--drone", "-1", "--drone: expected the id of a node, 0 to 65534, got '-1'"),
        ("--drone", "٣", "--drone: expected the id of a node, 0 to 65534, got '٣'"),
        ("--kind", "photo", "--kind: expected one of measurement, file, part, bytes, status, sealed, got 'photo'"),
        ("--since", "yesterday", f"--since: {TIME}, got 'yesterday'"),
        ("--until", "10", f"--until: {TIME}, got '10'"),
        ("--until", "10w", f"--until: {TIME}, got '10w'"),
        ("--since", "2026-02-30", f"--since: {TIME}, got '2026-02-30'"),
        ("--box", "1,2,3", "--box: expected SOUTH,WEST,NORTH,EAST in degrees, got '1,2,3'"),
        ("--box", "2,1,1,2", "--box: expected south -90 to 90, north from there to 90, west and east -180 to 180, "
         "got '2,1,1,2'"),
        ("--box", "nan,1,1,2", "--box: expected south -90 to 90, north from there to 90, west and east -180 to 180, "
         "got 'nan,1,1,2'"),
        ("--above", "high", "--above: expected a number, got 'high'"),
        ("--above", "inf", "--above: expected a number, got 'inf'"),
    ],
)  # fmt: skip
def test_a_wrong_option_is_one_line_that_says_what_was_expected(option: str, text: str, expected: str) -> None:
    with pytest.raises(ConfigError) as error:
        chosen(option, text)
    assert error.value.lines() == [expected]


def test_no_datum_is_older_than_its_node() -> None:
    """What the other tests rest on."""
    assert LIVED_S > 3000.0

"""`rass-mav ls` and `get` on stores, with and without a node."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from rass_mav.app.payloads import pack_file
from rass_mav.cli import main
from rass_mav.core.datum import TERMS, Kind, Terms
from rass_mav.ground.commands.data import HEADER
from rass_mav.wire.measurement import encode_measurement
from tests.app.app_nodes import said_by
from tests.commands import json_output, output

from .missions import EPOCH, HERE, Base

Capture = pytest.CaptureFixture[str]


@pytest.fixture
def base(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Base]:
    monkeypatch.chdir(tmp_path)
    base = Base(tmp_path / "rass-1.db")
    base.arrive(
        base.measurement(7, 0, HERE, age_s=20.0),
        base.measurement(8, 0, HERE._replace(reading=3.0), age_s=30.0)._replace(at_least=True),
        base.file(7, 1, "photo\x1b[31m.jpg", b"\xff\xd8"),
    )
    yield base
    base.close()


def lines(capsys: Capture, *words: str) -> list[str]:
    assert main(["ls", *words]) == 0
    said = capsys.readouterr()
    assert said.err == ""
    header, *rest = said.out.splitlines()
    assert header == HEADER
    return rest


def test_a_list_has_a_header_and_a_line_a_datum(base: Base, capsys: Capture) -> None:
    measured, older, file = lines(capsys)
    assert measured.split("  ")[-1] == "0.142 uSv/h, risk 0.250, at 47.3769000 8.5417000 412.0 m, +/- 2.1 m"
    assert "7-abc00001-0 " in measured
    assert " 2026-11-22T09:59:40.000Z " in measured
    assert "<2026-11-22T09:59:30.000Z" in older
    assert file.endswith(r"file photo\x1b[31m.jpg"), "nothing is executed on the terminal"


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--sort", "time"], ["8-0", "7-0", "7-1"]),
        (["--sort", "time", "--reverse"], ["7-1", "7-0", "8-0"]),
        (["--sort", "drone"], ["7-0", "7-1", "8-0"]),
        (["--sort", "reading", "--reverse"], ["8-0", "7-0", "7-1"]),
        (["--reverse"], ["7-1", "8-0", "7-0"]),
        (["--drone", "7", "--kind", "measurement"], ["7-0"]),
        (["--since", "2026-11-22T09:59:35"], ["7-0", "7-1"]),
        (["--above", "1"], ["8-0"]),
    ],
)
def test_it_is_sorted_and_filtered(base: Base, capsys: Capture, options: list[str], expected: list[str]) -> None:
    names = [f"{line.split()[0]}" for line in lines(capsys, "rass-1.db", *options)]
    assert names == [f"{name[0]}-{EPOCH:08x}-{name[2]}" for name in expected]
    assert [entry["id"] for entry in json_output(capsys, "ls", "rass-1.db", *options)["data"]] == names


def test_as_json_it_has_units_dates_and_errors(base: Base, capsys: Capture) -> None:
    measured, older, file = json_output(capsys, "ls")["data"]
    assert measured["measurement"]["unit"] == "usvh"
    assert measured["measurement"]["error_m"] == 2.1
    assert measured["utc"] == "2026-11-22T09:59:40.000Z"
    assert 1.0 <= measured["error_s"] < 10.0
    assert older["at_least"] is True
    assert "error_s" not in older
    assert file["name"] == "photo\x1b[31m.jpg"


def test_follow_shows_what_arrives_an_object_a_line(base: Base) -> None:
    with said_by(base.path.parent, "ls", "rass-1.db", "--follow", "--json", "--drone", "7", "9") as lines:
        assert [json.loads(next(lines))["kind"] for _ in range(2)] == ["measurement", "file"]
        base.wall += 5.0
        base.arrive(base.datum(8, 5, Kind.BYTES, b"not asked for"), base.datum(9, 0, Kind.BYTES, b"new"))
        assert json.loads(next(lines))["id"] == f"9-{EPOCH:08x}-0"


def test_get_writes_the_content_from_a_stores_file(base: Base, capsysbinary: pytest.CaptureFixture[bytes]) -> None:
    assert output(capsysbinary, "get", "-c", "rass-1.db", f"7-{EPOCH:08x}-1").out == b"\xff\xd8"
    assert main(["get", f"7-{EPOCH:08x}-1", "-o", "copy.jpg", "--json"]) == 0
    assert Path("copy.jpg").read_bytes() == b"\xff\xd8"
    assert json.loads(capsysbinary.readouterr().out)["bytes"] == 2


def test_terms_are_shown_and_no_part_of_the_contents(base: Base, capsysbinary: pytest.CaptureFixture[bytes]) -> None:
    longest = "x" * 251 + ".jpg"
    base.arrive(
        base.datum(8, 1, Kind.FILE | TERMS, Terms(9, 60).pack() + pack_file(longest, b"photo")),
        base.datum(8, 2, Kind.MEASUREMENT | TERMS, Terms(0).pack() + encode_measurement(HERE)),
        base.datum(8, 3, Kind.BYTES | TERMS, b"cut"),
        base.datum(8, 4, Kind.BYTES | TERMS, b"\xff\1\0\0of a later version"),
        base.datum(8, 5, Kind.BYTES | TERMS, Terms(9).pack() + b"struck")._replace(crc=0),
    )
    assert main(["ls", "--drone", "8", "--json", "--since", "2026-11-22T09:59:59"]) == 0
    file, measured, cut, later, struck = json.loads(capsysbinary.readouterr().out)["data"]
    assert (file["kind"], file["name"], file["priority"], file["ttl_s"]) == ("file", longest, 9, 60)
    assert (file["size"], measured["size"]) == (256 + 5, len(encode_measurement(HERE)))
    assert (measured["priority"], measured["measurement"]["unit"]) == (0, "usvh")
    assert "ttl_s" not in measured
    assert (cut["kind"], cut["malformed"]) == ("bytes", "truncated terms")
    assert (later["priority"], later["ttl_s"]) == (9, 1)
    assert (struck["kind"], struck["malformed"]) == ("bytes", "corrupt, its checksum does not match")
    assert output(capsysbinary, "get", f"8-{EPOCH:08x}-1").out == b"photo"
    assert output(capsysbinary, "get", f"8-{EPOCH:08x}-4").out == b"of a later version"


@pytest.mark.parametrize(
    ("words", "code", "error"),
    [
        (["ls", "nowhere.db"], 2, "nowhere.db: no such store"),
        (["ls", "--follow", "--sort", "time"], 2, "--follow: shows data as they arrive"),
        (["get", "7-00000000-0"], 1, "7-00000000-0: not in rass-1.db"),
        (["get", "seven"], 2, "expected an id like 7-0123abcd-42, or the name of a file in this store, got 'seven'"),
    ],
)
def test_a_mistake_is_one_line(base: Base, words: list[str], code: int, error: str, capsys: Capture) -> None:
    assert main(words) == code
    said = capsys.readouterr()
    assert said.err.startswith(error)
    assert len(said.err.splitlines()) == 1
    assert said.out == ""


def test_what_is_wrong_with_a_card_is_said_beside_what_could_be_read(base: Base, capsys: Capture) -> None:
    base.close()
    content = bytearray(base.path.read_bytes())
    content[:100] = bytes(100)
    base.path.write_bytes(content)
    assert main(["ls", "rass-1.db"]) == 0
    said = capsys.readouterr()
    assert len(said.out.splitlines()) == 4
    assert said.err.startswith("WARNING: rass-1.db: ")
    assert "3 data could be read" in said.err

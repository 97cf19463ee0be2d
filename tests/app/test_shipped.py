"""Files that come with the package are found by their names alone."""

from __future__ import annotations

from pathlib import Path

import pytest

from rass_mav.app.shipped import shipped_or
from tests.commands import output


def test_by_name_but_a_file_that_is_there_goes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert Path(shipped_or("px4.params")).is_file()
    assert Path(shipped_or("three-copters.yaml")).is_file()
    for other in ("px5.params", "no/px4.params", "./px4.params", "../README.md", "README.md", ""):
        assert shipped_or(other) == other
    (tmp_path / "px4.params").touch()
    assert shipped_or("px4.params") == "px4.params"


def test_commands_take_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert "ardupilot-4.7.parm: ok, " in output(capsys, "params", "check", "ardupilot-4.7.parm").out
    error = output(capsys, "sitl", "three-copters.yaml", "--vehicles", "9", "--mock", code=2).err
    assert error == "--vehicles: expected 1..3, the drones of three-copters.yaml, got 9\n"
    assert "none.params: " in output(capsys, "params", "check", "none.params", code=2).err

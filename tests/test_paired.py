"""Two programs are compared in the same runs (tools/paired.py)."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from tools import paired


def test_a_setting_that_loses_data_shows_against_the_same_seeds(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The program with itself differs in nothing; without replicas, among drones that die, it keeps and sends less."""
    files = [tmp_path / name for name in ("one", "same", "less")]
    checkout = tmp_path / "checkout"
    checkout.mkdir()
    (checkout / ".venv").symlink_to(Path(sys.prefix))
    for file, more in zip(files, ([], [], ["--set", "custody.replicas=false"]), strict=True):
        short = ["--steps", "60", "--set", "nodes=49"]
        command = ["run", str(checkout), str(file), "--cells", "dying", "--seeds", "1-2", *short, *more]
        paired.main(command)
        done = file.read_text()
        paired.main(command)
        assert file.read_text() == done, "what is done is not done again"
    for other in files[1:]:
        paired.main(["compare", str(files[0]), str(other)])
    same, less = (line.split("|") for line in capsys.readouterr().out.splitlines() if line.startswith("| dying"))
    assert same[2] == less[2] == " 2 "
    assert "+0.0000 ± 0.0000" in same[3]
    assert "x1.000 ± 0.000" in same[5]
    kept, sent = float(less[3].split()[1]), float(less[5].split()[1].removeprefix("x"))
    assert kept < 0
    assert sent < 1

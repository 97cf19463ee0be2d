"""All that fuzzing ever found interesting, once more; and a short run. A soak fuzzes each target."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

from tests.environment import environment

from .targets import TARGETS

CORPUS = Path(__file__).parent / "corpus"


def test_there_is_a_corpus_for_each_target_and_no_other() -> None:
    assert {path.name for path in CORPUS.iterdir()} == set(TARGETS)


@pytest.mark.no_cover
@pytest.mark.parametrize("name", TARGETS)
def test_the_corpus(name: str) -> None:
    inputs = sorted((CORPUS / name).iterdir())
    assert inputs
    for path in inputs:
        TARGETS[name](path.read_bytes())


@pytest.mark.no_cover
@pytest.mark.skipif(importlib.util.find_spec("atheris") is None, reason="atheris is not here (x86-64 Linux only)")
@pytest.mark.parametrize(
    ("target", "seconds", "runs"), [("frames", "1", "400"), pytest.param("all", "30", "-1", marks=pytest.mark.soak)]
)
def test_a_run_finds_nothing(target: str, seconds: str, runs: str, tmp_path: Path) -> None:
    run = subprocess.run(
        [sys.executable, "-m", "tests.fuzz", target, "--seconds", seconds, "--runs", runs],
        check=False,
        # Besides, two tools that watch each line would be in each other's way.
        env=environment(),
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stderr[-4000:]
    # What is new does not go among the inputs of the checkout.
    assert {path.name for path in (tmp_path / "build" / "fuzz").iterdir()} == (
        set(TARGETS) if target == "all" else {target}
    )

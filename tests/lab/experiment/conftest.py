"""What holds for all tests of experiments."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from coverage import Coverage
from matplotlib.figure import Figure

from rass_mav.lab.experiment import runner
from rass_mav.lab.swarm.world import World

PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture
def pixels() -> None:
    """Figures are drawn to the end."""


@pytest.fixture(autouse=True)
def _figures_without_pixels(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures are made, but their pixels take longer than the small runs: one test of each kind of figure has them."""
    if "pixels" not in request.fixturenames:
        monkeypatch.setattr(Figure, "savefig", _write_no_pixels)


def _write_no_pixels(figure: Figure, path: Path, **options: Any) -> None:
    path.write_bytes(PNG)


class _HardlyMeasuredWorld(World):
    """Coverage takes three times as long as the steps: it is measured in one of seven. They are all alike."""

    def step(self) -> None:
        measurement = Coverage.current()
        if measurement is None or self.t % 7 == 0:
            super().step()
            return
        measurement.stop()
        try:
            super().step()
        finally:
            measurement.start()


@pytest.fixture(autouse=True)
def _steps_hardly_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is around the swarm is measured in full."""
    monkeypatch.setattr(runner, "World", _HardlyMeasuredWorld)

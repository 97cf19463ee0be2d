"""What holds for all tests of experiments."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from matplotlib.figure import Figure

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

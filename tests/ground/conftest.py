"""What the tests on the ground share."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from .missions import Base


@pytest.fixture
def base(tmp_path: Path) -> Iterator[Base]:
    """A base's store, in which nothing has arrived yet."""
    base = Base(tmp_path / "base.db")
    yield base
    base.close()

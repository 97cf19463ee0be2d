"""The tests that begin first."""

from __future__ import annotations

from .conftest import DEAREST


def test_what_begins_first_is_there() -> None:
    root = DEAREST.parents[1]
    for name in DEAREST.read_text(encoding="utf-8").split():
        path, _, function = name.partition("::")
        assert f"def {function}(" in (root / path).read_text(encoding="utf-8"), f"{DEAREST.name}: {name} is no test"

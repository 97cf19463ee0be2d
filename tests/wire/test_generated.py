"""What is written from the table of messages is committed as the table gives it: `python -m tools.wire` writes it."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools.wire import files

ROOT = Path(__file__).parents[2]
FILES = files()


@pytest.mark.parametrize("name", FILES)
def test_it_is_what_the_table_gives(name: str) -> None:
    assert (ROOT / name).read_text(encoding="utf-8") == FILES[name]

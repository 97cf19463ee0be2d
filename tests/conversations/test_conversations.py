"""Replays the conversations. `REWRITE=1` writes down what the nodes say now (README.md)."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from .conversation import Conversation, read, written

HERE = Path(__file__).parent
FILES = sorted(HERE.glob("*/*.txt"))


def test_there_are_conversations_of_each_kind() -> None:
    assert {path.parent.name for path in FILES} == {"arrivals", "custody", "replicas", "routes"}


@pytest.mark.parametrize("path", FILES, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_nodes_say_what_is_written_down(path: Path) -> None:
    blocks, conversation = read(path), Conversation()
    for block in blocks:
        found = conversation.run(block.command)
        if os.environ.get("REWRITE"):
            block.expected = found
        assert found == block.expected, f"after: {block.command}"
    if os.environ.get("REWRITE"):
        path.write_text(written(blocks), encoding="utf-8")
    assert path.read_text(encoding="utf-8") == written(blocks)

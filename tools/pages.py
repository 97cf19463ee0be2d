"""Pages of docs/ of which parts are generated: each part stands between two marks, and the rest is written by hand.

<!-- layout: Beacon -->
...
<!-- end of layout -->
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

ROOT = Path(__file__).parents[1]
_PART = re.compile(r"(<!-- (layout|generated): ([\w ]+) -->)\n.*?(<!-- end of \2 -->)", re.S)


def filled(page: str, parts: Mapping[str, Sequence[str]]) -> str:
    """The text of a page with the lines of each part between its marks. KeyError: there is no such part."""

    def part(marks: re.Match[str]) -> str:
        return "\n".join([marks[1], *parts[marks[3]], marks[4]])

    return _PART.sub(part, (ROOT / page).read_text(encoding="utf-8"))


def named(page: str) -> list[str]:
    """The parts of a page."""
    return [marks[3] for marks in _PART.finditer((ROOT / page).read_text(encoding="utf-8"))]


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """The lines of a table."""
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return [*lines, *("| " + " | ".join(cell.replace("|", r"\|") for cell in row) + " |" for row in rows)]


def write(files: Mapping[str, str]) -> None:
    """Write files, by path."""
    for name, text in files.items():
        (ROOT / name).write_text(text, encoding="utf-8")

"""All that travels in a TUNNEL: what the code knows, and what docs/reference/protocol.md shows."""

from __future__ import annotations

import importlib
import pkgutil
import re
from pathlib import Path

from rass_mav import wire
from rass_mav.wire import codec
from tools.wire_table import BLOCKS, KEYED

_DOCS = Path(__file__).parents[2] / "docs"


def beside() -> dict[int, str]:
    """The payloads that are no messages of core: type in the second byte, and title."""
    return {layout.number: layout.title for layout in KEYED}


def modules() -> list[object]:
    """Of `rass_mav.wire`."""
    return [importlib.import_module(f"{wire.__name__}.{info.name}") for info in pkgutil.iter_modules(wire.__path__)]


def blocks() -> dict[int, str]:
    """The kinds of blocks, and their names in the code."""
    return {block.kind: block.name for block in BLOCKS}


def page() -> str:
    """docs/reference/protocol.md, what keys add to it, and the messages of a policy."""
    names = ("protocol.md", "protocol-keys.md", "policies.md")
    return "".join(next(_DOCS.rglob(name)).read_text(encoding="utf-8") for name in names)


def examples() -> dict[str, bytes]:
    """Every payload that the page shows, by its name there."""
    return {m[1]: bytes.fromhex(m[2]) for m in re.finditer(r"^\| `([a-z-]+)` \| `([0-9a-f]+)` \|", page(), re.M)}


def type_of(payload: bytes) -> int:
    """The type of a payload of this version."""
    low = payload[0] & 15
    return payload[1] if low == codec.MORE else low

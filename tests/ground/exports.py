"""Exports, and what programs of others read in them."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest

from rass_mav.core.datum import Datum
from rass_mav.ground.formats import Exported, format_of

from .mission_stores import archive, stored

needs_gdal = pytest.mark.skipif(
    shutil.which("ogrinfo") is None, reason="ogrinfo is not installed (Debian: apt install gdal-bin)"
)


def exported(folder: Path, name: str, data: Iterable[Datum], **options: Any) -> tuple[Path, Exported]:
    """Data, by way of a store, in a format."""
    out = folder / "out"
    with archive(stored(folder / "base.db", data, **options)) as source:
        return out, format_of(name).write(source.entries(), out, source)


def gdal(*words: str | Path) -> str:
    """What a program of GDAL prints; it must not complain."""
    done = subprocess.run([str(word) for word in words], check=True, capture_output=True, text=True, timeout=60)
    assert done.stderr == ""
    return done.stdout


def features(path: Path, layer: str) -> list[dict[str, Any]]:
    """The features of a layer as GDAL reads them; without a name, of the only one."""
    found = json.loads(gdal("ogr2ogr", "-f", "GeoJSON", "/vsistdout/", path, *filter(None, [layer])))
    assert isinstance(found["features"], list)
    return found["features"]

"""The programs of others are those that the README names, and the page asks for nothing from elsewhere."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

STATIC = Path(__file__).parents[3] / "rass_mav" / "ground" / "page" / "static"
VENDOR = STATIC / "vendor"
OURS = [path for path in STATIC.rglob("*") if path.suffix in (".js", ".css", ".html") and VENDOR not in path.parents]


def test_their_checksums_are_those_of_the_readme() -> None:
    said = dict(re.findall(r"\| `([^`]+)` \| `([0-9a-f]{64})` \|", (VENDOR / "README.md").read_text(encoding="utf-8")))
    files = [path for path in VENDOR.rglob("*") if path.is_file() and path.name != "README.md"]
    assert said == {
        path.relative_to(VENDOR).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files
    }


def test_no_file_of_ours_names_another_place_or_has_inline_code() -> None:
    assert len(OURS) > 15
    for path in OURS:
        text = path.read_text(encoding="utf-8")
        assert not re.search(r"https?:|//\w+\.\w|@import|url\(", text), path.name
        assert not re.search(r"\beval\(|new Function|innerHTML|outerHTML|insertAdjacentHTML|document\.write", text), (
            path.name
        )
        if path.suffix == ".html":
            assert not re.search(r"<script(?! [^>]*src=)|<style|\son\w+=|\sstyle=", text), path.name


def test_every_file_that_a_file_names_is_there() -> None:
    for path in OURS:
        text = path.read_text(encoding="utf-8")
        for name in re.findall(r'"/static/([^"]+)"', text):
            assert (STATIC / name).is_file(), name
        for name in re.findall(r'from "(\./[^"]+)"', text):
            assert (path.parent / name).is_file(), name

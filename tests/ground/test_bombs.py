"""Packed files that are much larger than what came of them: nobody's disk or memory is filled without being asked."""

from __future__ import annotations

import base64
import json
import os
import resource
import subprocess
import sys
from hashlib import sha256
from importlib.util import find_spec
from pathlib import Path

import pytest

from rass_mav.app.packing import packer
from rass_mav.cli import main
from rass_mav.core.datum import Datum, Kind
from rass_mav.wire.file import ZLIB, ZSTD, Manifest, cut_file, encode_manifest
from tests.commands import json_output, output

from .cut_files import got, part, store
from .mission_stores import put

ZEROS = bytes(1 << 20)
PACKINGS = [
    ZLIB,
    pytest.param(ZSTD, marks=pytest.mark.skipif(
        sys.version_info < (3, 14) and find_spec("backports.zstd") is None, reason="no zstd (extra zstd)",
    )),
]  # fmt: skip


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def bomb(packing: int, mebibytes: int, *, claims: int | None = None) -> list[Datum]:
    """A file of zeros, manifest first. `claims`: the size that the manifest says, bytes."""
    size = mebibytes * len(ZEROS)
    one, digest = packer(packing), sha256()
    packed = b""
    for _ in range(mebibytes):
        packed += one.compress(ZEROS)
        digest.update(ZEROS)
    packed += one.flush()
    cut = cut_file(size, len(packed), digest.digest(), packing, 1 << 14)
    manifest = Manifest(cut, "bomb", size if claims is None else claims, digest.digest())
    parts = (packed[cut.offset(index) :][: cut.size(index)] for index in cut.indexes())
    return [
        put(0, Kind.MANIFEST, encode_manifest(manifest)),
        *(part(cut, index, content, 1 + index) for index, content in enumerate(parts)),
    ]


@pytest.mark.parametrize("packing", PACKINGS)
def test_a_bomb_is_not_unpacked_unless_asked_for(packing: int, capsysbinary: pytest.CaptureFixture[bytes]) -> None:
    store(bomb(packing, 40))
    for options in ([], ["--json"], ["-o", "out"], ["--partial"]):
        code, out, err = got(capsysbinary, "bomb", *options)
        assert code == 1
        assert not out or json.loads(out).keys() == {"error"}
        assert len(err.splitlines()) == 1
        assert "--any-size" in err
    assert not Path("out").exists()
    assert main(["get", "-c", "rass-1.db", "bomb", "--any-size", "-o", "out"]) == 0
    assert Path("out").read_bytes() == 40 * ZEROS


@pytest.mark.parametrize("packing", PACKINGS)
def test_a_bomb_is_none_of_an_export_and_is_said(packing: int, capsysbinary: pytest.CaptureFixture[bytes]) -> None:
    store(bomb(packing, 40), [put(900, Kind.BYTES, b"beside it")])
    assert b"--any-size" in output(capsysbinary, "export", "rass-1.db", "--format", "files", "-o", "out").out
    assert sum(path.stat().st_size for path in Path("out").iterdir()) < 10_000


@pytest.mark.parametrize("packing", PACKINGS)
@pytest.mark.parametrize("manifest", [False, True])
def test_a_bomb_that_hides_its_size_is_cut(
    packing: int, manifest: bool, capsysbinary: pytest.CaptureFixture[bytes]
) -> None:
    first, *parts = bomb(packing, 40, claims=1000)
    store([first] if manifest else [], parts)
    listed = json_output(capsysbinary, "ls", "rass-1.db")
    name = "bomb" if manifest else listed["without_manifest"][0]["name"]
    code, out, _ = got(capsysbinary, name, "-o", "out")
    assert (code, out) == (1, b"")
    assert not Path("out").exists()


def test_small_files_and_those_that_are_packed_well_are_none(capsysbinary: pytest.CaptureFixture[bytes]) -> None:
    store(bomb(ZLIB, 16))
    assert got(capsysbinary, "bomb") == (0, 16 * ZEROS, "")


@pytest.mark.no_cover
def test_json_takes_no_memory_for_the_contents() -> None:
    """The whole process, with a quarter of what the contents in base64 take."""
    store(bomb(ZLIB, 128))
    words = ["get", "-c", "rass-1.db", "bomb", "--json", "--any-size"]
    with open("out.json", "wb") as out:
        subprocess.run(
            [sys.executable, "-m", "rass_mav", *words], stdout=out, check=True,
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (256 << 20, 256 << 20)),
        )  # fmt: skip
    assert os.path.getsize("out.json") > 128 * len(ZEROS) * 4 // 3
    head, content = Path("out.json").read_bytes().split(b'"content": "')
    assert json.loads(head + b'"content": ""}')["bytes"] == 128 * len(ZEROS)
    assert content == base64.b64encode(128 * ZEROS) + b'"}\n'

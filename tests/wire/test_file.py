"""Manifests and parts of files: their bytes, what is refused, and that a cut is gapless."""

from __future__ import annotations

import re
from hashlib import sha256
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.errors import MalformedError
from rass_mav.wire.file import (
    MOST_FILE,
    PART_HEAD,
    PLAIN,
    ZLIB,
    Cut,
    Manifest,
    Part,
    cut_file,
    decode_head,
    decode_manifest,
    decode_part,
    encode_manifest,
    encode_part,
)

PROTOCOL = Path(__file__).parents[2] / "docs" / "reference" / "payloads.md"

CONTENT = bytes(range(100))
CUT = cut_file(100, 100, sha256(CONTENT).digest(), PLAIN, 40)
MANIFEST = Manifest(CUT, "photo.jpg", 100, sha256(CONTENT).digest(), 1_795_341_600.25, (47.3769, 8.5417, 412.5))
PART = Part(CUT, 2, CONTENT[68:])

digests = st.binary(min_size=32, max_size=32)
redundancies = st.none() | st.tuples(st.integers(1, 20), st.integers(1, 30)).map(lambda kn: (kn[0], sum(kn)))


def golden(name: str) -> bytes:
    found = re.search(rf"^\| `{name}` \| `([0-9a-f]+)` \|", PROTOCOL.read_text(), re.MULTILINE)
    assert found is not None, f"docs/reference/payloads.md has no {name}"
    return bytes.fromhex(found[1])


def test_the_bytes_are_those_of_the_page() -> None:
    assert encode_manifest(MANIFEST) == golden("file manifest")
    assert decode_manifest(golden("file manifest")) == MANIFEST
    assert encode_part(PART) == golden("file part")
    assert decode_part(golden("file part")) == PART


def test_a_manifest_of_a_photo_fits_one_frame_with_its_seal() -> None:
    assert len(encode_manifest(MANIFEST)) <= 97


@st.composite
def cuts(draw: st.DrawFn) -> Cut:
    length = draw(st.integers(1, 3000))
    packing = draw(st.sampled_from((PLAIN, ZLIB)))
    return cut_file(length, length, draw(digests), packing, draw(st.integers(1, 300)), draw(redundancies))


@given(cuts())
def test_a_cut_has_no_gap_and_no_empty_datum(cut: Cut) -> None:
    at = count = 0
    for index in cut.indexes():
        assert cut.offset(index) == at
        assert 0 < cut.size(index) <= cut.part_bytes
        at += cut.size(index)
        count += 1
    assert (at, count) == (cut.total(), cut.data())
    own = [i for i in cut.indexes() if not cut.needed or i % cut.shares < cut.needed]
    assert (sum(map(cut.size, own)), len(own)) == (cut.length, cut.parts)


@given(
    digests, st.text(min_size=1, max_size=60), st.integers(1, MOST_FILE), st.integers(1 << 14, 1 << 16),
    st.none() | st.integers(-(10**12), 10**13), st.none() | st.tuples(st.floats(-90, 90), st.floats(-180, 180)),
)  # fmt: skip
def test_what_is_written_is_read(
    digest: bytes, name: str, size: int, most: int, ms: int | None, place: tuple[float, float] | None
) -> None:
    cut = cut_file(size, size, digest, PLAIN, most)
    time = None if ms is None else ms / 1000
    where = None if place is None else (round(place[0], 7), round(place[1], 7), 12.5)
    manifest = Manifest(cut, name.encode(errors="replace").decode(), size, digest, time, where)
    found = decode_manifest(encode_manifest(manifest))
    assert found._replace(place=None) == manifest._replace(place=None)
    assert found.place == (where if where is None else pytest.approx(where, abs=1e-6))
    assert encode_manifest(found) == encode_manifest(manifest)


def test_a_later_version_may_say_more_after_the_name() -> None:
    assert decode_manifest(encode_manifest(MANIFEST) + b"more") == MANIFEST


@pytest.mark.parametrize(
    ("payload", "why"),
    [
        (b"", "truncated"),
        (encode_manifest(MANIFEST)[:-1], "truncated name"),
        (encode_manifest(MANIFEST)[:40], "truncated manifest: 40 bytes, expected at least "),
        (b"\2" + encode_manifest(MANIFEST)[1:], "version"),
        (encode_manifest(MANIFEST._replace(size=101)), "101 bytes in 100"),
        (encode_manifest(MANIFEST._replace(digest=bytes(32))), "key"),
        (encode_manifest(MANIFEST._replace(cut=CUT._replace(packing=9))), "packing"),
        (encode_manifest(MANIFEST._replace(cut=CUT._replace(part_bytes=0))), "in parts of 0"),
        (encode_manifest(MANIFEST._replace(cut=CUT._replace(part_bytes=70_000))), "in parts of 70000"),
        (encode_manifest(MANIFEST._replace(cut=CUT._replace(length=0))), "0 bytes"),
        (encode_manifest(MANIFEST._replace(cut=CUT._replace(length=MOST_FILE + 1))), "bytes in parts"),
        (encode_manifest(MANIFEST._replace(cut=CUT._replace(needed=8, shares=8))), "redundancy 8/8"),
        (encode_manifest(MANIFEST._replace(cut=CUT._replace(shares=8))), "redundancy 0/8"),
    ],
)
def test_a_forged_manifest_is_malformed(payload: bytes, why: str) -> None:
    with pytest.raises(MalformedError, match=why):
        decode_manifest(payload)


@pytest.mark.parametrize(
    ("payload", "why"),
    [
        (encode_part(PART)[: PART_HEAD - 1], "truncated"),
        (encode_part(PART._replace(number=3)), "part 3 of 3"),
        (encode_part(PART._replace(number=(1 << 32) - 1)), "of 3"),
        (encode_part(PART) + b"x", "has 33 bytes, expected 32"),
        (encode_part(PART)[:-1], "has 31 bytes, expected 32"),
    ],
)
def test_a_forged_part_is_malformed(payload: bytes, why: str) -> None:
    with pytest.raises(MalformedError, match=why):
        decode_part(payload)


@given(st.binary(max_size=200) | st.binary(max_size=120).map(lambda tail: encode_manifest(MANIFEST)[:24] + tail))
def test_any_bytes_parse_or_are_malformed(payload: bytes) -> None:
    for decode in (decode_manifest, decode_head, decode_part):
        try:
            decode(payload)
        except MalformedError:
            continue

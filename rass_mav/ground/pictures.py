"""Which images browsers get: PNG, JPEG and WebP of a bounded size, told by their contents and not by their names."""

from __future__ import annotations

import struct
from collections.abc import Callable

#: Bytes of an image, pixels on a side, and pixels: a browser needs four bytes of memory for each.
MOST_BYTES = 16 << 20
MOST_SIDE, MOST_PIXELS = 16_384, 64_000_000
#: Segments before the size of a JPEG.
_MOST_SEGMENTS = 500
# Of the small picture in a photograph: where it begins, and its bytes.
_BEGINS, _SIZE = 0x0201, 0x0202
# Start of frame; without those that are tables.
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}

#: Width and height, pixels.
Size = tuple[int, int]


def kind_of(image: bytes) -> str | None:
    """What browsers call the type of an image; None: it is none that they get.

    Only the beginning is looked at: the size that it says bounds what a browser decodes, whatever follows.
    """
    if len(image) > MOST_BYTES:
        return None
    for kind, size_of in _KINDS:
        try:
            size = size_of(image)
        except (struct.error, IndexError):
            size = None
        if size is not None:
            sound = all(1 <= side <= MOST_SIDE for side in size) and size[0] * size[1] <= MOST_PIXELS
            return kind if sound else None
    return None


def small_of(image: bytes) -> bytes | None:
    """The small JPEG that cameras put beside a photograph, in its Exif data (JEITA CP-3451, 4.5.5 and 4.6.2); None:
    there is none."""
    try:
        found = _exif(image)
    except (struct.error, IndexError):
        return None
    return found if found is not None and kind_of(found) == "image/jpeg" else None


def _exif(image: bytes) -> bytes | None:
    if image[:3] != b"\xff\xd8\xff":
        return None
    at = 2
    for _ in range(_MOST_SEGMENTS):
        marker, length = struct.unpack_from(">xBH", image, at)
        if image[at] != 0xFF or length < 2 or marker in _FRAMES or marker == 0xDA:
            return None
        if marker == 0xE1 and image[at + 4 : at + 10] == b"Exif\0\0":
            return _second(image[at + 10 : at + 2 + length])
        at += 2 + length
    return None


def _second(tiff: bytes) -> bytes | None:
    """The JPEG of the second directory of a TIFF file: its tags say where it begins and how long it is."""
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(tiff[:4])
    if order is None:
        return None
    (first,) = struct.unpack_from(f"{order}I", tiff, 4)
    (entries,) = struct.unpack_from(f"{order}H", tiff, first)
    (second,) = struct.unpack_from(f"{order}I", tiff, first + 2 + 12 * entries)
    if second == 0:
        return None
    (entries,) = struct.unpack_from(f"{order}H", tiff, second)
    tags = dict(
        struct.unpack_from(f"{order}HxxxxxxI", tiff, second + 2 + 12 * number)
        for number in range(min(entries, _MOST_SEGMENTS))
    )
    begin, size = tags.get(_BEGINS, 0), tags.get(_SIZE, 0)
    return tiff[begin : begin + size] if begin > 0 and begin + size <= len(tiff) else None


def _png(image: bytes) -> Size | None:
    """ISO/IEC 15948: a signature, and first of all a chunk IHDR of 13 bytes."""
    if image[:16] != b"\x89PNG\r\n\x1a\n\0\0\0\x0dIHDR":
        return None
    width, height = struct.unpack_from(">II", image, 16)
    return width, height


def _jpeg(image: bytes) -> Size | None:
    """ITU-T T.81: segments until the start of a frame, each with its marker and its length."""
    if image[:3] != b"\xff\xd8\xff":
        return None
    at = 2
    for _ in range(_MOST_SEGMENTS):
        while image[at + 1] == 0xFF:
            at += 1
        marker, length = struct.unpack_from(">xBH", image, at)
        if image[at] != 0xFF or length < 2:
            return None
        if marker in _FRAMES:
            height, width = struct.unpack_from(">HH", image, at + 5)
            return width, height
        if marker == 0xDA:
            return None
        at += 2 + length
    return None


def _webp(image: bytes) -> Size | None:
    """RFC 9649: a RIFF container, and first of all one of three chunks."""
    if image[:4] != b"RIFF" or image[8:12] != b"WEBP":
        return None
    chunk = image[12:16]
    if chunk == b"VP8X":
        width, height = (int.from_bytes(image[at : at + 3], "little") + 1 for at in (24, 27))
        return (width, height) if len(image) >= 30 else None
    if chunk == b"VP8L" and image[20] == 0x2F:
        (bits,) = struct.unpack_from("<I", image, 21)
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if chunk == b"VP8 " and image[23:26] == b"\x9d\x01\x2a":
        width, height = struct.unpack_from("<HH", image, 26)
        return width & 0x3FFF, height & 0x3FFF
    return None


_KINDS: tuple[tuple[str, Callable[[bytes], Size | None]], ...] = (
    ("image/png", _png), ("image/jpeg", _jpeg), ("image/webp", _webp),
)  # fmt: skip

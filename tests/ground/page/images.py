"""Images, true and forged."""

from __future__ import annotations

import io
import struct
import zlib

import pytest


def image(format: str, size: tuple[int, int] = (64, 48), colour: str = "darkred") -> bytes:
    """A true one: PNG, JPEG, WEBP or another that Pillow writes."""
    pillow = pytest.importorskip("PIL.Image", reason="pillow is not installed (extra dev)")
    out = io.BytesIO()
    pillow.new("RGB", size, colour).save(out, format)
    return out.getvalue()


def png_head(width: int, height: int) -> bytes:
    """A PNG that says it is so large, and has no contents."""
    head = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + head + struct.pack(">I", zlib.crc32(head))

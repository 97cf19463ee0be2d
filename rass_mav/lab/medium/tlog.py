"""Telemetry logs (.tlog): for each message 8 bytes, big-endian microseconds since 1970, then the MAVLink frame."""

from __future__ import annotations

from typing import IO


class TlogWriter:
    """Writes frames as ground stations do, so that MAVExplorer, QGroundControl and pymavlink can read them."""

    def __init__(self, file: IO[bytes]) -> None:
        """`file`: open for writing, in binary; the caller closes it."""
        self._write = file.write

    def record(self, frame: bytes, unix_s: float) -> None:
        """Write a frame with its time, in seconds since 1970."""
        self._write(round(unix_s * 1e6).to_bytes(8, "big") + frame)

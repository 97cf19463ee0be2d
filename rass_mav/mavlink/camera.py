"""What a camera says about a picture that it has taken (CAMERA_IMAGE_CAPTURED)."""

from __future__ import annotations

from typing import NamedTuple

from rass_mav.errors import MalformedError

from .dialect import common
from .frames import Frame

CAMERA_IMAGE_CAPTURED: int = common.MAVLINK_MSG_ID_CAMERA_IMAGE_CAPTURED
_captured = common.MAVLink_camera_image_captured_message.unpacker
_MAX_LATITUDE, _MAX_LONGITUDE = 900_000_000, 1_800_000_000


class Capture(NamedTuple):
    """A picture."""

    name: str
    """Of its file, without folders; never empty."""
    time: float | None
    """When it was taken, seconds since 1970; None: the camera does not know."""
    place: tuple[float, float, float] | None
    """Where: degrees, and metres above mean sea level; None: the camera does not know."""


def read_capture(frame: Frame) -> Capture:
    """The picture of a CAMERA_IMAGE_CAPTURED. Raises `MalformedError`: it was not taken, or has no file."""
    payload = frame.payload.ljust(_captured.size, b"\0")
    time_us, _, lat, lon, alt, _, *_, result, url = _captured.unpack_from(payload)
    name = url.split(b"\0")[0].decode(errors="replace").replace("\\", "/").rpartition("/")[2]
    if result != 1 or not name:
        raise MalformedError("a picture that was not taken, or without a file")
    # Before it has a position, a camera says 0, 0.
    placed = (lat, lon) != (0, 0) and abs(lat) <= _MAX_LATITUDE and abs(lon) <= _MAX_LONGITUDE
    return Capture(name, time_us / 1e6 if time_us else None, (lat / 1e7, lon / 1e7, alt / 1e3) if placed else None)

"""Photographs and lines for a report that is one file: as many bytes of photographs as can be mailed."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Callable
from typing import Any, NamedTuple

from rass_mav.errors import RassError

from .album import Album
from .entry import Data, Entry, Place
from .pictures import kind_of, small_of

#: Bytes of all photographs in a report, as it has them: in base64.
MOST_ENCLOSED = 2 << 20
#: Of a photograph with more bytes, the small picture is taken that its camera has put in it, if there is one.
WHOLE_BYTES = 64 << 10


class Note(NamedTuple):
    """A photograph or a line."""

    about: dict[str, Any]
    """As of `Album.plain`."""
    image: str
    """A `data:` address; empty: it is a line, or left out."""
    why: str
    """Why it is left out; empty: it is not."""


def enclosed(album: Album, data: Data, place_of: Callable[[Entry], Place | None]) -> list[Note]:
    """The latest, in the order of time. `place_of`: where a datum was created, if it does not say so."""
    found: list[Note] = []
    left = MOST_ENCLOSED
    # Where not all find room, the latest do.
    for about in reversed(album.plain(place_of)):
        image, why = ("", "") if about["text"] is not None else _image(album, data, about)
        if len(image) > left:
            image, why = "", f"this report has {MOST_ENCLOSED >> 20} MiB of photographs"
        left -= len(image)
        found.append(Note(about, image, why))
    return found[::-1]


def _image(album: Album, data: Data, about: dict[str, Any]) -> tuple[str, str]:
    """A `data:` address, or why there is none."""
    entry = album.find(about["id"])
    if entry is None:
        arrived, needed = about["parts"] or (0, 0)
        return "", f"{arrived:,} of {needed:,} parts have arrived" if arrived < needed else "it is too large"
    try:
        image = album.read(entry, data)
    except RassError as error:
        return "", str(error)
    kind = kind_of(image)
    if kind is None:
        return "", "not a PNG, JPEG or WebP image that browsers display"
    if len(image) > WHOLE_BYTES:
        image = small_of(image) or image
    return f"data:{kind};base64,{b64encode(image).decode()}", ""

"""A reading that a program hands in (docs/integrate/programs.md): its fields, and what can be wrong with them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from datetime import datetime, timezone
from typing import Annotated

from rass_mav.config.sections import Meta, NonNegative, Section
from rass_mav.errors import MalformedError
from rass_mav.sensor.dose import STATED

#: Longest reason why a line is no reading, characters.
MOST_REASON = 1000
#: A number above this is no date in seconds since 1970 (the year 5138), but probably one in milliseconds.
_MOST_DATE = 1e11
# Bounds that no place on Earth exceeds, metres.
_LOWEST_M, _HIGHEST_M = -12_000, 100_000


class HandedReading(Section):
    """A reading, and when and where it was measured."""

    value: NonNegative
    """In `unit`, as the detector shows it."""
    unit: Annotated[str, Meta(one_of=STATED.keys)]
    """A key of `STATED`."""
    time: float | str | None = None
    """Seconds since 1970, or ISO 8601; null: now."""
    latitude: Annotated[float, Meta(ge=-90, le=90)] | None = None
    """Degrees; null: where the vehicle is."""
    longitude: Annotated[float, Meta(ge=-180, le=180)] | None = None
    """Degrees."""
    altitude: Annotated[float, Meta(ge=_LOWEST_M, le=_HIGHEST_M)] | None = None
    """Metres above mean sea level."""

    def mistakes(self) -> Iterator[str]:
        """A place has three numbers, and no receiver without a fix knows one."""
        place = (self.latitude, self.longitude, self.altitude)
        if None in place and place != (None, None, None):
            yield "latitude, longitude, altitude: expected all three, or none"
        if place[:2] == (0.0, 0.0):
            yield "latitude, longitude: 0, 0 comes from a receiver without a fix: omit the position"
        if isinstance(self.time, float) and abs(self.time) > _MOST_DATE:
            yield f"time: expected seconds since 1970, got {self.time:g}"
        if isinstance(self.time, str):
            try:
                date_of(self.time)
            except MalformedError as error:
                yield f"time: {error}"

    @property
    def date(self) -> float | None:
        """When it was measured, seconds since 1970; None: now."""
        return date_of(self.time) if isinstance(self.time, str) else self.time

    @property
    def place(self) -> tuple[float, float, float] | None:
        """Degrees, and metres above mean sea level; None: where the vehicle is."""
        if self.latitude is None or self.longitude is None or self.altitude is None:
            return None
        return self.latitude, self.longitude, self.altitude


def date_of(text: str) -> float:
    """Seconds since 1970 of a date in ISO 8601, in UTC if it names no zone. Raises `MalformedError`."""
    try:
        # Before Python 3.11 it does not know the Z.
        date = datetime.fromisoformat(re.sub("[Zz]$", "+00:00", text))
        return (date if date.tzinfo else date.replace(tzinfo=timezone.utc)).timestamp()
    except (ValueError, OverflowError):
        raise MalformedError(f"expected a date like 2026-11-22T10:30 (UTC), got {text!r}") from None

"""The requests that hand in readings. Loaded with the first one."""

from __future__ import annotations

from typing import Annotated, Any

from rass_mav.config.sections import Meta

from .control import Client, ControlServer, Request
from .handed import MOST_REASON, HandedReading
from .measures import Measures


class MeasureRequest(HandedReading, Request):
    """A reading that a program hands in."""

    async def answer(self, control: ControlServer, client: Client) -> dict[str, Any]:
        """What became of it."""
        return await _measures(control).take(self)

    @classmethod
    def misread(cls, control: ControlServer, reason: str) -> None:
        """It is a refused reading."""
        _measures(control).refuse(reason)


class RefusedRequest(Request):
    """A line that is no reading, from a program that checks them itself (`rass-mav measure --follow`)."""

    reason: Annotated[str, Meta(min_length=1, max_length=MOST_REASON)]

    async def answer(self, control: ControlServer, client: Client) -> dict[str, Any]:
        """Counted as a refused reading."""
        _measures(control).refuse(self.reason)
        return {}


def _measures(control: ControlServer) -> Measures:
    if control.measures is None:
        control.measures = Measures(control.driver, control.sensor, control.files.track)
    return control.measures

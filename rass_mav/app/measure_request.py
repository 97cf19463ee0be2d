"""The request that hands in a reading. Loaded with the first one."""

from __future__ import annotations

from typing import Any

from .control import Client, ControlServer, Request
from .handed import HandedReading
from .measures import Measures


class MeasureRequest(HandedReading, Request):
    """A reading that a program hands in."""

    async def answer(self, control: ControlServer, client: Client) -> dict[str, Any]:
        """What became of it."""
        if control.measures is None:
            control.measures = Measures(control.driver, control.sensor, control.files.track)
        return await control.measures.take(self)

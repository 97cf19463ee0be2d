"""Readings that programs hand in (docs/integrate/programs.md). They go the way of a sensor's; loaded with the first
one."""

from __future__ import annotations

import math
import time
from typing import Any

from rass_mav.agent.floods import Allowance
from rass_mav.errors import ControlError, MalformedError, RassError
from rass_mav.mavlink.telemetry import FIRST_DATE, Position, Reading
from rass_mav.sensor.dose import converted
from rass_mav.sensor.settings import SensorSettings
from rass_mav.wire.measurement import MOST_READING

from .driver import Driver
from .handed import HandedReading
from .track import NEAR_S, Track

#: Data made of them in so many seconds, at most. A measurement that is due does not count.
MOST_DATA, IN_S = 100, 60.0
#: By how much the times of readings may be wrong, seconds.
CLOCKS_S = 2.0
#: How old a reading may be, seconds. On the wire, ages end at 24 days.
OLDEST_S = 7 * 86400.0


class Measures:
    """Takes them."""

    def __init__(self, driver: Driver, sensor: SensorSettings, track: Track) -> None:
        self._driver = driver
        self._sensor = sensor
        self._track = track
        self._allowance = Allowance(MOST_DATA, IN_S)
        self._readings = self._data = self._refused = 0
        self._refusal = ""
        self._last: float | None = None

    def report(self) -> dict[str, Any]:
        """For `status`."""
        return {
            "readings": self._readings,
            "data": self._data,
            "refused": self._refused,
            "last_refusal": self._refusal or None,
            "age_s": None if self._last is None else round(self._driver.now() - self._last, 3),
        }

    def refuse(self, reason: str) -> None:
        """Count a refused reading."""
        self._refused += 1
        self._refusal = reason

    async def take(self, handed: HandedReading) -> dict[str, Any]:
        """Its value and unit here, and the id of its datum, or when it may become part of one.

        Raises `ControlError`: it is refused; `StoreError` as `Driver.put`. The risk follows a reading of which only no
        datum could be made.
        """
        try:
            answer = await self._take(handed)
        except RassError as error:
            self.refuse(str(error))
            if isinstance(error, MalformedError):
                raise ControlError(str(error)) from None
            raise
        self._readings += 1
        self._last = self._driver.now()
        return answer

    async def _take(self, handed: HandedReading) -> dict[str, Any]:
        driver, agent = self._driver, self._driver.agent
        now = driver.now()
        self._check_source(now)
        unit = agent.settings.unit or self._sensor.unit
        value = converted(handed.value, handed.unit, unit, self._sensor.cpm_per_usvh)
        if value > MOST_READING:
            raise MalformedError(f"value: {handed.value:g} {handed.unit} is not a valid reading")
        at = now if handed.date is None else now - self._age(handed.date)
        apart = handed.date is not None or handed.place is not None
        if agent.node.base and handed.place is None:
            raise ControlError("a base has no readings of its own: state where this one was taken (--at)")
        to_come = agent.steps_to_measurement()
        # After a pause the next measurement may come too late for it, so it is made now.
        soon = to_come is not None and not agent.node.risk.known(now)
        last = agent.last_reading
        # At a base they are of elsewhere.
        recent = not agent.node.base and now - at <= agent.settings.risk.stale_s
        drives = recent and (last is None or at >= last.at - CLOCKS_S)
        reading = agent.reading(value, at, unit) if drives else Reading(value, at, unit)
        taken: dict[str, Any] = {"value": value, "unit": unit, "drives_risk": drives, "id": None}
        if not apart and not soon:
            return {**taken, "due_s": None if to_come is None else round((to_come + 1) * agent.settings.step_s, 3)}
        if apart:
            self._check_rate(now, drives=drives)
        position = self._position(handed, at, now)
        taken["id"] = str(await driver.record(reading, position, own=not apart))
        self._data += 1
        return taken

    def _check_source(self, now: float) -> None:
        """A node has one detector."""
        agent = self._driver.agent
        if self._sensor.kind.handed_in or agent.node.base:
            return
        if self._sensor.own:
            kind = self._sensor.type
            raise ControlError(f"readings come from sensor.type {kind}: to submit your own, set sensor.type to program")
        heard = agent.telemetry.reading
        if heard is not None and now - heard.at <= agent.settings.risk.stale_s:
            name = agent.settings.mavlink.reading_name
            raise ControlError(f"the autopilot sends readings ({name}): to submit your own, set sensor.type to program")

    def _age(self, date: float) -> float:
        lived = self._driver.lived
        known = None if lived is None else lived.date()
        here = known if known is not None else time.time() if lived is None else lived.wall()
        if here < FIRST_DATE:
            raise ControlError("time: this computer does not know the date: omit the time")
        if date < FIRST_DATE:
            raise MalformedError(f"time: {_shown(date)} is before 2024: the program's clock is not set")
        age_s = here - date
        if age_s < -CLOCKS_S:
            raise MalformedError(f"time: {_shown(date)} is {-age_s:.0f} s ahead of this node's clock")
        lifetime_s = self._driver.agent.settings.data.lifetime_s or math.inf
        if age_s > (oldest_s := min(OLDEST_S, lifetime_s)):
            raise MalformedError(f"time: {_shown(date)} is {_span(age_s)} ago, at most {_span(oldest_s)}")
        return max(age_s, 0.0)

    def _check_rate(self, now: float, *, drives: bool) -> None:
        if not self._allowance.take(now):
            raise ControlError(
                f"no datum: at most {MOST_DATA} readings in {IN_S:g} s become separate data; the next one can in "
                f"{self._allowance.due(now):.1f} s{'; the risk follows it' if drives else ''}"
            )

    def _position(self, handed: HandedReading, at: float, now: float) -> Position | None:
        if handed.place is not None:
            return Position(*handed.place, at)
        return None if now - at <= NEAR_S else self._track.near(at)


def _span(seconds: float) -> str:
    return f"{seconds / 86400:.3g} d" if seconds >= 86400 else f"{seconds:.0f} s"


def _shown(date: float) -> str:
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(date))

"""The timeline of a node: the time that it has been running.

A Raspberry Pi has no clock that runs without power, so its date jumps by years when the clock is set. Data must not
expire because of that. So a node counts the time in which it runs, and continues from there in its next life. The time
between two lives counts if it is known: from the kernel's counter within one boot of the computer, otherwise from the
date, if the date is right at both ends. If it is unknown, it counts as 0, and ages are lower bounds from then on
(`Datum.at_least`).

The date is right if the computer says so, or if the autopilot reports it, which knows it from GPS. Where it becomes
known soon after the start, the time between the lives is known after all, and the data get their true ages.
"""

from __future__ import annotations

import ctypes
import logging
import math
import time
from collections.abc import Callable, Collection, Mapping
from functools import cache
from pathlib import Path
from typing import NamedTuple, Protocol

from rass_mav.core.datum import DatumId
from rass_mav.core.store import Store

log = logging.getLogger(__name__)

#: While a node holds data, it stores its time at least this often, seconds. A power cut can lose that much time.
NOTE_S = 60.0
#: How long after the start a date can still tell how long the node was off, seconds.
AMEND_S = 1800.0
#: A node is not off for longer than this, seconds: one of the two dates was wrong.
MOST_OFF_S = 365.25 * 86400.0
#: Two dates of the same moment that differ by more than this contradict each other, seconds.
DISAGREE_S = 60.0
# 2025-01-01.
_WRITTEN_S = 1_735_689_600.0
# Names of the last note in the store. Values in microseconds, except the boot's number, and 0 or 1 for trusted.
_LIVED, _ELAPSED, _BOOT = "clock.lived_us", "clock.elapsed_us", "clock.boot"
_WALL, _TRUSTED, _STARTED = "clock.wall_us", "clock.trusted", "clock.started_us"
#: A time of creation beyond this many seconds (the year 2242) is a flipped bit.
MOST_S = float(1 << 33)
# The result of adjtimex(2) for an unsynchronised clock, and space for any kernel's `struct timex`.
_TIME_ERROR = 5
_TIMEX_BYTES = 512
_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


def impossible(now: float) -> str | None:
    """A date for people, if it cannot be right: before this program was written; None: it can. `now`: seconds since
    1970."""
    return date(now) if now < _WRITTEN_S else None


def date(utc: float) -> str:
    """For people, to the minute. `utc`: seconds since 1970."""
    return time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(utc))


def boot_time() -> float:
    """Seconds since the computer was started, including suspended time. Where the system cannot tell, seconds from an
    arbitrary start. It never jumps."""
    return time.clock_gettime(time.CLOCK_BOOTTIME) if hasattr(time, "CLOCK_BOOTTIME") else time.monotonic()


@cache
def boot_number() -> int:
    """63 bits of Linux's id of this boot; 0: there is none."""
    try:
        return int(_BOOT_ID.read_text(encoding="ascii").replace("-", "")[:16], 16) >> 1
    except (OSError, ValueError):
        return 0


@cache
def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None)


def synchronised() -> bool:
    """Whether the kernel reports that the date is synchronised (NTP, GPS). False where it cannot be asked."""
    adjtimex = getattr(_libc(), "adjtimex", None)
    return adjtimex is not None and 0 <= adjtimex(ctypes.create_string_buffer(_TIMEX_BYTES)) < _TIME_ERROR


def possible() -> bool:
    """Whether the date of this computer can be right at all, whoever says that it is."""
    return impossible(time.time()) is None


class TimeSources(NamedTuple):
    """A computer's sources of time."""

    elapsed: Callable[[], float] = boot_time
    """Seconds on a timeline that lasts as long as the boot, and never jumps."""
    boot: Callable[[], int] = boot_number
    """Identifies the boot, 63 bits; 0: unknown."""
    wall: Callable[[], float] = time.time
    """The date: seconds since 1970, right or wrong."""
    trusted: Callable[[], bool] = lambda: synchronised() and possible()
    """Whether the date is right."""


class GpsDate:
    """The date that the autopilot reports."""

    def __init__(self) -> None:
        self._offset: float | None = None
        """What to add to the node's time to get seconds since 1970; None: not heard."""
        self._ignored = False
        self._warned = False

    def hear(self, utc: float, at: float) -> None:
        """The date was `utc`, seconds since 1970, when the node's time was `at`. An autopilot that contradicts itself
        is not believed any more: nobody knows which date is right."""
        offset = utc - at
        if self._offset is not None and abs(offset - self._offset) > DISAGREE_S and not self._ignored:
            self._ignored = True
            log.warning("the autopilot's date jumped by %.0f s: it is ignored from now on", offset - self._offset)
        self._offset = offset

    def at(self, now: float, synchronised: float | None) -> float | None:
        """The date at `now` on the node's timeline, seconds since 1970; None: it is not known, or ignored.

        `synchronised`: the computer's date, if that is right. It decides if the two contradict each other.
        """
        if self._offset is None or self._ignored:
            return None
        date = self._offset + now
        if synchronised is None or abs(date - synchronised) <= DISAGREE_S:
            return date
        if not self._warned:
            self._warned = True
            log.warning(
                "the autopilot's date differs by %.0f s from the computer's, which is synchronised: it is ignored",
                date - synchronised,
            )
        return None


class Clock:
    """A timeline that never jumps."""

    def __init__(self, start: float = 0.0, elapsed: Callable[[], float] = boot_time) -> None:
        """`start`: its time now, seconds. `elapsed`: seconds from an arbitrary start."""
        self._elapsed = elapsed
        self._offset = start - elapsed()

    def now(self) -> float:
        """Seconds."""
        return self._offset + self._elapsed()


class AgeingStore(Store, Protocol):
    """A store that knows the node's time, and can change the ages of its data."""

    def note_time(self, now_ms: int) -> None:
        """What is written from now on arrived at this time, milliseconds on the node's timeline."""

    def mark_at_least(self) -> None:
        """Mark the age of every stored datum as a lower bound (`Datum.at_least`). Durable with the next commit at the
        latest."""

    def amend(self, ids: Collection[DatumId], off_s: float) -> None:
        """The ages of these data are known: they are `off_s` seconds older than recorded, and not `at_least` so old.
        Durable with the next commit. Unknown ids are ignored."""


class LivedClock(Clock):
    """The time that a node with a store has been running. It continues from the last note in the store."""

    def __init__(self, store: AgeingStore, sources: TimeSources | None = None) -> None:
        """Create it before the node. If it is unknown how long the node was off, the data are marked. Raises
        `StoreError`."""
        self._store = store
        self._sources = sources or TimeSources()
        start, self.off_known = _begin(store, self._sources)
        """`off_known`: whether it is known how long the node was off before this life."""
        super().__init__(start, self._sources.elapsed)
        self._began = start
        store.set_meta(_STARTED, math.ceil(start * 1e6))
        self._noted_at = -math.inf
        self._gps = GpsDate()
        self._unsure: dict[DatumId, float] | None = None
        """Data whose ages became lower bounds with this start, with their times of creation; None: nothing can tell
        how old they are."""
        self._date_offset = _trusted_offset(store)
        """What to add to the node's time before this life to get seconds since 1970."""
        if not self.off_known:
            if self._date_offset is not None:
                self._unsure = {info.id: info.created for info in store.held() if not info.at_least}
            store.mark_at_least()

    @property
    def trusted(self) -> bool:
        """Whether the date is known."""
        return self.date() is not None

    def date(self) -> float | None:
        """The date, seconds since 1970; None: nobody knows it."""
        sources = self._sources
        own = sources.wall() if sources.trusted() else None
        gps = self._gps.at(self.now(), own)
        return own if gps is None else gps

    def wall(self) -> float:
        """The computer's date, seconds since 1970, right or wrong."""
        return self._sources.wall()

    def hear_date(self, utc: float, at: float) -> None:
        """The autopilot says that the date was `utc`, seconds since 1970, when the node's time was `at`."""
        self._gps.hear(utc, at)

    def note(self) -> None:
        """Store the node's time and the clocks' times; durable with the next commit.

        Every commit must include a note, so that no datum on disk was created after the note on disk.
        """
        now = self._noted_at = self.now()
        self._store.note_time(max(int(now * 1000), 0))
        sources = self._sources
        date = self.date()
        numbers = {
            _LIVED: math.ceil(now * 1e6),  # rounding down would make the newest datum's age negative
            _ELAPSED: round(sources.elapsed() * 1e6),
            _BOOT: sources.boot(),
            _WALL: round((sources.wall() if date is None else date) * 1e6),
            _TRUSTED: int(date is not None),
        }
        for key, value in numbers.items():
            self._store.set_meta(key, value)

    def tend(self, held: bool) -> bool:
        """Once a step: store the time if the last note is old. `held`: whether there are data whose age matters.

        Returns whether ages in the store have changed, because it is known now how long the node was off. Raises
        `StoreError`.
        """
        if held and self.now() - self._noted_at >= NOTE_S:
            self.note()
        return self._unsure is not None and self._amend(self._unsure)

    def _amend(self, unsure: dict[DatumId, float]) -> bool:
        """Once in a life, if the date becomes known soon after the start: give the data their true ages."""
        now = self.now()
        late = now - self._began > AMEND_S
        date = None if late else self.date()
        if late or date is not None:
            self._unsure = None
        if date is None or self._date_offset is None:
            return False
        off = date - now - self._date_offset
        if not 0.0 <= off <= MOST_OFF_S:
            log.warning("the node cannot have been off for %.0f s, as dates suggest: ages remain lower bounds", off)
            return False
        self.off_known = True
        log.info("the node was off for %.0f s: the ages of its data are known after all", off)
        # What was handed over and came back has another time of creation: its age is what the neighbour says.
        ids = [info.id for info in self._store.held() if info.at_least and unsure.get(info.id) == info.created]
        self._store.amend(ids, off)
        return bool(ids)


def _begin(store: Store, sources: TimeSources) -> tuple[float, bool]:
    """The node's time now, seconds, and whether it is known how long it was off."""
    lived = store.get_meta(_LIVED)
    if lived is None:
        # The store of a version without notes. With a note, a datum with a later time has a flipped bit.
        newest = max((info.created for info in store.held() if abs(info.created) < MOST_S), default=None)
        return (0.0, True) if newest is None else (newest, False)
    off = _off(store, sources)
    return lived / 1e6 + (off or 0.0), off is not None


def _off(store: Store, sources: TimeSources) -> float | None:
    """Seconds since the last note; None: unknown."""
    boot, elapsed = sources.boot(), sources.elapsed() - (store.get_meta(_ELAPSED) or 0) / 1e6
    if boot and boot == store.get_meta(_BOOT) and elapsed >= 0.0:
        return elapsed
    wall = sources.wall() - (store.get_meta(_WALL) or 0) / 1e6
    return wall if store.get_meta(_TRUSTED) and sources.trusted() and wall >= 0.0 else None


def _trusted_offset(store: Store) -> float | None:
    """What to add to the node's time at the last note to get seconds since 1970; None: the date was not known."""
    lived, wall = store.get_meta(_LIVED), store.get_meta(_WALL)
    if lived is None or wall is None or not store.get_meta(_TRUSTED):
        return None
    return (wall - lived) / 1e6


class DateNote(NamedTuple):
    """What a store tells about dates, from the last note of its node's clock."""

    lived_s: float
    """The node's time at the note, seconds; infinite: there is no note."""
    offset_s: float
    """What to add to a time in the store to get seconds since 1970."""
    trusted: bool
    """Whether the date was right."""
    started_s: float = -math.inf
    """The node's time when it was started, seconds; -infinite: unknown."""

    @classmethod
    def of(cls, meta: Mapping[str, int]) -> DateNote:
        """:param meta: the store's numbers. Without a note, times in the store are dates."""
        lived, wall = meta.get(_LIVED), meta.get(_WALL, 0)
        if lived is None:
            return cls(math.inf, 0.0, False)
        started = meta.get(_STARTED)
        started_s = -math.inf if started is None else started / 1e6
        return cls(lived / 1e6, (wall - lived) / 1e6, bool(meta.get(_TRUSTED)), started_s)

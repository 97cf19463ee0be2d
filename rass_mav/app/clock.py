"""The timeline of a node: the time that it has been running.

A Raspberry Pi has no clock that runs without power, so its date jumps by years when the clock is set. Data must not
expire because of that. So a node counts the time in which it runs, and continues from there in its next life. The time
between two lives counts if it is known: from the kernel's counter within one boot of the computer, otherwise from the
date, if the date is right at both ends. If it is unknown, it counts as 0, and ages are lower bounds from then on
(`Datum.at_least`).
"""

from __future__ import annotations

import ctypes
import math
import time
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import NamedTuple, Protocol

from rass_mav.core.store import Store

#: While a node holds data, it stores its time at least this often, seconds. A power cut can lose that much time.
NOTE_S = 60.0
# Names of the last note in the store. Values in microseconds, except the boot's number, and 0 or 1 for trusted.
_LIVED, _ELAPSED, _BOOT = "clock.lived_us", "clock.elapsed_us", "clock.boot"
_WALL, _TRUSTED = "clock.wall_us", "clock.trusted"
# A time of creation beyond this many seconds (the year 2242) is a flipped bit.
_MOST_S = float(1 << 33)
# The result of adjtimex(2) for an unsynchronised clock, and space for any kernel's `struct timex`.
_TIME_ERROR = 5
_TIMEX_BYTES = 512
_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


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


class TimeSources(NamedTuple):
    """A computer's sources of time."""

    elapsed: Callable[[], float] = boot_time
    """Seconds on a timeline that lasts as long as the boot, and never jumps."""
    boot: Callable[[], int] = boot_number
    """Identifies the boot, 63 bits; 0: unknown."""
    wall: Callable[[], float] = time.time
    """The date: seconds since 1970, right or wrong."""
    trusted: Callable[[], bool] = synchronised
    """Whether the date is right."""


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
    """A store that can mark the ages of its data as lower bounds."""

    def mark_at_least(self) -> None:
        """Mark the age of every stored datum as a lower bound (`Datum.at_least`). Durable with the next commit at the
        latest."""


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
        self._noted_at = -math.inf
        if not self.off_known:
            store.mark_at_least()

    @property
    def trusted(self) -> bool:
        """Whether the date is right."""
        return self._sources.trusted()

    def note(self) -> None:
        """Store the node's time and the clocks' times; durable with the next commit.

        Every commit must include a note, so that no datum on disk was created after the note on disk.
        """
        now = self._noted_at = self.now()
        sources = self._sources
        numbers = {
            _LIVED: math.ceil(now * 1e6),  # rounding down would make the newest datum's age negative
            _ELAPSED: round(sources.elapsed() * 1e6),
            _BOOT: sources.boot(),
            _WALL: round(sources.wall() * 1e6),
            _TRUSTED: int(sources.trusted()),
        }
        for key, value in numbers.items():
            self._store.set_meta(key, value)

    def tend(self, held: bool) -> None:
        """Once a step: store the time if the last note is old. `held`: whether there are data whose age matters."""
        if held and self.now() - self._noted_at >= NOTE_S:
            self.note()


def _begin(store: Store, sources: TimeSources) -> tuple[float, bool]:
    """The node's time now, seconds, and whether it is known how long it was off."""
    lived = store.get_meta(_LIVED)
    if lived is None:
        # The store of a version without notes. With a note, a datum with a later time has a flipped bit.
        newest = max((info.created for info in store.held() if abs(info.created) < _MOST_S), default=None)
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


def date_offset(meta: Mapping[str, int]) -> float:
    """What to add to `created` in an unused store to get seconds since 1970, as far as its node knew the date.

    :param meta: the store's numbers. Without a note, times in the store are dates.
    """
    return (meta.get(_WALL, 0) - meta.get(_LIVED, 0)) / 1e6

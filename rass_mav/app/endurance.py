"""How long a drone's store lasts while it hears nobody, for `check` and `doctor`."""

from __future__ import annotations

from collections.abc import Iterator
from math import inf
from typing import NamedTuple

from rass_mav.agent.settings import LEAST_STATUS_TURNS, USUAL_STATUS_S
from rass_mav.core.messages import INLINE_BYTES
from rass_mav.store.disk import space
from rass_mav.store.files import taken
from rass_mav.store.quota import cost
from rass_mav.store.reader import SqliteReader
from rass_mav.wire.measurement import MOST_MEASUREMENT_BYTES

from .config import RunConfig

#: What keys add to a datum, bytes: `trust.keys.sealing.SEAL_SIZE`, which needs PyNaCl.
SEALED_BYTES = 16


class Left(NamedTuple):
    """The space that a store has."""

    items: int
    """Data."""
    bytes: int
    """By what data take there (`store.quota.cost`)."""


class Endurance(NamedTuple):
    """How long such a space lasts."""

    seconds: float
    """Infinite: it does not fill up."""
    text: str
    """In words."""


class _Source(NamedTuple):
    what: str
    interval_s: float
    size: int
    """Bytes of payload."""


def _sources(config: RunConfig) -> Iterator[_Source]:
    added = 0 if config.keys is None else SEALED_BYTES
    data, step_s = config.data, config.node.step_s
    if data.interval_steps:
        size = max(data.bytes, MOST_MEASUREMENT_BYTES) + added
        yield _Source("a measurement", data.interval_steps * step_s, size)
    interval_s = max(USUAL_STATUS_S, LEAST_STATUS_TURNS * step_s) if data.status_s is None else data.status_s
    if interval_s:
        yield _Source("a status", interval_s, INLINE_BYTES)


def endurance(config: RunConfig, left: Left) -> Endurance:
    """For how long a drone can create data and hand over none. `left`: the space in its store."""
    sources = list(_sources(config))
    if not sources:
        return Endurance(inf, "never fills up without contact: the node creates no data of its own")
    every = ", ".join(f"{source.what} every {in_words(source.interval_s)}" for source in sources)
    lasts_s = left.items / sum(1.0 / source.interval_s for source in sources)
    lasts_s = min(lasts_s, left.bytes / sum(cost(source.size) / source.interval_s for source in sources))
    if (most := config.store.capacity_bytes) is not None:
        lasts_s = min(lasts_s, most / sum(source.size / source.interval_s for source in sources))
    lifetime_s = config.data.lifetime_s
    if lifetime_s is not None and lifetime_s <= lasts_s:
        return Endurance(inf, f"never fills up without contact: data expire after {in_words(lifetime_s)} ({every})")
    return Endurance(lasts_s, f"lasts {in_words(lasts_s)} without contact ({every})")


def empty(config: RunConfig) -> Left:
    """The space that a drone's store has when it is empty, on this computer."""
    return _left(config, held=0, used=0, files=0)


def left_in(config: RunConfig) -> tuple[Left, int]:
    """The space that a drone's store has now, and how many data it holds. It need not exist. `OSError`, and
    `StoreError` if it cannot be read."""
    path = config.store_path
    if not path.exists():
        return empty(config), 0
    with SqliteReader(path) as reader:
        sizes = [info.size for info in reader.held()]
    return _left(config, held=len(sizes), used=sum(map(cost, sizes)), files=taken(path)), len(sizes)


def _left(config: RunConfig, *, held: int, used: int, files: int) -> Left:
    folder = next(parent for parent in config.store_path.absolute().parents if parent.is_dir())
    disk = space(folder)
    quota = files + disk.free - disk.reserve
    if config.store.quota_bytes is not None:
        quota = min(quota, config.store.quota_bytes)
    return Left(max(0, config.store.most_items - held), max(0, quota - used))


def in_words(seconds: float) -> str:
    """A time in the unit that a person would choose."""
    for unit, one_s, least in (("days", 86400.0, 2.0), ("hours", 3600.0, 2.0), ("minutes", 60.0, 2.0)):
        if seconds >= least * one_s:
            return f"{_rounded(seconds / one_s)} {unit}"
    return f"{_rounded(seconds)} s"


def _rounded(number: float) -> str:
    return f"{number:.1f}".removesuffix(".0") if number < 10 else f"{number:.0f}"

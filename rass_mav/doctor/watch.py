"""Observes a node for a few seconds: how often things arrive, and when enough has been seen."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeAlias

from rass_mav.app.config import RunConfig
from rass_mav.errors import LinkError, RassError
from rass_mav.mavlink.firmware import Firmware

#: The contents of `rass-mav status` (docs/reference/configuration.md).
Status: TypeAlias = Mapping[str, Any]

#: Seconds to observe at least and at most, and between two samples.
LEAST_S = 2.0
MOST_S = 6.0
LOOK_S = 0.1
#: Arrivals needed to compute a rate.
ENOUGH = 3
# Two samples of the same arrival, rounded to milliseconds, differ by less than this, seconds.
_SAME_S = 0.005


class RadioAnswers(NamedTuple):
    """What a DroneBridge said of itself."""

    mode: int | None = None
    version: tuple[int, int, int] | None = None
    """(0, 0, 0): one that does not say it in full."""


@dataclass
class Ear:
    """What a trial heard on the autopilot's port, in addition to what the node itself uses."""

    autopilots: dict[int, int] = field(default_factory=dict)
    """MAV_AUTOPILOT by system id, of all autopilots whose heartbeat was heard."""
    frames: int = 0
    """Frames of any kind."""
    parameters: Mapping[str, float] | None = None
    """Parameters of the node's own autopilot, by name (`params.ports`); None: they were not read."""
    radios: dict[int, RadioAnswers] = field(default_factory=dict)
    """What radios that were asked have said, by the index of their link."""


@dataclass
class Evidence:
    """What was seen of a node."""

    running: bool
    """True: the running node; False: a trial with its ports."""
    samples: list[Status]
    """The samples in order, at least one."""
    troubles: dict[str, str] = field(default_factory=dict)
    """Why something could not be opened in a trial, by key of the configuration."""
    remedies: dict[str, str] = field(default_factory=dict)
    """What to do about some of these, by the same keys."""
    opened: list[int] = field(default_factory=list)
    """The links in the samples, by their index in the configuration."""
    ear: Ear | None = None
    """None: a running node does not report it."""
    blocked: frozenset[str] = frozenset()
    """Keys of the configuration whose serial port cannot be opened; another check reports why."""

    @property
    def firmware(self) -> Firmware | None:
        """Firmware of the node's own autopilot; None: it was never heard."""
        known = self.last["autopilot"]
        if known is None or known["type"] is None:
            return None
        return Firmware(known["type"], tuple(known["version"] or (0, 0, 0)))

    @property
    def parameters(self) -> Mapping[str, float] | None:
        """Parameters of the node's own autopilot; None: they were not read."""
        return None if self.ear is None else self.ear.parameters

    @property
    def last(self) -> Status:
        """The last sample."""
        return self.samples[-1]

    def note(self, key: str, error: RassError) -> None:
        """Note that something could not be opened in a trial. `key`: its key in the configuration."""
        self.troubles[key] = str(error)
        if isinstance(error, LinkError) and error.remedy:
            self.troubles[key], self.remedies[key] = error.text, error.remedy

    def link(self, index: int) -> Mapping[str, Any] | None:
        """The last sample of a link; None: it could not be opened."""
        links: Sequence[Mapping[str, Any]] = self.last["links"]
        return links[self.opened.index(index)] if index in self.opened else None

    def grown(self, index: int, counter: str) -> int:
        """By how much a counter of an opened link has grown during the check."""
        place = self.opened.index(index)
        first, last = (sample["links"][place][counter] for sample in (self.samples[0], self.last))
        return int(last - first)


def heartbeats(samples: Sequence[Status]) -> list[float]:
    """When heartbeats of the autopilot arrived, seconds since the node's start."""
    return arrivals(samples, lambda s: s["autopilot"] and s["autopilot"]["heartbeat_age_s"])


def positions(samples: Sequence[Status]) -> list[float]:
    """When positions with a fix arrived, likewise."""
    return arrivals(samples, lambda s: s["position"] and s["position"]["age_s"])


def unfixed(samples: Sequence[Status]) -> list[float]:
    """When positions without a fix arrived, likewise."""
    return arrivals(samples, lambda s: s["autopilot"] and s["autopilot"]["no_fix_age_s"])


def readings(samples: Sequence[Status]) -> list[float]:
    """When readings arrived, from the autopilot or from the node's own sensor, likewise."""
    return arrivals(samples, lambda s: s["reading"] and s["reading"]["age_s"])


def arrivals(samples: Sequence[Status], age: Callable[[Status], float | None]) -> list[float]:
    """When something arrived during the check, seconds since the node's start. `age`: that of the last arrival, or
    None."""
    times: list[float] = []
    begin = samples[0]["uptime_s"] - LOOK_S
    for sample in samples:
        old = age(sample)
        if old is None:
            continue
        at = sample["uptime_s"] - old
        if at > begin and (not times or at - times[-1] > _SAME_S):
            times.append(at)
    return times


def rate(times: Sequence[float]) -> float | None:
    """Arrivals per second; None: fewer than two. Arrivals closer together than the samples count as one."""
    return (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 else None


def seen_enough(config: RunConfig, samples: Sequence[Status]) -> bool:
    """Whether more samples would show nothing new."""
    if not samples or samples[-1]["uptime_s"] - samples[0]["uptime_s"] < LEAST_S:
        return False
    wanted = []
    if config.autopilot.url is not None:
        wanted += [heartbeats(samples), positions(samples) or unfixed(samples)]
    if not config.is_base:
        wanted.append(readings(samples))
    neighbours = samples[-1]["neighbours"] or not config.links
    return bool(neighbours) and all(len(times) >= ENOUGH for times in wanted)

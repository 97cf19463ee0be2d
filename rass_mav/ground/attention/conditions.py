"""What needs attention: its kinds, levels and texts, and how the list of it is shown. Pure: time is an argument."""

from __future__ import annotations

import enum
from collections.abc import Iterable
from math import inf
from typing import Any, NamedTuple

from rass_mav.ground.entry import Place, iso
from rass_mav.ground.report import FAULT_TEXTS, MOST_NAMES, span
from rass_mav.wire.measurement import UNIT_NAMES

#: Of a kind of condition, so many drones have a row each; more share one.
MOST_ROWS = 3
#: Conditions that are listed in JSON, the most severe first.
MOST_LISTED = 500


class Level(enum.IntEnum):
    """How urgent a condition is."""

    ALARM = 0
    """Data or a drone may be lost by now."""
    WARNING = 1
    """Somebody has to look at it soon."""
    NOTE = 2
    """It changes what the figures mean."""

    @property
    def word(self) -> str:
        """For JSON, and for classes of elements."""
        return self.name.lower()


class Kind(NamedTuple):
    """A kind of condition."""

    level: Level
    title: str
    """What it is, behind `drone 7: `."""
    do: str
    """What to do, one sentence."""


#: The kinds that data show, in the order in which they are listed among those of one level.
KINDS = {
    "clock": Kind(
        Level.WARNING, "the base does not know the date", "Times are wrong: connect a GPS or NTP, or set node.clock."
    ),
    "stopped": Kind(Level.WARNING, "the base has stopped", "Everything shown is as of then."),
    "nothing": Kind(
        Level.WARNING, "no drone has been heard", "Check that a drone is on and in range (rass-mav doctor)."
    ),
    "silent": Kind(Level.ALARM, "silent", "Newer data are in no total: send a relay or the base to the last position."),
    "full": Kind(Level.ALARM, "store full", "No new measurement is stored: bring a base or a relay near."),
    "forwarder": Kind(Level.WARNING, "accepts data that do not arrive", "Land that drone, or keep others near a base."),
    "revoked": Kind(Level.WARNING, "revoked", "Other nodes refuse data from there: recover the card."),
    "filling": Kind(Level.WARNING, "store fills up", "Bring a base or a relay near."),
    "unheard": Kind(Level.WARNING, "heard by other drones only", "No data have arrived: check keys and route."),
    "no route": Kind(Level.WARNING, "no route to a base", "Data wait there: bring a base or a relay near."),
    "position": Kind(Level.WARNING, "position lost", "New data carry no position: check the GPS."),
    "sensor": Kind(Level.WARNING, "readings lost", "The worst risk is assumed: check the sensor."),
    "reading": Kind(Level.WARNING, "high reading", "Keep people away."),
    "hot spot": Kind(Level.WARNING, "new hot spot", "Keep people away."),
    "two contents": Kind(
        Level.WARNING,
        "data kept apart",
        "Two drones share a node.id, the drone created them before it had keys, or they are forged (how-to/keys).",
    ),
    "lost": Kind(Level.WARNING, "data lost", "They will not arrive: fly there again if they matter."),
    "unknown": Kind(Level.WARNING, FAULT_TEXTS["unknown"], "There may be more data than the totals show."),
    "damaged": Kind(Level.WARNING, FAULT_TEXTS["damaged"], "Replace the card."),
    "link key": Kind(Level.WARNING, "an old link key", "Neighbours pass on the new one: fly within their range."),
    "ages": Kind(Level.NOTE, "ages of data are lower bounds", "A node on their route was off for an unknown time."),
}
_ORDER = {kind: number for number, kind in enumerate(KINDS)}
_OF_NODE = len(_ORDER)


class Condition(NamedTuple):
    """Something that needs attention now."""

    level: Level
    kind: str
    """One of `KINDS`, or what a node says of itself: `node`."""
    drone: int | None
    """Its node id; None: the base, or the swarm."""
    title: str
    since: float | None
    """Seconds since 1970; None: nobody knows."""
    do: str
    """Empty: the title says it."""
    detail: str = ""
    """Figures, behind the title."""

    @property
    def key(self) -> tuple[str, str]:
        """While it stays the same, it is the same condition: it rings once."""
        return self.kind, self.title if self.drone is None else str(self.drone)

    def plain(self, now: float) -> dict[str, Any]:
        """As plain values for JSON."""
        return {
            "level": self.level.word, "kind": self.kind, "drone": self.drone, "text": self.text,
            "since": None if self.since is None else iso(self.since),
            "for_s": None if self.since is None else round(max(0.0, now - self.since), 1),
            "do": self.do,
        }  # fmt: skip

    @property
    def text(self) -> str:
        """Without who, and since when."""
        return f"{self.title}: {self.detail}" if self.detail else self.title


def condition(kind: str, drone: int | None = None, since: float | None = None, detail: str = "") -> Condition:
    """One of `KINDS`."""
    about = KINDS[kind]
    return Condition(about.level, kind, drone, about.title, since, about.do, detail)


class Row(NamedTuple):
    """One line of the list: a condition, or one kind of several drones."""

    level: Level
    kind: str
    text: str
    """Who, what, and for how long."""
    do: str
    keys: tuple[str, ...]
    """Of the conditions in it, to acknowledge them."""

    @property
    def line(self) -> str:
        """For a terminal."""
        return f"{self.level.name}: {self.text}" + (f". {self.do}" if self.do else "")


class Event(NamedTuple):
    """A condition has begun, or is over."""

    utc: float | None
    """When the base could know it, seconds since 1970; None: nobody has noted when."""
    begins: bool
    level: Level
    kind: str
    drone: int | None
    text: str

    def plain(self) -> dict[str, Any]:
        """As plain values for JSON."""
        return {
            "utc": None if self.utc is None else iso(self.utc), "begins": self.begins, "level": self.level.word,
            "kind": self.kind, "drone": self.drone, "text": self.text,
        }  # fmt: skip

    @property
    def line(self) -> str:
        """For a terminal, without the time."""
        who = "" if self.drone is None else f"drone {self.drone}: "
        return f"{self.level.name if self.begins else 'over'}: {who}{self.text}"


def in_order(conditions: Iterable[Condition]) -> list[Condition]:
    """The most severe first; of one kind, the oldest."""
    return sorted(
        conditions,
        key=lambda one: (
            one.level, _ORDER.get(one.kind, _OF_NODE), -inf if one.since is None else one.since,
            -1 if one.drone is None else one.drone,
        ),
    )  # fmt: skip


def rows(conditions: Iterable[Condition], now: float) -> list[Row]:
    """The list as lines for people, however many drones there are: those of one kind share one."""
    groups: dict[tuple[Level, str], list[Condition]] = {}
    for condition in in_order(conditions):
        groups.setdefault((condition.level, condition.kind), []).append(condition)
    found: list[Row] = []
    for (level, kind), group in groups.items():
        if len(group) <= MOST_ROWS or group[0].drone is None:
            for one in group[:MOST_LISTED]:
                who = "" if one.drone is None else f"drone {one.drone}: "
                lasts = "" if one.since is None or one.drone is None else f" for {span(max(0.0, now - one.since))}"
                detail = f"; {one.detail}" if one.detail else ""
                found.append(Row(level, kind, f"{who}{one.title}{lasts}{detail}", one.do, (":".join(one.key),)))
        else:
            names = ", ".join(f"{one.drone}{_behind(one, now)}" for one in group[:MOST_NAMES])
            more = f" and {len(group) - MOST_NAMES} more" if len(group) > MOST_NAMES else ""
            keys = tuple(":".join(one.key) for one in group[:MOST_LISTED])
            found.append(Row(level, kind, f"{len(group)} drones: {group[0].title}: {names}{more}", group[0].do, keys))
    return found


def _behind(one: Condition, now: float) -> str:
    """What stands behind the number of one of several drones."""
    text = one.detail if one.since is None else span(max(0.0, now - one.since))
    return f" ({text})" if text else ""


def marks(conditions: Iterable[Condition]) -> dict[int, Level]:
    """The most severe level of each drone."""
    found: dict[int, Level] = {}
    for condition in conditions:
        if condition.drone is not None:
            found[condition.drone] = min(found.get(condition.drone, condition.level), condition.level)
    return found


def reading_text(reading: float, unit: str | None) -> str:
    """A reading with its unit."""
    number = f"{reading:,.0f}" if 1000 <= abs(reading) < 1e7 else f"{reading:.3g}"
    return f"{number} {UNIT_NAMES.get(unit or '', '')}".strip()


def place_text(place: Place) -> str:
    """Latitude and longitude, to be copied."""
    return f"{place[0]:.6f}, {place[1]:.6f}"

"""How much data the drones of a mock swarm create: pictures beside their measurements, and a load that fits the air."""

from __future__ import annotations

import math
import random
from collections.abc import Container
from dataclasses import replace
from typing import NamedTuple

from rass_mav.agent.agent import Agent
from rass_mav.core.datum import DatumId, Kind
from rass_mav.errors import ConfigError, StoreFullError
from rass_mav.lab.medium.capacity import one_hop_bytes_s
from rass_mav.lab.swarm.scenario import Scenario


class Load(NamedTuple):
    """What the drones create, beside what the air carries."""

    share: float
    """Of the one-hop capacity around all bases, as created; `traffic.load` bounds it."""
    capacity_bytes_s: int
    """One-hop capacity around one base, bytes of payload a second, for the largest data."""
    created_bytes_s: int
    """What all drones create, bytes of payload a second."""
    interval_steps: int
    """Steps between two measurements of a drone; 0: none."""
    picture_interval_steps: int
    """Steps between two pictures of a drone; 0: none."""


def loaded(scenario: Scenario, neighbourhood: int) -> tuple[Scenario, Load | None]:
    """The scenario with the intervals that its `traffic.load` asks for, and the load. None: it asks for no load.

    `neighbourhood`: how many nodes usually hear each other, at least 2.

    With pictures, the pictures fill up what the measurements leave; without, the measurements are the load. Intervals
    are rounded up to whole steps.

    Raises `ConfigError`: the measurements alone are more than the load.
    """
    traffic, data = scenario.traffic, scenario.data
    if traffic.load is None:
        return scenario, None
    drones, step_s = scenario.nodes - scenario.bases, scenario.node.step_s

    def capacity(size: int) -> float:
        return one_hop_bytes_s(scenario.radio, size, nodes=neighbourhood, step_s=step_s)

    # What a datum in each step of each drone takes of the air.
    measurement, picture = (
        drones * size / step_s / capacity(size) / scenario.bases if size else 0.0
        for size in (data.bytes, traffic.picture_bytes)
    )
    share = 0.0
    if not traffic.picture_bytes:
        data = replace(data, interval_steps=max(math.ceil(measurement / traffic.load), 1))
    if data.interval_steps:
        share = measurement / data.interval_steps
    if traffic.picture_bytes:
        if share >= traffic.load:
            raise ConfigError(
                f"data.interval_steps: the measurements alone are a load of {share:.3g}, expected less than "
                f"traffic.load ({traffic.load:g})"
            )
        traffic = replace(traffic, picture_interval_steps=max(math.ceil(picture / (traffic.load - share)), 1))
        share += picture / traffic.picture_interval_steps
    created = sum(
        drones * size / step_s / interval
        for size, interval in (
            (data.bytes, data.interval_steps), (traffic.picture_bytes, traffic.picture_interval_steps)
        )
        if interval
    )  # fmt: skip
    load = Load(
        round(share, 4),
        round(capacity(traffic.picture_bytes or data.bytes)),
        round(created),
        data.interval_steps,
        traffic.picture_interval_steps,
    )
    return replace(scenario, data=data, traffic=traffic), load


class Stripe(NamedTuple):
    """Parts of a picture, any `needed` of which give it back."""

    needed: int
    ids: list[DatumId]


class Pictures:
    """Large data of random bytes, or parts of such, one after the other from each drone. The drones take turns over the
    interval."""

    def __init__(self, scenario: Scenario) -> None:
        """None are taken if their size or their interval is 0."""
        traffic = scenario.traffic
        self._traffic = traffic
        self._bytes = traffic.picture_bytes
        self.taken: list[list[Stripe]] = []
        """The pictures in parts."""
        self._interval = traffic.picture_interval_steps if self._bytes else 0
        self._until = scenario.data.until_step
        self._drones = range(scenario.bases, scenario.nodes)
        self._rng = random.Random(f"{scenario.seed}:pictures")

    def due(self, t: int) -> list[int]:
        """The drones that take a picture in step `t`, ascending."""
        interval, drones = self._interval, self._drones
        if not interval or (self._until is not None and t >= self._until):
            return []
        return [drone for place, drone in enumerate(drones) if (t - place * interval // len(drones)) % interval == 0]

    def take(self, agent: Agent, now: float) -> None:
        """A drone takes a picture. A full store refuses it, or its parts, and they are lost as overflow."""
        part_bytes = self._traffic.picture_part_bytes
        if part_bytes is None:
            self._put(agent, self._bytes, Kind.BYTES, now)
            return
        parts = -(-self._bytes // part_bytes)
        needed, shares = self._traffic.picture_redundancy or (parts, parts)
        bare = shares if shares > needed else round(self._traffic.picture_bare * parts)
        picture = []
        for _ in range(-(-parts // needed)):
            # Shares and parts are of random bytes alike: nobody puts them together.
            kinds = (Kind.SHARE if place < bare else Kind.PART for place in range(shares))
            ids = [self._put(agent, part_bytes, kind, now) for kind in kinds]
            picture.append(Stripe(needed, [id for id in ids if id is not None]))
        self.taken.append(picture)

    def _put(self, agent: Agent, size: int, kind: int, now: float) -> DatumId | None:
        payload = self._rng.randbytes(size)
        try:
            return agent.node.put(payload, now, kind)
        except StoreFullError:
            return None

    def whole(self, arrived: Container[DatumId]) -> int:
        """How many pictures in parts have arrived whole."""
        return sum(
            all(sum(id in arrived for id in stripe.ids) >= stripe.needed for stripe in picture)
            for picture in self.taken
        )

"""Which robots fail, and when. What the nodes do has no influence: the same failures hit every policy. Only a blast is
aimed at what they hold."""

from __future__ import annotations

import random
from collections.abc import Iterable, Sequence
from math import inf, log1p
from typing import NamedTuple

from rass_mav.core.custody.holdings import Holdings
from rass_mav.core.datum import DatumId
from rass_mav.lab.ledger import Ledger
from rass_mav.lab.swarm.scenario import FailureSection

#: Younger data are left out of the figures: they may still be on the way to their first replica.
OLD_STEPS = 5


class Failure(NamedTuple):
    """A node goes off in a step, before its turn. The content of its memory is lost."""

    node: int
    back: int | None
    """The step in which it has its turn again; None: never."""
    wiped: bool
    """Whether it comes back with an empty store."""


class Blast:
    """The drones around the fullest store die at once. It measures what the swarm keeps in one place only.

    Where it strikes depends on what the nodes do, unlike other failures: it is aimed at the data.
    """

    def __init__(self, ledger: Ledger) -> None:
        self._ledger = ledger
        self._drones = 0
        self._old: set[DatumId] = set()
        self._gone: set[DatumId] = set()

    def aim(self, holdings: Sequence[Holdings], neighbours: Sequence[Sequence[int]], bases: int) -> list[int]:
        """The drones within radio range of the one that holds the most data which have not arrived, and that one.

        `holdings`, `neighbours`: by node id; nodes 0 .. bases - 1 are bases, which survive. Replicas count. Among
        equally full drones it is the one with the lowest id.
        """
        arrived = self._ledger.arrived
        drones = range(bases, len(holdings))
        if not drones:
            return []
        centre = max(drones, key=lambda node: (sum(id not in arrived for id in holdings[node]), -node))
        return sorted(node for node in {centre, *neighbours[centre]} if node >= bases)

    def begins(self, drones: int) -> None:
        """So many drones are about to die."""
        ledger = self._ledger
        self._drones = drones
        held = (id for id in ledger.copies if id not in ledger.arrived)
        self._old = {id for id in held if ledger.born[id] <= ledger.step - OLD_STEPS}

    def is_over(self) -> None:
        """They are dead."""
        self._gone = self._old - self._ledger.copies.keys()

    def figures(self) -> dict[str, int]:
        """For the summary: `drones` that it killed; data of at least `OLD_STEPS` steps that were `held` by drones and
        had not arrived; those of them that are `lost` because all copies were on these drones."""
        lost = sum(id in self._ledger.lost for id in self._gone)
        return {"drones": self._drones, "held": len(self._old), "lost": lost}


class Failures:
    """The failures of a run, step by step.

    Each kind has a generator of its own, and draws are made for drones that are off too. So the failures of one kind do
    not shift when another kind is switched on. A higher rate hits all drones that a lower one hits, and more.
    """

    def __init__(
        self, settings: FailureSection, *, seed: int, steps: int, nodes: int, bases: int, step_s: float
    ) -> None:
        """`steps`: length of the run, for `die_fraction`. `nodes`: bases included; they are 0 .. bases - 1. `step_s`:
        length of a step, seconds."""
        self._settings = settings
        self._hazard_per_rate = 0.0 if settings.die_dose is None else step_s / 3600.0 / settings.die_dose
        """Of a step, for each uSv/h."""
        self._bases = range(bases)
        self._drones = range(bases, nodes)
        self.counts = {"died": 0, "rebooted": 0, "wiped": 0, "landed": 0}
        """Failures of drones so far, by kind."""
        self.blast: Blast | None = None
        """What the blast does; None: there is none. The swarm sets it, and carries it out."""
        self._back: list[float] = [0] * nodes
        """The step from which each node is on; inf: off for good."""
        self._reboots = random.Random(f"{seed}:failures:reboot")
        self._wipes = random.Random(f"{seed}:failures:wipe")

        rng = random.Random(f"{seed}:failures:die_fraction")
        order = list(self._drones)
        rng.shuffle(order)
        death = [(node, rng.randrange(max(steps, 1))) for node in order]
        self._death = dict(death[: int(settings.die_fraction * len(order) + 0.5)])
        """The step in which each of the chosen drones dies."""

        rng = random.Random(f"{seed}:failures:die_rate")
        # A drone dies when the sum of its hazards passes an exponential threshold. So it dies in each step with the
        # probability of that step, and one number for each drone decides for the whole run.
        self._endures = [-log1p(-rng.random()) for _ in range(nodes)]

        self._batteries = [random.Random(f"{seed}:failures:battery:{node}") for node in range(nodes)]
        self._empty: list[float] = [self._charge(node) for node in range(nodes)]
        """The step in which each drone's battery is empty."""

    def due(self, t: int, levels: Sequence[float]) -> list[Failure]:
        """The failures of step `t`; call it once for each step, in order.

        `levels`: the radiation at each node in this step without noise, Eq. 1 or the dose rate.
        """
        settings = self._settings
        found = []
        for begin, end in settings.base_off:
            if begin == t:
                found += [Failure(base, end, settings.base_wiped) for base in self._bases]
        for node in self._drones:
            reboots = self._reboots.random() < settings.reboot_rate
            wipes = self._wipes.random() < settings.wipe_rate
            back: int | None = None
            wiped = False
            if self._back[node] == inf:
                continue
            if self._dies(node, t, levels[node]):
                self.counts["died"] += 1
            elif t >= self._empty[node]:
                self.counts["landed"] += 1
                if settings.recharge_steps is not None:
                    back = t + settings.recharge_steps
                    self._empty[node] = back + self._charge(node)
            elif (wipes or reboots) and t >= self._back[node]:
                self.counts["wiped" if wipes else "rebooted"] += 1
                back = t + settings.reboot_steps
                wiped = wipes
            else:
                continue
            self._back[node] = inf if back is None else back
            found.append(Failure(node, back, wiped))
        return found

    def kill(self, drones: Iterable[int]) -> list[Failure]:
        """The failures of these drones, except those that are off for good: they die now."""
        dying = [node for node in drones if self._back[node] != inf]
        for node in dying:
            self._back[node] = inf
        self.counts["died"] += len(dying)
        return [Failure(node, None, False) for node in dying]

    def _dies(self, node: int, t: int, level: float) -> bool:
        probability = self._settings.die_rate * min(level, 1.0)
        hazard = inf if probability >= 1.0 else -log1p(-probability)
        self._endures[node] -= hazard + level * self._hazard_per_rate
        return self._endures[node] < 0.0 or self._death.get(node) == t

    def _charge(self, node: int) -> float:
        """How many steps a full battery lasts."""
        battery = self._settings.battery_steps
        return inf if battery is None else self._batteries[node].randint(*battery)

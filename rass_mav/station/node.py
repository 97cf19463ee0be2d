"""A whole node: the agent, and what it tells its autopilot and ground stations."""

from __future__ import annotations

import random
from collections.abc import Callable

from rass_mav.agent.agent import Agent
from rass_mav.agent.seam import Keys
from rass_mav.agent.settings import AgentSettings
from rass_mav.core.observer import Observer
from rass_mav.core.participant import Participant
from rass_mav.core.store import Store
from rass_mav.mavlink.component import ComputerStatus
from rass_mav.mavlink.messages import WARNING

from .ground import Ground
from .parameters import recall
from .reports import Reports
from .statuses import Statuses


def build_node(
    settings: AgentSettings,
    store: Store,
    rng: random.Random,
    *,
    now: float,
    observer: Observer | None = None,
    newborn: bool = False,
    forgiving: bool = False,
    participant: type[Participant] | None = None,
    keys: Keys | None = None,
    computer: Callable[[], ComputerStatus] | None = None,
) -> Agent:
    """A node that starts over its store.

    :param settings: from its file. What a ground station has set in earlier lives comes on top.
    :param computer: returns the state of the computer, for ground stations; None: unknown.

    The others are as in `Agent`.
    """
    configured, about = settings, settings.ground
    unfit: list[str] = []
    if about is not None:
        settings, unfit = recall(store, configured)
    agent = Agent(
        settings, store, rng, now=now, observer=observer, newborn=newborn, forgiving=forgiving,
        participant=participant, keys=keys,
    )  # fmt: skip
    if about is not None:
        agent.ground = Ground(agent, about, configured, now, computer)
        agent.listeners.append(agent.ground)
    if settings.data.status_s != 0 and not agent.node.policy.replicates:
        statuses = Statuses(agent, settings.data.status_s, now)
        agent.listeners.append(statuses)
        agent.services.append(statuses)
    agent.services.append(Reports(agent, now))
    for error in unfit:
        agent.tell_ground(WARNING, f"RASS: not restored: {error}")
    return agent

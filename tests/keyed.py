"""What an agent's keys do for it."""

from __future__ import annotations

from rass_mav.agent.agent import Agent
from rass_mav.trust.trust import Keyed


def keyed(agent: Agent) -> Keyed:
    assert isinstance(agent.trust, Keyed), "it has no keys"
    return agent.trust

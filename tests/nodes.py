"""What tests of whole agents look into."""

from __future__ import annotations

from rass_mav.agent.agent import Agent
from rass_mav.core.node import Node


def node_of(agent: Agent) -> Node:
    """The node of an agent under a policy that hands data over."""
    assert isinstance(agent.node, Node)
    return agent.node

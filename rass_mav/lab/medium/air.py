"""The air between the nodes, as a swarm in virtual time uses it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence

from rass_mav.agent.agent import Agent
from rass_mav.agent.outgoing import Outgoing

from .tally import Tally

#: Called with the nodes that have heard a frame, the frame, and the time in seconds.
Heard = Callable[[Sequence[int], bytes, float], None]


class Air(ABC):
    """Takes frames, and determines which nodes hear them, and when."""

    tally: Tally
    """What has been put on the air."""
    at_once = False
    """Whether frames arrive before the next step, except those that others overtake."""

    @abstractmethod
    def arrive(self, t: int, now: float) -> None:
        """Step `t` begins. Frames that were due by now arrive, at the nodes that were in range before it."""

    @abstractmethod
    def rearrange(self) -> None:
        """Nodes have moved."""

    @abstractmethod
    def send(self, node: int, outgoing: Outgoing, now: float) -> None:
        """A node sends a frame to its neighbours."""

    @abstractmethod
    def broadcast(self, sender: int, frame: bytes, now: float) -> None:
        """Put a frame on the air, past the driver of any node."""

    @abstractmethod
    def start(self, node: int, agent: Agent, now: float) -> None:
        """A node is switched on."""

    @abstractmethod
    def stop(self, node: int) -> None:
        """A node goes off: what waits to be sent is gone."""

    @abstractmethod
    def begin_turn(self, node: int, agent: Agent, now: float) -> None:
        """Tell a node, before its turn, what its link can carry."""

    @abstractmethod
    def strike(self, probabilities: Mapping[int, float], now: float) -> None:
        """Radiation strikes at some nodes, each item with this probability, 0..1."""

    @abstractmethod
    def figures(self, seconds: float) -> dict[str, float]:
        """For the summary, after so many seconds; empty: nothing to say."""

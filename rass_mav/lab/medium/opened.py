"""A frame is opened and decoded once for all nodes that hear it: each would find the same in it."""

from __future__ import annotations

from functools import lru_cache

from rass_mav import wire
from rass_mav.agent.peers import Opened
from rass_mav.mavlink.tunnel import tunnel_from_datagram

#: The decoder of all nodes of a swarm (`Peers`): they hear a frame one after another.
decode = lru_cache(maxsize=16)(wire.decode)


def open_datagram(data: bytes) -> Opened | None:
    """Open a datagram that is exactly one frame with a TUNNEL message, whoever signed it. None: it is anything else."""
    fields = tunnel_from_datagram(data)
    return None if fields is None else (*fields[2:], wire.target_of(fields[5]))

"""What the ground has signed is verified once for all nodes of a swarm that hear it: each would find the same."""

from __future__ import annotations

from functools import cached_property, lru_cache

from rass_mav.trust.keys.certificate import GroundPublic
from rass_mav.trust.keys.identity import Ground


class VerifiedOnce(GroundPublic):
    """The ground's public keys, with the signatures that were good lately."""

    __slots__ = ()

    verify = lru_cache(maxsize=64)(GroundPublic.verify)


class SwarmGround(Ground):
    """The ground of a mock swarm."""

    @cached_property
    def public(self) -> GroundPublic:
        return VerifiedOnce(*super().public)

"""The section `hostile` of a scenario (docs/hostile.md)."""

from __future__ import annotations

from typing import Annotated

from rass_mav.config.bounds import Count
from rass_mav.config.sections import Meta, Section

from .kinds import kinds


class HostileSection(Section):
    """An attacker beside the honest nodes (docs/hostile.md). For virtual time."""

    kind: Annotated[str, Meta(one_of=kinds)]
    near: Annotated[int, Meta(ge=0)] = 0
    """Its place is that of this node: it hears, and is heard by, this node and its neighbours."""
    begin: Annotated[int, Meta(ge=0)] = 0
    """The first step in which it is present."""
    end: Count | None = None
    """The first step in which it is gone; null: it stays."""
    captured: bool = False
    """It has the swarm's link key, from a captured drone: nodes take its frames. Needs `keys`."""

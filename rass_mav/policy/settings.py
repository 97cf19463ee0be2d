"""The settings of a policy, and the policies by their names."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib import import_module
from pkgutil import iter_modules
from typing import Annotated, Literal, NamedTuple

from rass_mav import policy as package
from rass_mav.config.sections import Meta, NonNegative, Positive, Section
from rass_mav.core.policy import Policy


class PolicyKind(NamedTuple):
    """A policy that a configuration can name. Its module lists it in `POLICIES`."""

    name: str
    number: int
    """Its value of the parameter RASS_POLICY, 0 or more. Ground stations and stores remember it: never reuse one."""
    make: Callable[[PolicySettings], Policy]
    """Raises `ConfigError` for impossible weights."""


@cache
def kinds() -> dict[str, PolicyKind]:
    """All policies, by name."""
    modules = (import_module(f"{package.__name__}.{found.name}") for found in iter_modules(package.__path__))
    stated: list[PolicyKind] = [kind for module in modules for kind in getattr(module, "POLICIES", ())]
    return {kind.name: kind for kind in sorted(stated, key=lambda kind: kind.number)}


PolicyName = Annotated[str, Meta(one_of=kinds)]


class PolicySettings(Section):
    """Which node is fit, and which data go where (docs/explanation/policies.md)."""

    name: PolicyName = "survival"
    """The policy. All nodes of a swarm should have the same one, with the same weights."""
    alpha: NonNegative | None = None
    """Weight of hops in Eq. 3; null: 1 under `rass`, 10 under `rass-literal`."""
    beta: NonNegative | None = None
    """Weight of risk in Eq. 3; null: 10 under `rass`, 1 under `rass-literal`."""
    threshold: NonNegative | None = None
    """Threshold T of Eq. 4; null: 1."""
    hop_cost: Positive | None = None
    """Cost of a hop under `survival`, in addition to -log(1 - risk); null: 0.05."""
    unknown_hops: Annotated[int, Meta(ge=1, le=255)] | None = None
    """Hop count of a node without a route to a base; null: 255, more than any real one."""
    rules: Literal["paper", "authors"] = "paper"
    """paper, or authors: ties and eviction as in the authors' code, for the world `reference` of the mock swarm."""

    def make(self) -> Policy:
        """The policy. Raises `ConfigError`."""
        return kinds()[self.name].make(self)

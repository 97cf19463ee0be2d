"""The policies, found by name. A policy is who is fit, and what goes to whom (`rass_mav.core.policy.Policy`).

| name | potential | source |
|---|---|---|
| `rass` | Eq. 3 with alpha 1 on hops, beta 10 on risk | the paper's reasoning and results, the authors' code |
| `rass-literal` | Eq. 3 with alpha 10 on hops, beta 1 on risk | the paper's text |
| `hop-count` | 1/hops | the paper's first benchmark |
| `stigmergy` | none: everything is copied to everybody | the paper's second benchmark |
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from rass_mav.core.policy import Policy
from rass_mav.errors import ConfigError

from .fitness import UNREACHABLE_HOPS, FitnessPolicy
from .reference import ReferencePolicy
from .stigmergy import Stigmergy
from .survival import SurvivalPolicy


@dataclass(frozen=True)
class Weights:
    """What a configuration may say; None leaves it to the policy."""

    alpha: float | None = None
    """Weight of hops in Eq. 3, >= 0."""
    beta: float | None = None
    """Weight of risk in Eq. 3, >= 0."""
    threshold: float | None = None
    """T of Eq. 4, >= 0."""
    unknown_hops: int | None = None
    """Hop count in Eq. 3 of a node without a route, 1..255."""
    hop_cost: float | None = None
    """What a hop is worth, > 0 (`SurvivalPolicy`)."""
    rules: Literal["paper", "authors"] = "paper"
    """authors: fitness is judged and data leave as in the authors' code (`ReferencePolicy`)."""


def _fitness(name: str, alpha: float, beta: float) -> Callable[[Weights], Policy]:
    def make(weights: Weights) -> Policy:
        a = alpha if weights.alpha is None else weights.alpha
        b = beta if weights.beta is None else weights.beta
        if a + b == 0:
            raise ConfigError("policy.alpha: alpha and beta must not both be 0")
        return _weighed(name, a, b, weights)

    return make


def _hop_count(weights: Weights) -> Policy:
    # Its potential is 1/hops by definition: no weights can be set.
    return _weighed("hop-count", 1.0, 0.0, weights)


def _weighed(name: str, alpha: float, beta: float, weights: Weights) -> Policy:
    kind = ReferencePolicy if weights.rules == "authors" else FitnessPolicy
    return kind(
        name,
        alpha=alpha,
        beta=beta,
        threshold=1.0 if weights.threshold is None else weights.threshold,
        unknown_hops=UNREACHABLE_HOPS if weights.unknown_hops is None else weights.unknown_hops,
    )


def _stigmergy(weights: Weights) -> Policy:
    return Stigmergy()


def _survival(weights: Weights) -> Policy:
    return SurvivalPolicy() if weights.hop_cost is None else SurvivalPolicy(hop_cost=weights.hop_cost)


POLICIES: dict[str, Callable[[Weights], Policy]] = {
    "rass": _fitness("rass", 1.0, 10.0),
    "rass-literal": _fitness("rass-literal", 10.0, 1.0),
    "hop-count": _hop_count,
    "stigmergy": _stigmergy,
    "survival": _survival,
}


def make_policy(name: str, weights: Weights | None = None) -> Policy:
    """A policy by name. Raises `ConfigError` for an unknown name or impossible weights."""
    try:
        make = POLICIES[name]
    except KeyError:
        raise ConfigError(f"policy.name: expected one of {', '.join(POLICIES)}, got {name!r}") from None
    return make(weights or Weights())

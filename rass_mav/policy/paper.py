"""The paper's policies: Eq. 3 and 4 with different weights."""

from __future__ import annotations

from functools import partial

from rass_mav.core.policy import Policy
from rass_mav.errors import ConfigError

from .fitness import UNREACHABLE_HOPS, FitnessPolicy
from .reference import ReferencePolicy
from .settings import PolicyKind, PolicySettings


def _risk_aware(alpha: float, beta: float, settings: PolicySettings) -> Policy:
    alpha = alpha if settings.alpha is None else settings.alpha
    beta = beta if settings.beta is None else settings.beta
    if alpha + beta == 0:
        raise ConfigError("policy.alpha: alpha and beta must not both be 0")
    return _weighed(alpha, beta, settings)


def _weighed(alpha: float, beta: float, settings: PolicySettings) -> Policy:
    kind = ReferencePolicy if settings.rules == "authors" else FitnessPolicy
    return kind(
        settings.name,
        alpha=alpha,
        beta=beta,
        threshold=1.0 if settings.threshold is None else settings.threshold,
        unknown_hops=UNREACHABLE_HOPS if settings.unknown_hops is None else settings.unknown_hops,
    )


POLICIES = (
    # By the paper's reasoning and results, and the authors' code.
    PolicyKind("rass", 0, partial(_risk_aware, 1.0, 10.0)),
    # The weights as the paper's text prints them.
    PolicyKind("rass-literal", 1, partial(_risk_aware, 10.0, 1.0)),
    # The paper's first benchmark. Its potential is 1/hops by definition: no weights can be set.
    PolicyKind("hop-count", 2, partial(_weighed, 1.0, 0.0)),
)

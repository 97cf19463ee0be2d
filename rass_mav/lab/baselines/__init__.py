"""Protocols that others have published, to compare ours with. Nobody flies them: they are idealised (`common`)."""

from __future__ import annotations

from typing import Any, NamedTuple

from rass_mav.core.participant import Participant
from rass_mav.lab.baselines.backpressure import Backpressure
from rass_mav.lab.baselines.epidemic import Epidemic
from rass_mav.lab.baselines.prophet import Prophet
from rass_mav.lab.baselines.rapid import Rapid
from rass_mav.lab.baselines.spray import SprayAndFocus, SprayAndWait


class Protocol(NamedTuple):
    """One of the protocols that are compared."""

    title: str
    keys: dict[str, Any]
    """How it differs from the scenario."""
    participant: type[Participant] | None = None
    """What every node is; None: the product's own node."""


#: Routes by hops, and one copy, as far as the product's own replicas go.
_ONE_COPY = {
    "policy.name": "hop-count", "custody.replicas": False, "without": ["receipts"],
}  # fmt: skip
#: Receipts end copies, and leave in every step, so that copies end soon.
_COPIES = {**_ONE_COPY, "without": [], "custody.receipt_steps": 1}

#: What the others are compared with.
OURS = "default"
#: By the name that `--baseline` takes.
PROTOCOLS = {
    OURS: Protocol("our defaults", {}),
    "hop-count": Protocol("hop count, immediate", _ONE_COPY),
    "epidemic": Protocol("epidemic with receipts", _COPIES, Epidemic),
    "spray-and-wait": Protocol("binary spray and wait", _COPIES, SprayAndWait),
    "spray-and-focus": Protocol("spray and focus", _COPIES, SprayAndFocus),
    "prophet": Protocol("PRoPHET", _COPIES, Prophet),
    "rapid": Protocol("RAPID-like", _COPIES, Rapid),
    "backpressure": Protocol("backpressure", _ONE_COPY, Backpressure),
}

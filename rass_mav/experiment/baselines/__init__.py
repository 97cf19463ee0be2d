"""Protocols that others have published, to compare ours with. Nobody flies them: they are idealised (`common`)."""

from __future__ import annotations

from typing import Any, NamedTuple

from rass_mav.core.participant import Participant
from rass_mav.experiment.baselines.backpressure import Backpressure
from rass_mav.experiment.baselines.epidemic import Epidemic
from rass_mav.experiment.baselines.prophet import Prophet
from rass_mav.experiment.baselines.rapid import Rapid
from rass_mav.experiment.baselines.spray import SprayAndFocus, SprayAndWait


class Protocol(NamedTuple):
    """One of the protocols that are compared."""

    title: str
    keys: dict[str, Any]
    """How it differs from the scenario."""
    participant: type[Participant] | None = None
    """What every node is; None: the product's own node."""


#: Routes by hops, whatever the danger; no spare copies of the product.
_BY_HOPS = {"policy.name": "hop-count", "custody.mirror": False, "custody.copies": 1}
#: Copies end by receipts, which leave in every step, so that they end soon.
_COPIES = {**_BY_HOPS, "custody.receipts": True, "custody.receipt_steps": 1}
_ONE_COPY = {**_BY_HOPS, "custody.receipts": False}

#: By the name that `--protocol` takes.
PROTOCOLS = {
    "default": Protocol("our defaults", {}),
    "hop-count": Protocol("hop count, immediate", _ONE_COPY),
    "epidemic": Protocol("epidemic with receipts", _COPIES, Epidemic),
    "spray-and-wait": Protocol("binary spray and wait", _COPIES, SprayAndWait),
    "spray-and-focus": Protocol("spray and focus", _COPIES, SprayAndFocus),
    "prophet": Protocol("PRoPHET", _COPIES, Prophet),
    "rapid": Protocol("RAPID-like", _COPIES, Rapid),
    "backpressure": Protocol("backpressure", _ONE_COPY, Backpressure),
}

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
    """How it differs from the scenario, besides the policy."""
    policy: str = "hop-count"
    """All others than ours know routes by hops at most."""
    participant: type[Participant] | None = None
    """What every node is; None: the product's own node."""


#: One copy, as far as the product's own spare copies go.
_ONE_COPY = {"custody.mirror": False, "custody.copies": 1, "custody.receipts": False}
#: Receipts end copies, and leave in every step, so that copies end soon.
_COPIES = {**_ONE_COPY, "custody.receipts": True, "custody.receipt_steps": 1}

#: What the others are compared with.
OURS = "default"
#: By the name that `--protocol` takes.
PROTOCOLS = {
    OURS: Protocol("our defaults", {}, "survival"),
    "hop-count": Protocol("hop count, immediate", _ONE_COPY),
    "epidemic": Protocol("epidemic with receipts", _COPIES, participant=Epidemic),
    "spray-and-wait": Protocol("binary spray and wait", _COPIES, participant=SprayAndWait),
    "spray-and-focus": Protocol("spray and focus", _COPIES, participant=SprayAndFocus),
    "prophet": Protocol("PRoPHET", _COPIES, participant=Prophet),
    "rapid": Protocol("RAPID-like", _COPIES, participant=Rapid),
    "backpressure": Protocol("backpressure", _ONE_COPY, participant=Backpressure),
}

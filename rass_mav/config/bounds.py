"""Bounds that many keys have."""

from __future__ import annotations

from typing import Annotated

from rass_mav.config.sections import Meta

#: The highest id of a node.
MAX_NODE = 65534

Positive = Annotated[float, Meta(gt=0)]
NonNegative = Annotated[float, Meta(ge=0)]
Fraction = Annotated[float, Meta(ge=0, le=1)]
Count = Annotated[int, Meta(ge=1)]
NodeId = Annotated[int, Meta(ge=0, le=MAX_NODE)]

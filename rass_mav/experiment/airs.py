"""The airs that experiments compare (docs/air.md)."""

from __future__ import annotations

from typing import Any

#: By the name that `--air` takes: differences from the scenario. Slow radios have long steps, so that as many data in a
#: step fit.
AIRS: dict[str, dict[str, Any]] = {
    "none": {},
    "wifi-6m": {"radio.preset": "wifi-6m"},
    "wifi-1m": {"radio.preset": "wifi-1m"},
    "sik-250k": {"radio.preset": "sik-250k", "node.step_s": 10.0},
    "sik-64k": {"radio.preset": "sik-64k", "node.step_s": 10.0},
    "lora": {"radio.preset": "lora", "node.step_s": 60.0},
}
#: Those that are compared unless others are chosen.
USUAL = ("none", "wifi-6m", "wifi-1m")

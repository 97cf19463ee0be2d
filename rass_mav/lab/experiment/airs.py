"""The airs that experiments compare, by the name that `--air` takes: differences from the scenario (docs/air.md)."""

from __future__ import annotations

from typing import Any

AIRS: dict[str, dict[str, Any]] = {
    "none": {},
    "wifi-6m": {"radio.preset": "wifi-6m"},
    "wifi-1m": {"radio.preset": "wifi-1m"},
}
#: On slow radios steps are long, so that as many data in a step fit. No experiment uses these unless asked to.
SLOW_AIRS: dict[str, dict[str, Any]] = {
    "sik-250k": {"radio.preset": "sik-250k", "node.step_s": 10.0},
    "sik-64k": {"radio.preset": "sik-64k", "node.step_s": 10.0},
    "lora": {"radio.preset": "lora", "node.step_s": 60.0},
}

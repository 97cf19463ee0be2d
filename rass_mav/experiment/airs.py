"""The airs that experiments compare: names that `--air` takes, and their keys (docs/simulation.md)."""

from __future__ import annotations

from typing import Any

AIRS: dict[str, dict[str, Any]] = {
    "none": {},
    "wifi-6m": {"radio.air": "csma", "radio.preset": "wifi-6m"},
    "wifi-1m": {"radio.air": "csma", "radio.preset": "wifi-1m"},
}

"""The section `disk` of a scenario (docs/contribute/testing.md)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import field
from typing import Annotated, TypeAlias

from rass_mav.config.sections import Count, Fraction, Meta, NonNegative, Section

Steps: TypeAlias = list[tuple[Annotated[int, Meta(ge=0)], Count]]
"""[[from, to], ...]: from one step until another, one span after the other."""


def wrong_spans(key: str, spans: Steps) -> Iterator[str]:
    """What is wrong with the spans of a key."""
    last = 0
    for begin, end in spans:
        if not last <= begin < end:
            yield (
                f"{key}: expected [from, to] one after the other, each from below its to, "
                f"got {[list(pair) for pair in spans]}"
            )
            return
        last = end


class DiskSection(Section):
    """Every node has the real store on a simulated disk; see docs/contribute/testing.md."""

    cut_rate: Fraction = 0.0
    """Probability that the power of a node, base or drone, is cut in a step; it is off for `failures.reboot_steps`."""
    commit_steps: Annotated[int, Meta(ge=0, le=1000)] = 0
    """How long a commit takes, steps."""
    error_rate: Fraction = 0.0
    """Probability that an operation of a disk fails."""
    full: Steps = field(default_factory=list)
    """When all disks are full: from one step until another."""
    read_only: Steps = field(default_factory=list)
    """When nothing can be written to any disk."""
    flip_rate: NonNegative = 0.0
    """How many bits of a node's database and log flip in a step, on average."""

    def mistakes(self) -> Iterator[str]:
        """Checks across several keys."""
        yield from wrong_spans("disk.full", self.full)
        yield from wrong_spans("disk.read_only", self.read_only)

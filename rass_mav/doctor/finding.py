"""What a check found."""

from __future__ import annotations

from typing import Literal, NamedTuple

Level = Literal["pass", "warn", "fail", "skip"]


class Finding(NamedTuple):
    """The outcome of one check."""

    name: str
    """What was checked."""
    level: Level
    """warn: the node works, but not as well as it could; fail: something that it needs is not there; skip: it could not
    be checked, because of what another check found."""
    text: str
    """What was found, one line."""
    remedy: str = ""
    """What a person can do about it; empty only with pass and skip."""

    def line(self) -> str:
        """For people."""
        return f"{self.level}  {self.name}: {self.text}" + (f"; {self.remedy}" if self.remedy else "")


def passed(name: str, text: str) -> Finding:
    """All is well."""
    return Finding(name, "pass", text)


def skipped(name: str, why: str) -> Finding:
    """It was not checked. `why`: what stands in the way, which another finding tells with its remedy."""
    return Finding(name, "skip", f"not checked: {why}")


def warned(name: str, text: str, remedy: str) -> Finding:
    """It will do."""
    return Finding(name, "warn", text, remedy)


def failed(name: str, text: str, remedy: str) -> Finding:
    """It will not do."""
    return Finding(name, "fail", text, remedy)

"""The result of a check."""

from __future__ import annotations

from typing import Literal, NamedTuple

Level = Literal["pass", "warn", "fail", "skip"]


class Finding(NamedTuple):
    """The result of one check."""

    name: str
    """What was checked."""
    level: Level
    """warn: the node works, but not as well as it could; fail: something that it needs is missing; skip: could not be
    checked, because of another check's finding."""
    text: str
    """What was found, one line."""
    remedy: str = ""
    """What a person can do about it; empty only with pass and skip."""

    def line(self) -> str:
        """The finding as a line for people."""
        return f"{self.level}  {self.name}: {self.text}" + (f"; {self.remedy}" if self.remedy else "")


def passed(name: str, text: str) -> Finding:
    """The check passed."""
    return Finding(name, "pass", text)


def skipped(name: str, why: str) -> Finding:
    """It could not be checked. `why`: the problem that prevents it, which another finding reports with its remedy."""
    return Finding(name, "skip", f"not checked: {why}")


def warned(name: str, text: str, remedy: str) -> Finding:
    """It works, but a person should look at it."""
    return Finding(name, "warn", text, remedy)


def failed(name: str, text: str, remedy: str) -> Finding:
    """It does not work."""
    return Finding(name, "fail", text, remedy)

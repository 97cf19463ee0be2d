"""The errors that `rass_mav` raises on purpose.

Wrong input from the wire, a file or a person raises a `RassError`. Any other exception that escapes is a bug.
"""

from __future__ import annotations

import contextlib
import os
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

#: The most mistakes in one file that are reported.
MOST_LINES = 50


class RassError(Exception):
    """Base of all errors that the outside world causes. Our own mistakes never raise it."""

    def lines(self) -> list[str]:
        """The messages for people, one line for each mistake."""
        return [" ".join(str(self).split())]


class MalformedError(RassError):
    """Bytes from the wire or from a log that do not parse. Malformed input raises this error and no other."""


class ForgedError(RassError):
    """Bytes that were not made by the node that they name, or not for this mission. What they say must not be used."""


class StoreError(RassError):
    """The durable store could not complete a request (damaged database, disk error)."""


class UnpackedSizeError(StoreError):
    """A packed file is so much larger than what came of it that it is not unpacked without being asked for."""


class StoreFullError(StoreError):
    """The store has no space left, in items, in bytes or in its quota. Nothing was stored."""


class StoreDamagedError(StoreError):
    """The database is damaged and can no longer be trusted: abandon the store and open it again, as suspect."""


class StoreCopiedError(StoreError):
    """Another node runs on a copy of the store, so both assign the same numbers: open it again, with a new epoch."""


class DatumError(RassError):
    """A datum that cannot be created: empty, or too large."""


class ConfigError(RassError):
    """An invalid configuration, scenario or command line. Each mistake is a line that names the file and key."""

    def __init__(self, *mistakes: str) -> None:
        super().__init__(*mistakes)
        self.mistakes = mistakes
        """At least one."""

    def __str__(self) -> str:
        return "\n".join(self.mistakes)

    def lines(self) -> list[str]:
        """The mistakes, at most `MOST_LINES`, then the number of the others."""
        lines = [" ".join(mistake.split()) for mistake in self.mistakes[:MOST_LINES]]
        more = len(self.mistakes) - len(lines)
        return [*lines, f"and {more} more mistakes"] if more else lines


class KeysError(ConfigError):
    """A key file that cannot be used, or must not be written. The message shows nothing secret."""

    def __init__(self, text: str, remedy: str) -> None:
        """`text`: what is wrong, with the name of the file. `remedy`: what a person can do about it."""
        super().__init__(f"{text}; {remedy}")
        self.text = text
        self.remedy = remedy


class WrongKeysError(KeysError):
    """A key file that belongs to another node: no change of this computer makes it fit."""


class LogError(RassError):
    """A recorded log that contains no valid record."""


class LinkError(RassError):
    """A port, socket or peer address that cannot be used."""

    def __init__(self, text: str, remedy: str = "") -> None:
        """`text`: what is wrong. `remedy`: what a person can do about it; it ends the message."""
        super().__init__(f"{text}; {remedy}" if remedy else text)
        self.text = text
        self.remedy = remedy


class SwarmError(RassError):
    """A process of a mock swarm failed or stopped responding."""


class ControlError(RassError):
    """The running node could not be reached, or refused a command."""


class RefusedError(ControlError):
    """The running node refused a command. It can be asked for something else."""


class ServiceError(RassError):
    """The system service could not be installed, removed or queried."""


def comma_hint(value: object) -> str:
    """What follows a message about a number that is written with a decimal comma; empty: it is not."""
    if not isinstance(value, str) or re.fullmatch(r"[-+]?\d+,\d+", value) is None:
        return ""
    return f" (a number has a decimal point: {value.replace(',', '.')})"


def installing(extra: str) -> str:
    """How to get the packages of an extra. The project is on no package index: in a checkout the extra's name is
    enough; who installed a wheel has only its list of packages."""
    packages = [] if (Path(__file__).parents[1] / "pyproject.toml").is_file() else packages_of(extra)
    return (
        f"pip install {' '.join(map(shlex.quote, packages))}"
        if packages
        else f"pip install -e '.[{extra}]' in the checkout"
    )


def packages_of(extra: str) -> list[str]:
    """The requirements of an extra, as pip takes them; empty: the project is not installed."""
    from importlib import metadata  # only needed where something is missing

    try:
        requirements = metadata.requires("rass-mav") or []
    except metadata.PackageNotFoundError:
        return []
    found = []
    for requirement in requirements:
        package, _, marker = requirement.partition(";")
        rest, wanted = re.subn(rf"\s*(and\s+)?extra == [\"']{extra}[\"']", "", marker)
        if wanted:
            found.append("; ".join(filter(None, (package.strip(), rest.strip()))))
    return found


def why(error: Exception) -> str:
    """The system's description of an error, in lower case, to follow a colon. The system does not say which part of a
    path is missing."""
    if isinstance(error, FileNotFoundError) and isinstance(error.filename, (str, os.PathLike)):
        folder = Path(error.filename).absolute().parent
        if not folder.is_dir():
            return f"there is no folder {folder}"
        # As /proc and /sys are.
        if not os.statvfs(folder).f_blocks:
            return f"no such file, and {folder} accepts no files"
    return (getattr(error, "strerror", None) or str(error)).lower()


@contextlib.contextmanager
def os_errors_as(kind: type[RassError], where: object) -> Iterator[None]:
    """Turn an `OSError` in the block into an error of this `kind`, which states where it happened and why."""
    try:
        yield
    except OSError as error:
        raise kind(f"{where}: {why(error)}") from None

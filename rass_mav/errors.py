"""The errors that `rass_mav` raises on purpose.

Everything that comes from the wire, a file or a person raises a `RassError`; anything else that escapes is a bug.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

#: Of a file with many mistakes so many are told.
MOST_LINES = 50


class RassError(Exception):
    """Base of all errors caused by the outside world, never by our own mistakes."""

    def lines(self) -> list[str]:
        """What people are told, a line for each mistake."""
        return [" ".join(str(self).split())]


class MalformedError(RassError):
    """Bytes from the wire or from a log that do not parse. Raised for malformed input, and nothing else is."""


class StoreError(RassError):
    """The durable store could not do what was asked (damaged database, disk error)."""


class StoreFullError(StoreError):
    """There is no room left, by items, by bytes or by quota; nothing was stored."""


class StoreDamagedError(StoreError):
    """The database is damaged and cannot be trusted any more: abandon the store and open it anew, as suspect."""


class DatumError(RassError):
    """A datum that cannot be created: empty, or too large."""


class ConfigError(RassError):
    """A configuration, scenario or command line that does not make sense: a line for each mistake, which names the file
    and the key."""

    def __init__(self, *mistakes: str) -> None:
        super().__init__(*mistakes)
        self.mistakes = mistakes
        """At least one."""

    def __str__(self) -> str:
        return "\n".join(self.mistakes)

    def lines(self) -> list[str]:
        """The mistakes, at most `MOST_LINES`; then how many more there are."""
        told = [" ".join(mistake.split()) for mistake in self.mistakes[:MOST_LINES]]
        more = len(self.mistakes) - len(told)
        return [*told, f"and {more} more mistakes"] if more else told


class LogError(RassError):
    """A recorded log without one valid record."""


class LinkError(RassError):
    """A port, socket or peer address that cannot be used."""


class SwarmError(RassError):
    """A process of a mock swarm failed or fell silent."""


class ControlError(RassError):
    """The running node could not be reached, or refused a command."""


class ServiceError(RassError):
    """The system's service could not be installed, removed or asked."""


def installing(extra: str) -> str:
    """How to get the packages of an extra. The project is on no package index: it is installed from its checkout."""
    return f"pip install '.[{extra}]' in the checkout"


def why(error: Exception) -> str:
    """What the system says about an error, in small letters, to stand behind a colon."""
    return (getattr(error, "strerror", None) or str(error)).lower()


@contextlib.contextmanager
def os_errors_as(kind: type[RassError], where: object) -> Iterator[None]:
    """Raise an `OSError` of the block as an error of this `kind`: where it happened, and why."""
    try:
        yield
    except OSError as error:
        raise kind(f"{where}: {why(error)}") from None

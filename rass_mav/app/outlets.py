"""The settings of what runs beside a base: where its data go besides its store (docs/data.md)."""

from __future__ import annotations

import ipaddress
from typing import Annotated, Literal

from rass_mav.config.bounds import Positive
from rass_mav.config.sections import Meta, Section
from rass_mav.errors import ConfigError
from rass_mav.link.address import parse_address

#: Of data, as people write them.
KindName = Literal["measurement", "file", "bytes", "status"]


class OnArrivalSection(Section):
    """A command that is run for each datum that arrives."""

    command: Annotated[tuple[Annotated[str, Meta(min_length=1)], ...], Meta(min_length=1)]
    """The program and its arguments. No shell is involved."""
    timeout_s: Positive = 30.0
    """After this many seconds the command is killed."""
    kinds: tuple[KindName, ...] | None = None
    """Only for data of these kinds; null: for all."""


class MetricsSection(Section):
    """Figures for Prometheus, and a check for health, over HTTP."""

    listen: str = "127.0.0.1:9109"
    """host:port; port 0: any."""

    def check(self) -> None:
        """Raise `ConfigError`."""
        parse_address(self.listen, any_port=True)

    def remarks(self) -> list[str]:
        """What a person should know."""
        host, _ = parse_address(self.listen, any_port=True)
        try:
            alone = ipaddress.IPv4Address(host).is_loopback
        except ValueError:
            alone = host == "localhost"
        if alone:
            return []
        return [
            f"metrics.listen: anybody who can reach {self.listen} can read the node's figures; use 127.0.0.1, and a "
            "tunnel or a proxy that asks for a password"
        ]


#: How the URL of a database begins.
SCHEMES = ("postgresql://", "postgres://")


class PostgresSection(Section):
    """A database that gets what has arrived at several bases."""

    dsn: str
    """The database's URL, as libpq takes it: postgresql://host/name."""
    mission: Annotated[str, Meta(min_length=1, max_length=100)]
    """The name under which the data are filed, the same at all bases."""

    def check(self) -> None:
        """Raise `ConfigError`."""
        if not self.dsn.startswith(SCHEMES):
            raise ConfigError("expected a URL such as postgresql://host/rass")


#: What a section needs that is not installed with every node: the module, and the extra that brings it.
NEEDS = {"metrics": ("prometheus_client", "metrics"), "postgres": ("psycopg", "postgres")}

"""The settings of what runs beside a base: where its data go besides its store (docs/integrate/outputs.md)."""

from __future__ import annotations

import ipaddress
from pathlib import Path
from typing import Annotated, Literal

from rass_mav.config.sections import Meta, Positive, Section
from rass_mav.errors import ConfigError, os_errors_as
from rass_mav.link.address import parse_address

#: Of data, as people write them.
KindName = Literal["measurement", "file", "part", "bytes", "status"]


class OnArrivalSection(Section):
    """A command that is run for each datum that arrives."""

    command: Annotated[tuple[Annotated[str, Meta(min_length=1)], ...], Meta(min_length=1)]
    """The program and its arguments. No shell is involved."""
    timeout_s: Positive = 30.0
    """Time after which the command is killed."""
    kinds: tuple[KindName, ...] | None = None
    """Kinds of data for which it runs; null: all but parts of files."""


#: The shortest token that is taken, and the longest, characters: nobody can guess it.
LEAST_TOKEN, MOST_TOKEN = 16, 200


class PageSection(Section):
    """The mission on a map, in browsers (docs/how-to/page.md)."""

    listen: str = "127.0.0.1:8080"
    """Address and port; port 0: any. Beyond this computer it needs a `token_file`."""
    token_file: str | None = None
    """File whose first line is the token that browsers must send, 16 to 200 characters; null: none."""
    names: tuple[str, ...] = ()
    """Other host names under which browsers may request the page."""
    tiles: str | None = None
    """A map: a file with image tiles (MBTiles, PMTiles); null: a grid in metres."""

    def check(self) -> None:
        """Raise `ConfigError`."""
        host, _ = parse_address(self.listen, any_port=True, ipv6=True)
        if self.token_file is None and not is_loopback(host):
            raise ConfigError(
                f"{host} is reachable from other computers: add a token file, or listen on 127.0.0.1 or localhost"
            )

    def token(self) -> str | None:
        """The first line of the token file; None: there is none. Raises `ConfigError`: it cannot be read, or is no
        token."""
        if self.token_file is None:
            return None
        path = Path(self.token_file)
        with os_errors_as(ConfigError, path):
            text = path.read_bytes()[: 2 * MOST_TOKEN].decode("ascii", "replace")
        token = (text.splitlines() or [""])[0].strip()
        if not (
            LEAST_TOKEN <= len(token) <= MOST_TOKEN and token.isascii() and token.isprintable() and " " not in token
        ):
            raise ConfigError(
                f"{path}: expected a token on the first line, {LEAST_TOKEN} to {MOST_TOKEN} characters without spaces "
                "(for example from `openssl rand -hex 16`)"
            )
        return token


def is_loopback(host: str) -> bool:
    """Whether only this computer reaches an address."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


class BaseSection(Section):
    """What a base cannot measure itself."""

    place: tuple[Annotated[float, Meta(ge=-90, le=90)], Annotated[float, Meta(ge=-180, le=180)]] | None = None
    """Latitude and longitude, degrees; null: where its autopilot is, or else a guess (docs/how-to/page.md)."""


class AttentionSection(Section):
    """What a base counts as out of the ordinary (docs/how-to/attention.md)."""

    above: float | None = None
    """Reading above which a place is a hot spot, in its own unit; null: 100 uSv/h, or a risk of 1."""
    contours: Annotated[tuple[Annotated[float, Meta(ge=1e-6, le=1e9)], ...], Meta(max_length=7)] | None = None
    """Readings, in their own unit, along which maps have lines, besides `above`; null: 1, 25 and 100 uSv/h."""


class MetricsSection(Section):
    """Figures for Prometheus, and a check for health, over HTTP."""

    listen: str = "127.0.0.1:9109"
    """Address and port; port 0: any."""

    def check(self) -> None:
        """Raise `ConfigError`."""
        parse_address(self.listen, any_port=True)

    def remarks(self) -> list[str]:
        """What a person should know."""
        if is_loopback(parse_address(self.listen, any_port=True)[0]):
            return []
        return [
            f"metrics.listen: anyone who can reach {self.listen} can read the node's figures; use 127.0.0.1 "
            "behind a tunnel or a proxy that requires a password"
        ]


#: How the URL of a database begins.
SCHEMES = ("postgresql://", "postgres://")


class PostgresSection(Section):
    """A database that gets what has arrived at several bases."""

    dsn: str
    """URL of the database, as for libpq: `postgresql://host/name`."""
    mission: Annotated[str, Meta(min_length=1, max_length=100)]
    """Name of the mission in the database, the same at all bases."""

    def check(self) -> None:
        """Raise `ConfigError`."""
        if not self.dsn.startswith(SCHEMES):
            raise ConfigError("expected a URL such as postgresql://host/rass")


#: How the address of a client or server of TAK begins.
COT_SCHEMES = ("udp://", "tcp://", "tls://")


class CotSection(Section):
    """Where the drones, the base, hot spots and contours are shown on maps of TAK (Cursor on Target)."""

    url: str
    """`udp://239.2.3.1:6969`, `tcp://host:port` or `tls://host:port`."""
    cert_file: str | None = None
    """With tls: the certificate of this base, PEM."""
    key_file: str | None = None
    """With tls: its private key, PEM, without a password."""
    ca_file: str | None = None
    """With tls: the certificates that must have issued the server's, PEM."""
    server_name: str | None = None
    """With tls: the name in the server's certificate; null: the host of the URL."""

    def check(self) -> None:
        """Raise `ConfigError`."""
        scheme, _, address = self.url.partition("://")
        if f"{scheme}://" not in COT_SCHEMES:
            raise ConfigError(f"expected a URL that begins with {', '.join(COT_SCHEMES)}, got {self.url!r}")
        parse_address(address)
        files = {"cert_file": self.cert_file, "key_file": self.key_file, "ca_file": self.ca_file}
        if scheme == "tls" and (missing := [name for name, file in files.items() if file is None]):
            raise ConfigError(f"tls needs {', '.join(missing)} too")
        if scheme != "tls" and any((*files.values(), self.server_name)):
            raise ConfigError("certificates apply to tls:// only")

    def remarks(self) -> list[str]:
        """What a person should know."""
        scheme, _, address = self.url.partition("://")
        if scheme == "tls" or is_loopback(parse_address(address)[0]):
            return []
        return [f"cot.url: anyone who receives {self.url} sees where the drones are; tls:// prevents that"]


#: What a section needs that is not installed with every node: the module, and the extra that brings it.
NEEDS = {
    "page": ("aiohttp", "ground"),
    "metrics": ("prometheus_client", "metrics"),
    "postgres": ("psycopg", "postgres"),
    "cot": ("pytak", "cot"),
}

"""The configuration of a running node (docs/configuration.md)."""

from __future__ import annotations

import ipaddress
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from rass_mav.agent.ground import VALUE_NAMES
from rass_mav.agent.loading import convert, read_yaml, set_key
from rass_mav.agent.settings import (
    AgentSettings,
    Count,
    CustodySettings,
    DataSettings,
    GroundSettings,
    MavlinkSettings,
    PolicySettings,
    Positive,
    RiskSettings,
    RoutingSettings,
    Section,
    StoreSettings,
    only_value,
)
from rass_mav.core.errors import ConfigError
from rass_mav.link.address import parse_address, parse_multicast, parse_vehicle_url

#: Longest path of a unix socket, bytes (Linux: 108 with the closing zero).
MAX_SOCKET_PATH = 107

NodeId = Annotated[int, Meta(ge=0, le=65534)]


class NodeSection(Section, frozen=True):
    """Who this node is."""

    id: NodeId | None = None
    """Node id, unique in the swarm; null: `mavlink.system_id`."""
    role: Literal["drone", "base"] = "drone"
    """base: a sink, where data arrive."""
    step_s: Positive = 1.0
    """Length of a step, seconds."""
    forward: Literal["step", "immediate"] = "step"
    """step: what came in after a step leaves at the next one at the earliest."""

    def __post_init__(self) -> None:
        """What this version cannot do yet."""
        only_value("node.forward", self.forward, "step")


class AutopilotSection(Section, frozen=True):
    """Where the autopilot is."""

    url: str | None = None
    """`udpin:host:port` or `udpout:host:port`; null: there is none."""


class GroundSection(GroundSettings, frozen=True):
    """The ground station."""

    url: str | None = None
    """`udpout:host:port` or `udpin:host:port`, besides the way through the autopilot; null: none."""


class PeerSection(Section, frozen=True):
    """A neighbour with a known address."""

    address: str
    """host:port"""
    id: NodeId | None = None
    """Its node id; null: learned from its beacons."""


class LinkSection(Section, frozen=True):
    """A UDP link to the neighbours."""

    type: Literal["udp"] = "udp"
    listen: str = "0.0.0.0:14600"
    """Own address and port; port 0: any."""
    peers: tuple[PeerSection, ...] = ()
    """Neighbours that are sent to one by one."""
    broadcast: str | None = None
    """Broadcast address and port, as 192.168.4.255:14600 or 255.255.255.255:14600; null: none."""
    multicast: str | None = None
    """Multicast group and port, as 239.255.82.83:14601; null: none."""
    interface: str | None = None
    """Own IPv4 address on the network for multicast; null: the system chooses."""
    ttl: Annotated[int, Meta(ge=0, le=255)] = 1
    """Multicast frames pass so many routers less one."""

    def check(self, key: str) -> None:
        """Raise `ConfigError` for what cannot be. `key`: of this link."""
        with _under(f"{key}.listen"):
            parse_address(self.listen, any_port=True)
        for index, peer in enumerate(self.peers):
            with _under(f"{key}.peers[{index}].address"):
                parse_address(peer.address)
        if self.broadcast is not None:
            with _under(f"{key}.broadcast"):
                parse_address(self.broadcast)
        if self.multicast is not None:
            with _under(f"{key}.multicast"):
                parse_multicast(self.multicast)
        if self.interface is not None:
            with _under(f"{key}.interface"):
                _check_interface(self.interface)
        if not self.peers and self.broadcast is None and self.multicast is None:
            raise ConfigError(f"{key}: expected at least one of peers, broadcast and multicast")


class ControlSection(Section, frozen=True):
    """The socket for `status`, `put`, `get` and `ls`."""

    socket: Annotated[str, Meta(min_length=1)] | None = None
    """Path of a unix socket; null: that of the store with the ending .sock."""


class LogSection(Section, frozen=True):
    """What is told on stderr."""

    level: Literal["debug", "info", "warning", "error"] = "warning"


class RunStoreSettings(StoreSettings, frozen=True):
    """The store on a disk: reading all of it in every step would wear the card and the battery."""

    scrub_items: Count | None = 50
    """Checksums verified in a step, going round; null: all."""


class RunConfig(Section, frozen=True):
    """A running node."""

    node: NodeSection = NodeSection()
    autopilot: AutopilotSection = AutopilotSection()
    ground: GroundSection = GroundSection()
    links: tuple[LinkSection, ...] = ()
    policy: PolicySettings = PolicySettings()
    risk: RiskSettings = RiskSettings()
    routing: RoutingSettings = RoutingSettings()
    custody: CustodySettings = CustodySettings()
    store: RunStoreSettings = RunStoreSettings()
    data: DataSettings = DataSettings()
    mavlink: MavlinkSettings = MavlinkSettings()
    control: ControlSection = ControlSection()
    log: LogSection = LogSection()

    @property
    def node_id(self) -> int:
        """0..65534. Raises `ConfigError` if nothing says it."""
        node_id = self.mavlink.system_id if self.node.id is None else self.node.id
        if node_id is None:
            raise ConfigError("node.id: missing, expected a whole number 0..65534 (or give mavlink.system_id)")
        return node_id

    @property
    def base(self) -> bool:
        """Whether the node is a sink."""
        return self.node.role == "base"

    @property
    def store_path(self) -> Path:
        """The database file."""
        return Path(self.store.path or f"rass-{self.node_id}.db")

    @property
    def socket_path(self) -> Path:
        """The control socket."""
        return Path(self.control.socket) if self.control.socket else self.store_path.with_suffix(".sock")

    def agent_settings(self) -> AgentSettings:
        """What the agent needs of it."""
        return AgentSettings.of(self, node_id=self.node_id, base=self.base, step_s=self.node.step_s, ground=self.ground)

    def check(self) -> None:
        """Raise `ConfigError` for what no single key can say."""
        settings = self.agent_settings()
        settings.policy.make()
        settings.node_settings()
        if not self.base and not self.links:
            raise ConfigError("links: a drone needs at least one")
        for index, link in enumerate(self.links):
            link.check(f"links[{index}]")
        for key, url in (("autopilot.url", self.autopilot.url), ("ground.url", self.ground.url)):
            if url is not None:
                with _under(key):
                    parse_vehicle_url(url)
        if self.mavlink.reading_name in VALUE_NAMES:
            raise ConfigError(
                f"mavlink.reading_name: expected another name than {', '.join(VALUE_NAMES)}, which the node says itself"
            )
        if not self.mavlink.reading_name.isascii():
            raise ConfigError(f"mavlink.reading_name: expected ASCII characters, got {self.mavlink.reading_name!r}")
        if self.store.path is not None and not self.store.path:
            raise ConfigError("store.path: expected a path, got ''")
        if len(str(self.socket_path).encode()) > MAX_SOCKET_PATH:
            raise ConfigError(
                f"control.socket: expected a path of at most {MAX_SOCKET_PATH} bytes, got {str(self.socket_path)!r}"
            )


@contextmanager
def _under(key: str) -> Iterator[None]:
    """Put a key in front of the `ConfigError`s of a block."""
    try:
        yield
    except ConfigError as error:
        raise ConfigError(f"{key}: {error}") from None


def _check_interface(text: str) -> None:
    try:
        ipaddress.IPv4Address(text)
    except ValueError:
        raise ConfigError(f"expected an own IPv4 address, got {text!r}") from None


def load_config(path: str | Path, assignments: Iterable[str] = ()) -> RunConfig:
    """Read and check a configuration. `assignments`: `key.path=value`, they override the file.

    Raises `ConfigError` that names the file and the key.
    """
    raw = read_yaml(path)
    for assignment in assignments:
        set_key(raw, assignment)
    config = convert(raw, RunConfig, str(path))
    with _under(str(path)):
        config.check()
    return config


def filled_in(config: RunConfig) -> RunConfig:
    """The same configuration with the defaults that depend on others written out."""
    return msgspec.structs.replace(
        config,
        node=msgspec.structs.replace(config.node, id=config.node_id),
        store=msgspec.structs.replace(config.store, path=str(config.store_path)),
        control=msgspec.structs.replace(config.control, socket=str(config.socket_path)),
    )

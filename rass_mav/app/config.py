"""The configuration of a running node (docs/reference/configuration.md)."""

from __future__ import annotations

import os
import shlex
import time
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from rass_mav.agent.settings import AgentSettings, DataSettings, GroundSettings
from rass_mav.config.keys import KeysSection, check_package
from rass_mav.config.loading import read_yaml, set_keys
from rass_mav.config.old_keys import read_old_keys
from rass_mav.config.sections import Count, Meta, Mistakes, NodeId, NonNegative, Positive, Section
from rass_mav.config.typed import build_with
from rass_mav.core.settings import CustodySettings, Forward, RiskSettings, RoutingSettings, StoreSettings
from rass_mav.errors import ConfigError, KeysError, WrongKeysError
from rass_mav.link.address import parse_address, parse_multicast, parse_vehicle_url
from rass_mav.link.base import Address
from rass_mav.link.interface import ANY_ADDRESS
from rass_mav.link.settings import LinkSection
from rass_mav.mavlink.settings import MavlinkSettings
from rass_mav.policy.settings import PolicySettings
from rass_mav.sensor.settings import SensorSettings
from rass_mav.station.ground import VALUE_NAMES

from .outlets import (
    AttentionSection,
    BaseSection,
    CotSection,
    MetricsSection,
    OnArrivalSection,
    PageSection,
    PostgresSection,
)

if TYPE_CHECKING:
    from rass_mav.trust.keys.keyring import Keyring

#: Messages that telemetry needs and an autopilot does not always send unasked, with the seconds between two.
DEFAULT_MESSAGES = {"GLOBAL_POSITION_INT": 1.0, "LOCAL_POSITION_NED": 1.0, "GPS_RAW_INT": 1.0, "SYSTEM_TIME": 5.0}
#: Longest path of a unix socket, bytes (Linux: 108 with the closing zero).
MAX_SOCKET_PATH = 107


class NodeSection(Section):
    """Identity and pace of the node."""

    id: NodeId | None = None
    """Node id, unique in the swarm; null: `mavlink.system_id`."""
    role: Literal["drone", "base"] = "drone"
    """drone, or base: data that reach a base have arrived."""
    step_s: Positive = 1.0
    """Length of a step, seconds."""
    forward: Forward = "immediate"
    """When data that came in move on. immediate: at once, within `store.bandwidth_items`; step: in the next step at the
    earliest, as in the paper."""
    clock: Literal["auto", "trusted", "untrusted"] = "auto"
    """Whether the computer's date is right, and so shows how long the node was off. auto: as the kernel reports;
    trusted: always, for a clock chip that was set; untrusted: never."""


class AutopilotSection(Section):
    """The connection to the autopilot (docs/how-to/autopilot.md)."""

    url: str | None = None
    """Connection string: `serial:device:baud`, `udpin:host:port`, `udpout:host:port` or `tcp:host:port`; null: no
    autopilot."""
    messages: dict[str, Annotated[float, Meta(ge=0.02, le=60)]] = field(default_factory=lambda: dict(DEFAULT_MESSAGES))
    """Messages that the node requests from the autopilot, by name, with the seconds between two; {}: none. It uses
    these four: for its position, the error of that, and the date."""
    signing: bool = False
    """Whether the autopilot signs with this drone's key (docs/how-to/autopilot.md). The node then ignores unsigned
    messages at its port. Needs `keys`; impossible with a link of type `autopilot`."""


class GroundSection(GroundSettings):
    """What a ground station sees and may set (docs/how-to/ground-station.md)."""

    url: str | None = None
    """Connection string of a direct connection, as for `autopilot.url`; null: only through the autopilot."""


class ControlSection(Section):
    """The socket through which `status`, `put` and `measure` reach the running node."""

    socket: Annotated[str, Meta(min_length=1)] | None = None
    """Path of the Unix socket, at most 107 bytes; null: the store's path with the ending .sock."""


class LogSection(Section):
    """The log on stderr."""

    level: Literal["debug", "info", "warning", "error"] = "warning"
    """The lowest severity that is logged. The options -v and -vv override it."""


class WatchSection(Section):
    """A folder whose files the node sends (docs/how-to/files.md)."""

    folder: Annotated[str, Meta(min_length=1)]
    """Path of the folder. The node never changes or deletes anything in it."""
    settle_s: Positive = 5.0
    """A file is complete once its size and date have not changed for this time."""


class RunStoreSettings(StoreSettings):
    """The store on disk (docs/reference/store.md)."""

    # To read all of it in every step would wear out the card and drain the battery.

    scrub_items: Count | None = 50
    """Data whose checksums are verified in a step, in rotation; null: all."""


class RunDataSettings(DataSettings):
    """The data that a node creates. A base creates no measurements."""

    status_s: NonNegative | None = None
    """Time between two status data of a drone; 0: none; null: 60, and more on a slow link."""
    part_bytes: Annotated[int, Meta(ge=1 << 12, le=1 << 16)] | None = None
    """Largest part into which a file is cut (docs/how-to/files.md); null: 32 KiB, and less on a slow link."""


class RunConfig(Section):
    """A running node."""

    node: NodeSection = NodeSection()
    autopilot: AutopilotSection = AutopilotSection()
    ground: GroundSection = GroundSection()
    sensor: SensorSettings = SensorSettings()
    links: tuple[LinkSection, ...] = ()
    policy: PolicySettings = PolicySettings()
    risk: RiskSettings = RiskSettings()
    routing: RoutingSettings = RoutingSettings()
    custody: CustodySettings = CustodySettings()
    store: RunStoreSettings = RunStoreSettings()
    data: RunDataSettings = RunDataSettings()
    mavlink: MavlinkSettings = MavlinkSettings()
    keys: KeysSection | None = None
    """The node's keys (docs/how-to/keys.md); null: none, the link is open."""
    control: ControlSection = ControlSection()
    base: BaseSection | None = None
    """Only at a base: where it is."""
    attention: AttentionSection = AttentionSection()
    """What needs attention at a base (docs/how-to/attention.md)."""
    on_arrival: OnArrivalSection | None = None
    """Only at a base: a command that runs for each datum that arrives (docs/integrate/outputs.md); null: none."""
    page: PageSection | None = None
    """Only at a base: the mission on a map, in browsers (docs/how-to/page.md); null: none."""
    metrics: MetricsSection | None = None
    """Only at a base: figures for Prometheus (docs/integrate/outputs.md); null: none."""
    postgres: PostgresSection | None = None
    """Only at a base: a PostgreSQL database to write what arrives into (docs/integrate/outputs.md); null: none."""
    cot: CotSection | None = None
    """Only at a base: a TAK client or server that shows the mission (docs/integrate/outputs.md); null: none."""
    watch: WatchSection | None = None
    """A folder whose files the node sends (docs/how-to/files.md); null: none."""
    log: LogSection = LogSection()

    @property
    def node_id(self) -> int:
        """0..65534. Raises `ConfigError` if the configuration has none."""
        node_id = self.mavlink.system_id if self.node.id is None else self.node.id
        if node_id is None:
            raise ConfigError("node.id: missing, expected a whole number 0..65534 (or give mavlink.system_id)")
        return node_id

    @property
    def is_base(self) -> bool:
        """Whether the node is a sink."""
        return self.node.role == "base"

    @property
    def store_path(self) -> Path:
        """The database file."""
        return Path(self.store.path or f"rass-{self.node_id}.db")

    @property
    def socket_path(self) -> Path:
        """The control socket. A full path may be too long for the system where the one from here is not."""
        path = Path(self.control.socket) if self.control.socket else self.store_path.with_suffix(".sock")
        return path if _bytes(path) <= MAX_SOCKET_PATH else min(path, Path(os.path.relpath(path)), key=_bytes)

    @property
    def outlets(self) -> list[str]:
        """The names of the sections that something beside the node attends to."""
        return [
            name for name in ("on_arrival", "page", "metrics", "postgres", "cot") if getattr(self, name) is not None
        ]

    def agent_settings(self) -> AgentSettings:
        """The settings that the agent needs."""
        return AgentSettings.of(
            self,
            node_id=self.node_id,
            base=self.is_base,
            step_s=self.node.step_s,
            forward=self.node.forward,
            ground=self.ground,
            sensor_unit=self.sensor.unit if self.sensor.own else None,
        )

    def open_keys(self) -> Keyring | None:
        """The node's keys from their file; None: the configuration names none. Raises `KeysError`."""
        if self.keys is None:
            return None
        check_package()
        from rass_mav.trust.keys.keyring import load_keyring  # with PyNaCl, which a node without keys does not need

        return load_keyring(self.keys.file, self.node_id, base=self.is_base)

    def check_keys(self) -> None:
        """Raise `ConfigError` for keys that are here and are not this node's. Others may still come."""
        with suppress(KeysError):
            try:
                self.open_keys()
            except WrongKeysError as error:
                raise ConfigError(f"keys.file: {error}") from None

    def check(self) -> None:
        """Raise `ConfigError` for mistakes that concern more than one key."""
        mistakes = Mistakes()
        self.look_over(mistakes)
        mistakes.check()

    def look_over(self, mistakes: Mistakes) -> None:
        """Like `check`, but add the mistakes to those of single keys."""
        with mistakes.gathering():
            _ = self.node_id
        if mistakes.sound("policy", "custody", "store", "data"):
            with mistakes.gathering():
                replace(self, node=replace(self.node, id=0)).agent_settings()
        self._look_over_links(mistakes)
        for key, url in (("autopilot.url", self.autopilot.url), ("ground.url", self.ground.url)):
            if url is not None:
                with mistakes.gathering(key):
                    parse_vehicle_url(url)
        self._look_over_ports(mistakes)
        if self.autopilot.signing:
            self._look_over_signing(mistakes)
        if not self.autopilot.messages.keys() <= DEFAULT_MESSAGES.keys():
            from rass_mav.station.rates import message_ids  # with all message definitions, which a client does not need

            with mistakes.gathering("autopilot.messages"):
                message_ids(self.autopilot.messages)
        if mistakes.sound("sensor.type"):
            with mistakes.gathering():
                self.sensor.check()
        if mistakes.sound("sensor.type") and self.sensor.kind.at_autopilot:
            self._look_over_tunnels(mistakes)
        contradicts = self.sensor.own and self.risk.unit not in (None, self.sensor.unit)
        if contradicts and mistakes.sound("sensor.type", "sensor.unit", "risk.unit"):
            mistakes.add("risk.unit", f"expected {self.sensor.unit} as in sensor.unit, or null, got {self.risk.unit!r}")
        if self.mavlink.reading_name in VALUE_NAMES:
            mistakes.add(
                "mavlink.reading_name",
                f"expected a name other than {', '.join(VALUE_NAMES)}, which the node itself uses",
            )
        if self.mavlink.reading_component == self.mavlink.component_id and mistakes.sound("mavlink.component_id"):
            mistakes.add(
                "mavlink.reading_component", "expected a component other than mavlink.component_id (this node)"
            )
        if not self.mavlink.reading_name.isascii():
            mistakes.add("mavlink.reading_name", f"expected ASCII characters, got {self.mavlink.reading_name!r}")
        self._look_over_outlets(mistakes)
        if self.store.path is not None and not self.store.path:
            mistakes.add("store.path", "expected a path, got ''")
        if mistakes.sound("node.id", "mavlink.system_id", "store.path", "control.socket"):
            socket = str(self.socket_path)
            if len(socket.encode()) > MAX_SOCKET_PATH:
                mistakes.add("control.socket", f"expected a path of at most {MAX_SOCKET_PATH} bytes, got {socket!r}")

    def _look_over_ports(self, mistakes: Mistakes) -> None:
        """No two keys may ask for one UDP port. Only groups are shared."""
        types = [f"links[{index}].type" for index in range(len(self.links))]
        ports = list(self._udp_ports()) if all(map(mistakes.sound, types)) else []
        for place, (key, text, (host, port)) in enumerate(ports):
            for other, _, (taken, same) in ports[:place]:
                shared = key.endswith("multicast") and other.endswith("multicast")
                if port and port == same and not shared and (host == taken or ANY_ADDRESS in (host, taken)):
                    mistakes.add(key, f"expected a port other than that of {other}, got {text!r}")
                    break

    def _udp_ports(self) -> Iterator[tuple[str, str, Address]]:
        """The keys of UDP ports on which the node listens, with their texts. Without those that are mistakes."""
        for key, url in (("autopilot.url", self.autopilot.url), ("ground.url", self.ground.url)):
            with suppress(ConfigError):
                if url is not None and (parsed := parse_vehicle_url(url)).mode == "udpin":
                    yield key, url, parsed.address
        for index, link in enumerate(self.links):
            if "multicast" not in link.kind.keys:
                continue
            with suppress(ConfigError):
                yield f"links[{index}].listen", link.listen, parse_address(link.listen, any_port=True)
            if link.multicast is not None:
                with suppress(ConfigError):
                    yield f"links[{index}].multicast", link.multicast, parse_multicast(link.multicast)

    def _look_over_tunnels(self, mistakes: Mistakes) -> None:
        kind = self.sensor.type
        if self.autopilot.url is None and mistakes.sound("autopilot.url"):
            mistakes.add("sensor.type", f"{kind} needs autopilot.url, where its messages arrive")
        for index, link in enumerate(self.links):
            if link.kind.through and mistakes.sound(f"links[{index}].type", "sensor.type"):
                # All such detectors have the same ids.
                mistakes.add(
                    "sensor.type",
                    f"{kind} cannot be told apart from those of neighbours, whose frames arrive on links[{index}]",
                )

    def _look_over_signing(self, mistakes: Mistakes) -> None:
        key = "autopilot.signing"
        if self.is_base and mistakes.sound("node.role"):
            mistakes.add(key, "applies to drones only")
        elif self.keys is None and mistakes.sound("keys"):
            mistakes.add(key, "needs keys.file, the drone's key file (rass-mav keys drone)")
        elif self.autopilot.url is None and mistakes.sound("autopilot.url"):
            mistakes.add(key, "needs autopilot.url")
        for index, link in enumerate(self.links):
            if link.kind.through and mistakes.sound(f"links[{index}].type", key):
                # It drops what has another key, and has room for 16 signed senders.
                mistakes.add(
                    key,
                    f"such an autopilot does not forward the swarm's frames: give links[{index}] a radio of its own "
                    "at this computer (type udp or serial), or turn signing off (rass-mav params signing --off)",
                )

    def _look_over_outlets(self, mistakes: Mistakes) -> None:
        if not self.is_base and mistakes.sound("node.role"):
            for name in (*self.outlets, *(("base",) if self.base is not None else ())):
                mistakes.add(name, "applies to bases only")
        if not self.is_base and self.keys is not None and self.keys.accept_open and mistakes.sound("node.role"):
            mistakes.add("keys.accept_open", "applies to bases only")
        if self.page is not None and mistakes.sound("page.listen", "page.token_file"):
            with mistakes.gathering("page.listen"):
                self.page.check()
        if self.metrics is not None and mistakes.sound("metrics.listen"):
            with mistakes.gathering("metrics.listen"):
                self.metrics.check()
        if self.postgres is not None and mistakes.sound("postgres.dsn"):
            with mistakes.gathering("postgres.dsn"):
                self.postgres.check()
        if self.cot is not None and mistakes.sound("cot.url", "cot.cert_file", "cot.key_file", "cot.ca_file"):
            with mistakes.gathering("cot.url"):
                self.cot.check()

    def _look_over_links(self, mistakes: Mistakes) -> None:
        if not self.is_base and not self.links and mistakes.sound("node.role", "links"):
            mistakes.add("links", "a drone needs at least one")
        types = [f"links[{index}].type" for index in range(len(self.links))]
        for index, link in enumerate(self.links):
            if mistakes.sound(types[index]):
                with mistakes.gathering():
                    link.check(f"links[{index}]")
        through = [index for index, link in enumerate(self.links) if link.kind.through]
        if not through:
            return
        first = self.links[through[0]].type
        if self.autopilot.url is None and mistakes.sound("autopilot.url"):
            mistakes.add(types[through[0]], f"{first} needs autopilot.url")
        elif not self.mavlink.autopilot_id and mistakes.sound("mavlink.autopilot_id"):
            # Neighbours' autopilots are heard on the same port, so the first one heard may not be ours.
            mistakes.add(types[through[0]], f"{first} needs mavlink.autopilot_id, the autopilot's system id")
        if len(through) > 1:
            mistakes.add(types[through[1]], "only one link can go through the autopilot")

    def warnings(self) -> list[str]:
        """Settings that do not fit the computer's present state, although they may fit later, and what others may see.
        Asks the system."""
        from .clock import impossible  # which a client does not need

        found = [remark for index, link in enumerate(self.links) for remark in link.remarks(f"links[{index}]")]
        remarks = [f"{remark.key}: {remark.text}; {remark.remedy}" for remark in found]
        try:
            self.open_keys()
        except KeysError as error:
            remarks.append(f"keys.file: {error}")
        if (date := impossible(time.time())) is not None:
            remarks.append(
                f"the clock of this computer shows {date}, which is impossible: dates are wrong until it is set"
            )
        remarks += self._remarks_on_folder()
        remarks += [] if self.metrics is None else self.metrics.remarks()
        return remarks + ([] if self.cot is None else self.cot.remarks())

    def _remarks_on_folder(self) -> list[str]:
        from rass_mav.store.disk import space  # which a client does not need

        folder = self.store_path.absolute().parent
        try:
            disk = space(folder)
        except FileNotFoundError:
            return [f"store.path: there is no folder {folder}; create it (mkdir -p {shlex.quote(str(folder))})"]
        except OSError:
            return []  # it may be another user's
        return [] if disk.usable else [f"store.path: {folder} has no space for a store"]


def _bytes(path: Path) -> int:
    return len(os.fsencode(path))


def home_of(path: str | Path, root: Path = Path("/")) -> Path:
    """The folder from which the relative paths of a configuration start, absolute, so that errors name files in full:
    its own; that of its service's data, /var/lib/NAME, for /etc/NAME/node.yaml. `root`: the folder with `etc` and
    `var`."""
    file = Path(os.path.abspath(path))
    data = root / "var/lib" / file.parent.name
    if file == root / "etc" / file.parent.name / "node.yaml" and data.is_dir():
        return data
    return file.parent


def settled(config: RunConfig, home: Path) -> RunConfig:
    """The configuration with all its relative paths below `home`."""

    def at(path: str | None) -> str | None:
        return str(home / path) if path else path

    default = None
    with suppress(ConfigError):
        default = f"rass-{config.node_id}.db"
    hook, page, watch = config.on_arrival, config.page, config.watch
    if hook is not None and "/" in hook.command[0]:
        hook = replace(hook, command=(str(home / hook.command[0]), *hook.command[1:]))
    return replace(
        config,
        store=replace(config.store, path=at(default if config.store.path is None else config.store.path)),
        control=replace(config.control, socket=at(config.control.socket)),
        sensor=replace(config.sensor, path=at(config.sensor.path)),
        keys=None if config.keys is None else replace(config.keys, file=str(home / config.keys.file)),
        watch=None if watch is None else replace(watch, folder=str(home / watch.folder)),
        page=None if page is None else replace(page, token_file=at(page.token_file), tiles=at(page.tiles)),
        on_arrival=hook,
    )


#: Keys that scenarios have and configurations do not. One of them may be a slip of the pen.
_OF_SCENARIOS = {"title", "nodes", "steps", "topology", "mobility", "radio", "radiation", "failures", "traffic"}


def load_config(
    path: str | Path, assignments: Iterable[str] = (), *, root: Path = Path("/"), settle: bool = True
) -> RunConfig:
    """Read and check a configuration. `assignments`: `key.path=value`; they override the file. `settle`: relative
    paths start from `home_of` the file; False: they are left as they are. `root`: as for `home_of`.

    Raises `ConfigError` with all mistakes. Each names the file and the key.
    """
    raw = read_yaml(path)
    if len(raw.keys() & _OF_SCENARIOS) > 1:
        command = f"sitl {path}" if "flight" in raw else f"swarm {path} --steps 0"
        raise ConfigError(
            f"{path}: looks like a scenario of a mock swarm, not a node's configuration: use rass-mav {command}"
        )
    mistakes = Mistakes(str(path))
    set_keys(raw, assignments, mistakes)
    read_old_keys(raw, mistakes, lab=False)
    config = build_with(raw, RunConfig, mistakes)
    if config is not None:
        before, config = config, settled(config, home_of(path, root)) if settle else config
        # A mistake in the sensor's keys shows what the file says.
        replace(config, sensor=before.sensor).look_over(mistakes)
    mistakes.check()
    assert config is not None
    return config


def filled_in(config: RunConfig) -> RunConfig:
    """The same configuration, with the defaults that depend on other keys written out."""
    return replace(
        config,
        node=replace(config.node, id=config.node_id),
        store=replace(config.store, path=str(config.store_path)),
        control=replace(config.control, socket=str(config.socket_path)),
    )

"""Scenarios: descriptions of mock swarms in YAML files, typed and checked (docs/evaluation/simulation.md), and where
they are."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import field, replace
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from rass_mav.agent.settings import AgentSettings, DataSettings
from rass_mav.config.loading import read_yaml, set_keys
from rass_mav.config.old_keys import read_old_keys
from rass_mav.config.sections import Count, Fraction, Meta, Mistakes, NonNegative, Positive, Section
from rass_mav.config.typed import build_with
from rass_mav.core.settings import CustodySettings, Forward, Mechanism, RiskSettings, RoutingSettings, StoreSettings
from rass_mav.errors import ConfigError
from rass_mav.lab.disk.settings import DiskSection, Steps, wrong_spans
from rass_mav.lab.hostile.kinds import HostileSection
from rass_mav.lab.medium.settings import RadioSection
from rass_mav.mavlink.settings import MavlinkSettings
from rass_mav.policy.settings import PolicyName, PolicySettings
from rass_mav.sensor.settings import TubeName


class NodeSection(Section):
    """Pace of every node."""

    step_s: Positive = 0.2
    """Length of a step, seconds."""
    forward: Forward = "immediate"
    """When data that came in move on. immediate: at once, within `store.bandwidth_items`; step: in the next step at the
    earliest, as in the paper."""
    phases: Literal["lockstep", "random"] = "random"
    """When nodes take their turns. random: each at a moment of its own, the same in every step, as real computers do;
    lockstep: all at the beginning of a step."""


class MobilitySection(Section):
    """Where the nodes are and how they move: options of `topology`. Those of other topologies have no effect."""

    bases: Literal["apart", "even"] = "apart"
    """Where several bases are in `grid`, `line`, `islands`, and at the start of `random-walk`. apart: as far from each
    other as possible, in corners first; even: each in the middle of about as many nodes as the others."""
    pitch_m: Positive | None = None
    """Distance of neighbours in `line`, metres; null: 0.8 of the radio range."""
    split_step: Annotated[int, Meta(ge=0)] = 100
    """Step in which the far half of `islands` moves away."""
    rejoin_step: Annotated[int, Meta(ge=0)] | None = None
    """Step in which it comes back; null: never."""
    gap_m: NonNegative = 2.0
    """How far it moves, metres."""
    positions: list[tuple[float, float]] | None = None
    """For the topology `positions`: [x, y] of each node, metres, the arena's centre as origin."""
    layout: Literal["own", "authors"] = "own"
    """own, or authors: places and motion of `grid`, `scale-free`, `lennard-jones` and `random-walk` as in the authors'
    experiment."""
    area_m: tuple[Positive, Positive] | None = None
    """`survey`: width (west to east) and height of the area, metres, the arena's centre as its own; null: the arena."""
    strip_m: Positive = 50.0
    """`survey`: the most that two strips of a drone may be apart, metres."""
    speed_m_s: tuple[Positive, Positive] = (5.0, 15.0)
    """`survey`: the speed of each drone is uniform between these, m/s."""
    base_speed_m_s: NonNegative = 0.0
    """`survey`: how fast the bases drive along the edge of the area, m/s."""
    gps_error_m: NonNegative = 0.0
    """Standard deviation of the error with which GPS places a node, to north and to east, metres. It lasts about a
    minute."""

    def mistakes(self) -> Iterator[str]:
        """Checks across several keys."""
        if self.speed_m_s[0] > self.speed_m_s[1]:
            yield f"mobility.speed_m_s: expected two numbers in ascending order, got {list(self.speed_m_s)}"


class RadiationSection(Section):
    """The radiation field: that of the paper, Eq. 1 and 2, or dose rates (docs/evaluation/simulation.md)."""

    law: Literal["paper", "dose"] = "paper"
    """paper: Eq. 1 and 2, levels without a unit; dose: dose rates in uSv/h, a Geiger counter's readings, and damage in
    proportion to the dose."""
    sources: list[tuple[float, float, NonNegative]] | None = None
    """[x, y, intensity] of each source, metres, the arena's centre as origin; null: `random_sources` by the seed. With
    `law` dose the intensity is the dose rate 1 m from the source, uSv/h."""
    sets: list[list[tuple[float, float, NonNegative]]] | None = None
    """Sources of several runs: seed k has set k mod their number. Replaces `sources`."""
    random_sources: Annotated[int, Meta(ge=0)] = 3
    """How many sources are drawn, unless `sources` or `sets` are given: x and y uniform within `spread_m`, intensity
    uniform in 0..1, or as `strength`."""
    spread_m: NonNegative = 3.5
    """Half of the side of the square in which `random_sources` are."""
    decay: NonNegative = 1.0
    """lambda of Eq. 1, 1/m^2."""
    drift: NonNegative = 0.0
    """How far each source moves in a step, metres."""
    noise: NonNegative = 0.05
    """Standard deviation of the sensor's noise b of Eq. 1."""
    corruption: bool = True
    """Whether data in drones' stores are struck. Where `radio.air` takes time, frames that wait or fly are struck too:
    who hears one counts it as malformed."""
    strikes_per_step: Annotated[int, Meta(ge=1, le=1000)] = 1
    """How often in a step they are struck, at equal distances from its beginning on, with equal probability in all."""
    rule: Literal["probability", "threshold"] = "probability"
    """probability: Eq. 2; threshold: a datum is struck when a tolerance drawn for it is below the drone's risk."""
    tolerance: tuple[float, float] = (0.15, 0.5)
    """threshold: tolerances are uniform between these."""
    jitter: NonNegative = 0.05
    """threshold: uniform in +-jitter, added to the risk, once for each drone and step."""
    round_m: NonNegative = 0.0
    """The field is taken at positions rounded to multiples of this, metres; 0: not rounded."""
    cylinder_m: NonNegative = 0.0
    """Radius of the sources as cylinders that block the radio's line of sight, metres; 0: they block nothing."""
    cylinders: Literal["own", "slipped"] = "own"
    """Whose cylinders. slipped: seed k uses those of set (k mod sets - 1) mod 10, as in the authors' experiment."""
    strength: tuple[Positive, Positive] = (1e5, 1e7)
    """Law dose: of `random_sources`, uSv/h at 1 m. Its logarithm is uniform between these."""
    background: NonNegative = 0.1
    """Law dose: the dose rate without sources, uSv/h."""
    height_m: Positive = 10.0
    """Law dose: how high all nodes are above the sources, metres."""
    tube: TubeName = "sbm-20"
    """Law dose: the counter's tube. It counts for a step."""
    page_bytes: Count = 4096
    """Law dose: a datum occupies whole pages of this size, and is struck when one of them is lost."""
    page_dose: Positive = 9e7
    """Law dose: the mean dose at which a page is lost, uSv."""

    def sources_of(self, seed: int) -> list[tuple[float, float, float]] | None:
        """The sources of a run; None: `random_sources`."""
        return self.sets[seed % len(self.sets)] if self.sets else self.sources

    def cylinders_of(self, seed: int) -> list[tuple[float, float, float]]:
        """The sources whose cylinders block the radio in a run; only sources that are given have cylinders."""
        if self.cylinders == "slipped" and self.sets:
            run = seed % len(self.sets)
            # Only the last digit of the previous run's number was read.
            return self.sets[max(run - 1, 0) % 10 % len(self.sets)]
        return self.sources_of(seed) or []

    def mistakes(self) -> Iterator[str]:
        """Checks across several keys."""
        if self.sets is not None and (not self.sets or self.sources is not None):
            yield ("radiation.sets: expected at least one set of sources, and no radiation.sources beside them")
        if self.tolerance[0] >= self.tolerance[1]:
            yield f"radiation.tolerance: expected two rising numbers, got {list(self.tolerance)}"
        if self.strength[0] > self.strength[1]:
            yield f"radiation.strength: expected two numbers in ascending order, got {list(self.strength)}"
        if self.law == "dose" and self.rule != "probability":
            yield f"radiation.rule: expected probability with radiation.law dose, got {self.rule}"
        if self.cylinder_m and (self.drift or (self.sources is None and self.sets is None)):
            yield "radiation.cylinder_m: expected 0 unless the sources are given and do not move"


class TrafficSection(Section):
    """Load, and data that only a mock swarm creates. For virtual time."""

    load: Positive | None = None
    """What all drones create, as a share of the one-hop capacity around all bases (docs/evaluation/simulation.md). Sets
    `picture_interval_steps` where there are pictures, otherwise `data.interval_steps`, to 1 at least; null: sets
    nothing."""
    picture_bytes: Annotated[int, Meta(ge=0, le=1 << 20)] = 0
    """Size of the pictures that each drone takes; 0: none."""
    picture_interval_steps: Annotated[int, Meta(ge=0)] = 0
    """Steps between two pictures of a drone; 0: none, unless `load` sets it."""
    picture_part_bytes: Annotated[int, Meta(ge=1, le=1 << 16)] | None = None
    """Size of the parts into which pictures are cut, as by `put`; null: each is one datum."""
    picture_redundancy: tuple[Count, Count] | None = None
    """[K, N]: any K of N parts of each stripe give it back, and get no replicas; null: all parts are needed."""
    picture_bare: Fraction = 0.0
    """Fraction of the parts that get no replicas, although all are needed."""

    def mistakes(self) -> Iterator[str]:
        """Checks across several keys."""
        if self.picture_part_bytes is None and (self.picture_redundancy or self.picture_bare):
            yield "traffic.picture_part_bytes: expected a number with picture_redundancy or picture_bare, got null"
        if self.picture_redundancy is not None:
            needed, shares = self.picture_redundancy
            if not needed < shares <= 255:
                yield f"traffic.picture_redundancy: expected [K, N] with K below N, got {[needed, shares]}"


class StatisticsSection(Section):
    """How the summary counts."""

    full_items: Count | None = None
    """Data in a drone's store that count as 100 % of its memory; null: `store.capacity_items`."""


class FailureSection(Section):
    """Failures besides radiation. All except `kill_every_s` are for virtual time; see docs/evaluation/simulation.md."""

    kill_every_s: Positive | None = None
    """With the udp transport: seconds between two kills, in each of which SIGKILL ends a drone that is started again;
    null: none."""
    die_fraction: Fraction = 0.0
    """Fraction of the drones, rounded to the nearest number, that die for good, each at a random step of the run."""
    die_rate: Fraction = 0.0
    """Probability that a drone dies for good in a step where the radiation is 1; in proportion where it is less."""
    die_dose: Positive | None = None
    """With `radiation.law` dose: the mean dose at which a drone dies for good, uSv; null: no dose kills."""
    reboot_rate: Fraction = 0.0
    """Probability that a drone reboots in a step: its store stays, the content of its memory is gone."""
    wipe_rate: Fraction = 0.0
    """Probability that a drone loses its store in a step, and comes back with an empty one of a new epoch."""
    reboot_steps: Annotated[int, Meta(ge=0)] = 10
    """How long a reboot takes, with the store or without, steps."""
    battery_steps: tuple[Count, Count] | None = None
    """[low, high]: a drone flies for a number of steps uniform in between, then it lands; null: without limit."""
    recharge_steps: Count | None = None
    """How long a drone that has landed is off, steps; null: for good."""
    blast: Count | None = None
    """At the beginning of this step, the drone that holds the most data which have not arrived dies for good, with all
    drones within its radio range; null: never."""
    base_off: Steps = field(default_factory=list)
    """All bases are off from one step until another, at which they are on again."""
    base_wiped: bool = False
    """Whether bases come back with an empty store of a new epoch."""

    def mistakes(self) -> Iterator[str]:
        """Checks across several keys."""
        if self.battery_steps is not None and self.battery_steps[0] > self.battery_steps[1]:
            yield (f"failures.battery_steps: expected two numbers in ascending order, got {list(self.battery_steps)}")
        if self.recharge_steps is not None and self.battery_steps is None:
            yield "failures.recharge_steps: expected null unless failures.battery_steps is given"
        if self.base_wiped and not self.base_off:
            yield "failures.base_wiped: expected false unless failures.base_off is given"
        yield from wrong_spans("failures.base_off", self.base_off)

    @property
    def of_robots(self) -> list[str]:
        """The keys that are set and make whole robots fail in virtual time."""
        keys = (
            "die_fraction",
            "die_rate",
            "die_dose",
            "reboot_rate",
            "wipe_rate",
            "battery_steps",
            "blast",
            "base_off",
        )
        return [key for key in keys if getattr(self, key)]


#: As many as there are system ids: nodes with keys take nothing from each other if they share one.
MAX_WITH_KEYS = 255


class SwarmSettings(Section):
    """What every simulated swarm has: its nodes' settings, and the air between them."""

    seed: int = 1
    """Seed of all random choices."""
    node: NodeSection = NodeSection()
    policy: PolicySettings = PolicySettings()
    risk: RiskSettings = RiskSettings()
    routing: RoutingSettings = RoutingSettings()
    custody: CustodySettings = CustodySettings()
    store: StoreSettings = StoreSettings()
    data: DataSettings = DataSettings()
    mavlink: MavlinkSettings = MavlinkSettings()
    without: tuple[Mechanism, ...] = ()
    """Mechanisms to leave out in all nodes (docs/evaluation/simulation.md)."""
    radio: RadioSection = RadioSection()

    def settings_of(self, node_id: int, *, base: bool, system_id: int | None, data: DataSettings) -> AgentSettings:
        """The settings of one node. `system_id`: also that of its autopilot; None: it has no autopilot."""
        return AgentSettings.of(
            self, node_id=node_id, base=base, step_s=self.node.step_s, forward=self.node.forward, without=self.without,
            data=data, mavlink=replace(self.mavlink, system_id=system_id, autopilot_id=system_id or 0),
        )  # fmt: skip


class Scenario(SwarmSettings):
    """A mock swarm."""

    title: str = ""
    """One line that says what it is."""
    nodes: Annotated[int, Meta(ge=1, le=60000)] = 100
    """Number of nodes, bases included."""
    bases: Count = 1
    """Number of bases: the nodes with the lowest ids, from 0."""
    steps: Annotated[int, Meta(ge=0)] = 500
    """Length of the run."""
    topology: Literal[
        "grid", "scale-free", "lennard-jones", "random-walk", "line", "islands", "positions", "survey"
    ] = "grid"
    """Where the nodes are, and how they move (docs/evaluation/simulation.md)."""
    arena_m: Positive | None = None
    """Side of the arena, metres; null: 2 m for each node of the grid's side, 20 m for 100 nodes; with
    `mobility.area_m` the longer side of the area."""
    transport: Literal["loopback", "udp"] = "loopback"
    """loopback: virtual time, in one process; udp: real time, one process for each node."""
    mobility: MobilitySection = MobilitySection()
    radiation: RadiationSection = RadiationSection()
    failures: FailureSection = FailureSection()
    traffic: TrafficSection = TrafficSection()
    hostile: list[HostileSection] = field(default_factory=list)
    """Attackers beside the nodes (docs/evaluation/attackers.md). For virtual time."""
    disk: DiskSection | None = None
    """The real store on a simulated disk (docs/contribute/testing.md); null: stores are in memory."""
    keys: bool = False
    """Whether the nodes have the keys of a mission (docs/how-to/keys.md), the same in each run with this seed."""
    statistics: StatisticsSection = StatisticsSection()
    variants: dict[PolicyName, dict[str, dict[str, Any]]] = field(default_factory=dict)
    """Keys that hold only under a policy, by its name: `{hop-count: {data: {interval_steps: 10}}}`. They override the
    file's other keys, and the command's options override them."""

    def mistakes(self) -> Iterator[str]:
        """Checks across several keys."""
        if self.bases >= self.nodes:
            yield f"bases: expected fewer than nodes ({self.nodes}), got {self.bases}"
        if self.topology == "positions":
            given = len(self.mobility.positions or ())
            if given != self.nodes:
                yield f"mobility.positions: expected one [x, y] for each of {self.nodes} nodes, got {given}"
            farthest = max((abs(c) for place in self.mobility.positions or () for c in place), default=0.0)
            if self.arena_m is not None and self.arena_m < 2 * farthest:
                yield f"arena_m: expected at least {2 * farthest:g} with these mobility.positions, got {self.arena_m:g}"
        for index, attacker in enumerate(self.hostile):
            if attacker.near >= self.nodes:
                yield f"hostile[{index}].near: expected a node id below {self.nodes}, got {attacker.near}"
            if attacker.captured and not self.keys:
                yield f"hostile[{index}].captured: expected false without keys"
        if self.transport != "loopback" and self.radio.takes_time:
            yield "radio.air: expected none unless the transport is loopback"
        if self.radiation.strikes_per_step > 1 and self.transport != "loopback":
            yield "radiation.strikes_per_step: expected 1 unless the transport is loopback"
        if self.hostile and self.radio.path_loss is not None:
            yield "hostile: expected no attackers with radio.path_loss"
        if self.hostile and self.transport != "loopback":
            yield "hostile: expected no attackers unless the transport is loopback"
        if self.disk is not None and self.transport != "loopback":
            yield "disk: expected null unless the transport is loopback; processes have the machine's disk"
        if self.disk is not None and self.radiation.corruption:
            yield ("radiation.corruption: expected false with a disk; disk.flip_rate flips bits on the disk")
        if self.keys and self.nodes > MAX_WITH_KEYS:
            yield f"keys: expected false with more than {MAX_WITH_KEYS} nodes, since some share a system id"
        yield from self._field_mistakes()

    def _field_mistakes(self) -> Iterator[str]:
        # A section with a mistake has its defaults here. A line that begins with it is then not told.
        if self.failures.die_rate and self.radiation.law == "dose":
            yield "failures.die_rate: expected 0 with radiation.law dose; failures.die_dose is for doses"
        if self.failures.die_dose is not None and self.radiation.law != "dose":
            yield f"radiation: expected law dose with failures.die_dose, got {self.radiation.law}"
        if self.traffic != TrafficSection() and (self.transport != "loopback" or self.disk is not None):
            yield "traffic: expected its defaults unless the transport is loopback and there is no disk"
        yield from self.traffic.mistakes()
        if self.traffic.load is not None and self.radio.preset is None and not self.radio.takes_time:
            yield "radio: expected a preset or an air that takes time with traffic.load"

    @property
    def arena(self) -> float:
        """Side of the arena, metres."""
        if self.arena_m is not None:
            return self.arena_m
        if self.topology == "survey" and self.mobility.area_m is not None:
            return max(self.mobility.area_m)
        side = 1
        while side * side < self.nodes:
            side += 1
        return 2.0 * side

    def agent_settings(self, node_id: int) -> AgentSettings:
        """The settings of one node."""
        own = system_id(node_id)
        return self.settings_of(node_id, base=node_id < self.bases, system_id=own, data=self.data)


def system_id(node_id: int) -> int:
    """MAVLink system id of a simulated vehicle, 1..255; beyond 255 nodes some share one, as in real life."""
    return node_id % 255 + 1


#: Command line options and the scenario keys that they set.
OPTION_KEYS: dict[str, str] = {
    "nodes": "nodes",
    "steps": "steps",
    "seed": "seed",
    "policy": "policy.name",
    "topology": "topology",
    "range": "radio.range_m",
    "arena": "arena_m",
    "loss": "radio.loss",
    "duplicate": "radio.duplicate",
    "reorder": "radio.reorder",
    "capacity": "store.capacity_items",
    "transport": "transport",
}


S = TypeVar("S", bound=Scenario)

_SHIPPED = Path(__file__).parents[1] / "scenarios"
#: What `swarm` runs without arguments, and with `--transport udp`.
DEFAULT = "demo"
DEFAULT_UDP = "udp-line"


def shipped() -> list[str]:
    """Names of the scenarios that ship with the package."""
    return sorted(path.stem for path in _SHIPPED.glob("*.yaml"))


def find(name: str) -> Path:
    """The file of a scenario, given its path or its name. Raises `ConfigError`."""
    path = Path(name)
    if path.suffix in (".yaml", ".yml") or path.exists():
        return path
    if name in shipped():
        return _SHIPPED / f"{name}.yaml"
    raise ConfigError(f"{name}: neither a file nor one of the scenarios {', '.join(shipped())}")


def load_scenario(name: str, options: dict[str, Any] | None = None, assignments: Sequence[str] = ()) -> Scenario:
    """A scenario with some keys overridden: `options` by key path, then `assignments` (`key.path=value`).

    Raises `ConfigError` with all mistakes; each names the file and the key.
    """
    path = find(name)
    scenario = read_scenario(path, Scenario, options or {}, assignments)
    variant = scenario.variants.get(scenario.policy.name)
    return scenario if variant is None else read_scenario(path, Scenario, options or {}, assignments, variant)


def read_scenario(
    path: Path,
    kind: type[S],
    options: dict[str, Any],
    assignments: Sequence[str],
    variant: dict[str, dict[str, Any]] | None = None,
) -> S:
    """A file, with the keys of the variant, then `options` and `assignments` over it: each goes before those before it.

    Raises `ConfigError` with all mistakes.
    """
    mistakes = Mistakes(path.name)
    raw = read_yaml(path)
    read_old_keys(raw, mistakes, lab=True)
    _override(raw, path, options, variant or {})
    set_keys(raw, assignments, mistakes)
    # What overrides the file may have the old names too.
    read_old_keys(raw, mistakes, lab=True)
    scenario = build_with(raw, kind, mistakes)
    if scenario is not None and mistakes.sound("policy", "custody", "store", "data"):
        with mistakes.gathering():
            scenario.agent_settings(0)
    mistakes.check()
    assert scenario is not None
    return scenario


def _override(raw: dict[str, Any], path: Path, options: dict[str, Any], variant: dict[str, dict[str, Any]]) -> None:
    for section, keys in variant.items():
        raw.setdefault(section, {}).update(keys)
    for key, value in options.items():
        place = raw
        *sections, last = key.split(".")
        for section in sections:
            place = place.setdefault(section, {})
            if not isinstance(place, dict):
                raise ConfigError(f"{path.name}: {section}: expected a section, got {place!r}")
        place[last] = value

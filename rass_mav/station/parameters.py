"""The settings that a ground station may read and set, as MAVLink parameters (docs/how-to/ground-station.md).

A parameter is a 32-bit float on the wire. A value from the ground must satisfy the same rules as one in the
configuration file. The store keeps it together with the file's value at that time. If the file has a different value
at a later start, it was changed since then, and the file wins.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

from rass_mav.agent.settings import AgentSettings
from rass_mav.config.loading import convert, to_plain
from rass_mav.config.sections import Section, under
from rass_mav.core.store import Store
from rass_mav.errors import ConfigError
from rass_mav.mavlink.component import single
from rass_mav.policy.settings import kinds
from rass_mav.wire.measurement import shortest

_PAIR = struct.Struct("<ff")
_META = "param."


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter."""

    name: str
    """1 to 16 ASCII characters."""
    read: Callable[[AgentSettings], float]
    """The value in use."""
    key: str = ""
    """`section.key` of the settings, or the key of a setting outside all sections; empty: it cannot be set."""
    least: float = -math.inf
    """Lowest value that can be set from the ground, in addition to the file's rules."""
    most: float = math.inf
    """Highest value that can be set from the ground."""
    whole: bool = False
    """Whole numbers only."""
    rebirth: bool = False
    """A change starts a new node over the store."""


def _of(section: str, key: str) -> Callable[[AgentSettings], float]:
    return lambda settings: float(getattr(getattr(settings, section), key))


def _weight(name: str) -> Callable[[AgentSettings], float]:
    # The policy's own weight where the settings have none; 0 for a policy without such a weight.
    return lambda settings: float(getattr(settings.policy.make(), name, 0.0))


#: All parameters, in the order of their index. Add new ones at the end.
PARAMETERS: tuple[Parameter, ...] = (
    Parameter("RASS_NODE_ID", lambda settings: settings.node_id),
    Parameter(
        "RASS_POLICY", lambda settings: kinds()[settings.policy.name].number, "policy.name", whole=True, rebirth=True
    ),
    Parameter("RASS_ALPHA", _weight("alpha"), "policy.alpha"),
    Parameter("RASS_BETA", _weight("beta"), "policy.beta"),
    Parameter("RASS_T", _weight("threshold"), "policy.threshold"),
    # Shorter steps leave no time for anything else. With longer ones the node seems dead.
    Parameter("RASS_STEP_S", lambda settings: settings.step_s, "step_s", 0.05, 60.0, rebirth=True),
    Parameter("RASS_RISK_LOW", _of("risk", "low"), "risk.low"),
    Parameter("RASS_RISK_HIGH", _of("risk", "high"), "risk.high"),
    Parameter("RASS_RISK_GAIN", lambda settings: settings.risk.estimator(settings.policy.make()).gain, "risk.gain"),
    Parameter("RASS_RISK_STALE", _of("risk", "stale_s"), "risk.stale_s"),
    Parameter("RASS_RISK_WORST", _of("risk", "worst"), "risk.worst"),
    Parameter("RASS_DATA_STEPS", _of("data", "interval_steps"), "data.interval_steps", 0, 65535, whole=True),
    Parameter("RASS_BANDWIDTH", _of("store", "bandwidth_items"), "store.bandwidth_items", 1, 65535, whole=True),
    # Costs along a route add up, so a routing table built with other costs is useless.
    Parameter("RASS_HOP_COST", _weight("hop_cost"), "policy.hop_cost", rebirth=True),
)
INDEX: dict[str, int] = {parameter.name: index for index, parameter in enumerate(PARAMETERS)}


def changed(
    settings: AgentSettings, parameter: Parameter, value: float, *, unused: Literal["refuse", "keep"] = "refuse"
) -> AgentSettings:
    """The settings with one parameter set.

    :param value: as received, 32 bits.
    :param unused: what to do with a weight that the policy does not have.
    :raises ConfigError: the value is not valid. The message begins with the parameter's name.
    """
    if not parameter.key:
        raise ConfigError(f"{parameter.name}: cannot be set")
    if not math.isfinite(value):
        raise ConfigError(f"{parameter.name}: expected a finite number, got {value}")
    if single(parameter.read(settings)) == value:
        return settings
    new = _replaced(settings, parameter, value)
    with under(parameter.name):
        replicating = [each.policy.name for each in (settings, new) if each.policy.make().replicates]
        if len(replicating) == 1:
            raise ConfigError(f"changes to and from {replicating[0]} only in the configuration file")
    if unused == "refuse" and single(parameter.read(new)) != value:
        raise ConfigError(f"{parameter.name}: policy {new.policy.name} has no such weight")
    return new


def _replaced(settings: AgentSettings, parameter: Parameter, value: float) -> AgentSettings:
    # A weight set from the ground equals the number in another node's file, and their policies agree.
    plain: Any = shortest(value)
    if parameter.whole:
        if not value.is_integer():
            raise ConfigError(f"{parameter.name}: expected a whole number, got {plain:g}")
        plain = int(value)
    if not parameter.least <= plain <= parameter.most:
        raise ConfigError(f"{parameter.name}: expected {parameter.least:g} to {parameter.most:g}, got {plain:g}")
    if parameter.name == "RASS_POLICY":
        names = {kind.number: kind.name for kind in kinds().values()}
        if plain not in names:
            listed = ", ".join(f"{number} {name}" for number, name in names.items())
            raise ConfigError(f"{parameter.name}: expected {listed}; got {plain}")
        plain = names[plain]
    section_name, _, key = parameter.key.rpartition(".")
    if not section_name:
        return replace(settings, **{key: plain})
    section: Section = getattr(settings, section_name)
    try:
        new = convert({**to_plain(section), key: plain}, type(section), parameter.name)
    except ConfigError as error:
        raise ConfigError(*(line.replace(f": {key}: ", ": ", 1) for line in error.mistakes)) from None
    changed: dict[str, Any] = {section_name: new}
    with under(parameter.name):
        return replace(settings, **changed)


def remember(store: Store, configured: AgentSettings, parameter: Parameter, value: float) -> None:
    """Store a value for later starts. It is durable with the store's next commit.

    :param configured: the settings from the file alone.
    """
    pair = _PAIR.pack(single(parameter.read(configured)), value)
    store.set_meta(_META + parameter.name, int.from_bytes(pair, "little", signed=True))


def recall(store: Store, configured: AgentSettings) -> tuple[AgentSettings, list[str]]:
    """The file's settings, with the values set from the ground in earlier lives.

    :returns: the settings, and a text for each value that is no longer valid and was left out.
    """
    waiting: list[tuple[Parameter, float]] = []
    for parameter in PARAMETERS:
        stored = store.get_meta(_META + parameter.name)
        if stored is not None and parameter.key:
            before, value = _PAIR.unpack(stored.to_bytes(8, "little", signed=True))
            if before == single(parameter.read(configured)):
                waiting.append((parameter, value))
    settings = configured
    # A value may be valid only after another: a new low can be above the file's high. So try several times.
    while True:
        errors: list[str] = []
        left: list[tuple[Parameter, float]] = []
        for parameter, value in waiting:
            try:
                settings = changed(settings, parameter, value, unused="keep")
            except ConfigError as error:
                left.append((parameter, value))
                errors += error.mistakes
        if len(left) == len(waiting):
            return settings, errors
        waiting = left

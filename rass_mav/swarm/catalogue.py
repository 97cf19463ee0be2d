"""Finding scenarios: a file, or one that ships with the package."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rass_mav.config.loading import convert, read_yaml, set_key
from rass_mav.config.sections import under
from rass_mav.errors import ConfigError
from rass_mav.swarm.scenario import Scenario

_SHIPPED = Path(__file__).parent / "scenarios"
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

    Raises `ConfigError` that names the file and the key.
    """
    path = find(name)
    scenario = convert(overridden(path, options or {}, assignments), Scenario, path.name)
    variant = scenario.variants.get(scenario.policy.name)
    if variant is not None:
        scenario = convert(overridden(path, options or {}, assignments, variant), Scenario, path.name)
    check_nodes(scenario, path)
    return scenario


def check_nodes(scenario: Scenario, path: Path) -> None:
    """Raise `ConfigError` for settings that are not valid for a node. `path`: of the scenario."""
    with under(path.name):
        settings = scenario.agent_settings(0)
        settings.node_settings()
        settings.policy.make()


def overridden(
    path: Path, options: dict[str, Any], assignments: Sequence[str], variant: dict[str, dict[str, Any]] | None = None
) -> dict[str, Any]:
    """The keys of a file, then of the variant, then `options` and `assignments`: each overrides the ones before."""
    raw = read_yaml(path)
    for section, keys in (variant or {}).items():
        raw.setdefault(section, {}).update(keys)
    for key, value in options.items():
        place = raw
        *sections, last = key.split(".")
        for section in sections:
            place = place.setdefault(section, {})
            if not isinstance(place, dict):
                raise ConfigError(f"{path.name}: {section}: expected a section, got {place!r}")
        place[last] = value
    for assignment in assignments:
        set_key(raw, assignment)
    return raw

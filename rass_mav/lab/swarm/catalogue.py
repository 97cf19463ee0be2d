"""Finding scenarios: a file, or one that ships with the package."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

from rass_mav.config.loading import read_yaml, set_keys
from rass_mav.config.old_keys import read_old_keys
from rass_mav.config.sections import Mistakes
from rass_mav.config.typed import build_with
from rass_mav.errors import ConfigError
from rass_mav.lab.swarm.scenario import Scenario

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

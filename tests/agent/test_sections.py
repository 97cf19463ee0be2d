"""Sections of configurations: what is taken, what is refused, and how."""

from __future__ import annotations

import random
from dataclasses import FrozenInstanceError, replace
from typing import Any

import pytest

from rass_mav.agent.settings import AgentSettings
from rass_mav.app.config import RunConfig
from rass_mav.config.loading import convert, to_plain
from rass_mav.config.sections import Section, fields_of
from rass_mav.core.settings import RiskSettings
from rass_mav.errors import ConfigError
from rass_mav.policy.settings import PolicySettings

VALUES: list[Any] = [
    None, True, False, 0, 1, -1, 7, 300, 70000, 10**400, 0.0, 0.5, -2.5, 1e300, "", "udp", "base", "survival", "auto",
    "logarithmic", "10.0.0.1:14600", "x" * 20, [], [1], [1, 2], ["a"], {}, {"id": 3}, {"address": "a:1"},
    [{"address": "a:1", "id": 3}], {"name": "rass", "alpha": 2}, {"GLOBAL_POSITION_INT": 0.5}, {"bytes_s": 100},
]  # fmt: skip


def configurations(count: int) -> list[dict[str, Any]]:
    """Every key of every section with values that it may take or not, some keys unknown."""
    rng = random.Random(4)
    made: list[dict[str, Any]] = [{}]
    sections: list[tuple[str, list[str]]] = [
        (name, list(keys) if isinstance(keys, dict) else ["x"]) for name, keys in to_plain(RunConfig()).items()
    ]
    link = [field.name for field in fields_of(type(convert({"links": [{}]}, RunConfig, "t").links[0]))]
    while len(made) < count:
        name, keys = rng.choice(sections)
        inner = {rng.choice([*keys, "unknown"]): rng.choice(VALUES) for _ in range(rng.choice([1, 1, 2]))}
        if name == "links":
            inner = {rng.choice([*link, "unknown"]): rng.choice(VALUES) for _ in range(rng.randint(1, 2))}
            made.append({name: [inner]})
        else:
            made.append({name: rng.choice([inner, inner, inner, rng.choice(VALUES)])})
    return made


def test_whatever_a_file_says_it_is_taken_as_it_stands_or_refused_in_words() -> None:
    refused: list[str] = []
    taken = 0
    for raw in configurations(3000):
        try:
            config = convert(raw, RunConfig, "node.yaml")
        except ConfigError as error:
            refused.append(str(error))
            continue
        taken += 1
        plain = to_plain(config)
        assert convert(plain, RunConfig, "node.yaml") == config
        for name, inner in raw.items():
            for key, value in inner.items() if isinstance(inner, dict) else ():
                assert plain[name][key] == value
        changed = replace(config, node=replace(config.node, step_s=0.25))
        assert (changed.node.step_s, changed.risk) == (0.25, config.risk)
    assert len(refused) > 500
    assert taken > 100
    assert all("expected" in said or "unknown key" in said for said in refused)


def test_sections_cannot_be_changed() -> None:
    with pytest.raises(FrozenInstanceError):
        RunConfig().log = RunConfig().log  # type: ignore[misc]


@pytest.mark.parametrize("section", [RunConfig, PolicySettings, RiskSettings])
def test_fields_are_in_the_order_in_which_they_are_written_down(section: type[Section]) -> None:
    assert [field.name for field in fields_of(section)] == list(to_plain(section()))
    assert not any(field.required for field in fields_of(section))


def test_what_has_no_default_is_required() -> None:
    assert [field.name for field in fields_of(AgentSettings) if field.required] == ["node_id"]

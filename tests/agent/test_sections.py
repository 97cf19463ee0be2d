"""Sections are the same with msgspec, which makes Structs of them, and without, where they are dataclasses."""

from __future__ import annotations

import json
import random
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from rass_mav.agent.loading import convert, to_plain
from rass_mav.agent.sections import Section, fields_of, replace
from rass_mav.agent.settings import AgentSettings, PolicySettings, RiskSettings
from rass_mav.app.config import RunConfig
from rass_mav.core.errors import ConfigError

ROOT = Path(__file__).resolve().parents[2]
VALUES: list[Any] = [
    None, True, False, 0, 1, -1, 7, 300, 70000, 10**400, 0.0, 0.5, -2.5, 1e300, "", "udp", "base", "survival", "auto",
    "logarithmic", "10.0.0.1:14600", "x" * 20, [], [1], [1, 2], ["a"], {}, {"id": 3}, {"address": "a:1"},
    [{"address": "a:1", "id": 3}], {"name": "rass", "alpha": 2}, {"GLOBAL_POSITION_INT": 0.5}, {"bytes_s": 100},
]  # fmt: skip

_WITHOUT = """
import dataclasses, json, sys
sys.modules["msgspec"] = None
sys.path.insert(0, "tests/agent")
from test_sections import outcome
from rass_mav.app.config import RunConfig
assert dataclasses.is_dataclass(RunConfig)
import rass_mav.app.run
json.dump([outcome(raw) for raw in json.load(sys.stdin)], sys.stdout)
"""


def outcome(raw: dict[str, Any]) -> Any:
    """What becomes of a configuration: all its values, or what is said of it."""
    try:
        config = convert(raw, RunConfig, "node.yaml")
        changed = replace(config, node=replace(config.node, step_s=0.25))
        return [to_plain(config), to_plain(changed), config == changed, repr(config) == repr(changed)]
    except ConfigError as error:
        return str(error)


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


def test_without_msgspec_the_same_is_taken_and_the_same_is_said() -> None:
    raws = configurations(3000)
    done = subprocess.run(
        [sys.executable, "-c", _WITHOUT], cwd=ROOT, input=json.dumps(raws), capture_output=True, text=True, timeout=60,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    outcomes = [outcome(raw) for raw in raws]
    assert json.loads(done.stdout) == outcomes
    refused = [said for said in outcomes if isinstance(said, str)]
    assert len(refused) > 500
    assert len(outcomes) - len(refused) > 100
    assert all("expected" in said or "unknown key" in said for said in refused)


@pytest.mark.parametrize("section", [RunConfig, PolicySettings, RiskSettings])
def test_fields_are_in_the_order_in_which_they_are_written_down(section: type[Section]) -> None:
    assert [field.name for field in fields_of(section)] == list(to_plain(section()))
    assert not any(field.required for field in fields_of(section))


def test_what_has_no_default_is_required() -> None:
    assert [field.name for field in fields_of(AgentSettings) if field.required][:3] == ["node_id", "base", "step_s"]

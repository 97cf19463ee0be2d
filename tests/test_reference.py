"""The pages of docs/reference that follow from the program are what it gives: `python -m tools.reference`."""

from __future__ import annotations

import json
from typing import Annotated, Any, Literal

import pytest
import yaml

from rass_mav.app.config import RunConfig
from rass_mav.config.sections import Meta, Section
from rass_mav.config.typed import plain
from tools.pages import ROOT
from tools.reference import files, keys

FILES = files()


@pytest.mark.parametrize("name", FILES)
def test_it_is_what_the_program_gives(name: str) -> None:
    assert (ROOT / name).read_text(encoding="utf-8") == FILES[name], "run: python -m tools.reference"


class PartSection(Section):
    """A part."""

    size_m: Annotated[float, Meta(gt=0)] = 2.0


class WholeSection(Section):
    """The whole."""

    mode: Literal["fast", "slow"] | None = None
    """How it goes (docs/how-to/links.md); null: by chance."""
    ids: tuple[Annotated[int, Meta(ge=0, le=7)], ...]
    parts: tuple[PartSection, ...] = ()
    """Its parts."""


def test_a_key_is_one_declaration() -> None:
    assert list(keys(WholeSection, "whole", lambda section, path: None)) == [
        "| key | value | default | meaning |", "|---|---|---|---|",
        "| `mode` | `fast`, `slow`; null | `null` | How it goes ([links.md](../how-to/links.md)); null: by chance. |",
        "| `ids` | list of 0..7 | required |  |",
        "", "### whole.parts[]", "", "Its parts.", "",
        "| key | value | default | meaning |", "|---|---|---|---|", "| `size_m` | number > 0, m | `2` |  |",
    ]  # fmt: skip


def test_every_key_of_a_configuration_has_a_meaning() -> None:
    silent = [line for line in FILES["docs/reference/configuration.md"].splitlines() if line.endswith("|  |")]
    silent += [line for line in FILES["docs/reference/scenarios.md"].splitlines() if line.endswith("|  |")]
    assert silent == []


def test_every_field_of_the_status_has_a_meaning() -> None:
    def silent(schema: dict[str, Any]) -> list[str]:
        found = []
        for name, of in schema.get("properties", {}).items():
            found += [name] * (not of.get("description")) + silent(of.get("items", of))
        return found

    assert silent(json.loads((ROOT / "docs/schemas/status.json").read_text(encoding="utf-8"))) == []


@pytest.mark.parametrize("role", ["drone", "base"])
def test_the_examples_show_the_defaults(role: str) -> None:
    """But for what each swarm has to adapt."""
    shown = yaml.safe_load((ROOT / f"docs/examples/{role}.yaml").read_text(encoding="utf-8"))
    defaults = plain(RunConfig())
    for section in (shown, defaults):
        del section["node"]["id"], section["node"]["role"], section["autopilot"]["url"], section["links"]
    assert shown == defaults

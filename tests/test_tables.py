"""tools/tables.py: the tables and the constants of a node."""

from __future__ import annotations

import re
from itertools import groupby

import pytest

from tools.tables import PACKAGE, Table, constants, tables


def test_every_constant_says_what_it_is() -> None:
    named = [one for one in constants() if not one.name.startswith("MAX_")]
    assert [one.label for one in named if not one.about] == []


def test_where_tuned_constants_stand_is_the_command_that_shows_what_they_are_worth() -> None:
    tuned = {module for module, _ in groupby(one.module for one in constants() if one.kind == "tuned")}
    said = {}
    for file in PACKAGE.rglob("*.py"):
        if found := re.findall(r"^# Tuned: (.*)$", file.read_text(encoding="utf-8"), re.M):
            said[str(file.relative_to(PACKAGE).with_suffix(""))] = found
    names = {module: module.removeprefix("core/").replace("/", ".") for module in tuned}
    assert said == {module: [f"python -m tools.sensitivity {name}"] for module, name in names.items()}


@pytest.mark.no_cover
def test_tables_and_constants_are_found_where_they_are() -> None:
    assert Table("core/custody/journal.py", "Journal", "_entries") in tables()
    found = {one.label: one for one in constants()}
    assert found["core.custody.journal.MAX_ENTRIES"].kind == "bound"
    assert found["core.custody.overheard.PART"].kind == "bound"
    assert found["core.exchange.TRIP_GAIN"].kind == "fact"
    assert found["trust.route_proofs.AHEAD"].kind == "derived"
    patience = found["core.custody.journal.PATIENCE_TIMES"]
    assert (patience.value, patience.kind, patience.about) == (
        "3",
        "tuned",
        found["core.custody.journal.PATIENCE_TURNS"].about,
    )
    assert not any(label.startswith("core.messages") for label in found)

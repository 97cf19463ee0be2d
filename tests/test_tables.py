"""tools/tables.py: the tables and the constants of a node."""

from __future__ import annotations

import pytest

from tools.tables import Table, constants, tables


def test_every_tuned_constant_says_what_it_is() -> None:
    assert [f"{one.module}: {one.name}" for one in constants() if not one.bound and not one.about] == []


@pytest.mark.no_cover
def test_tables_and_constants_are_found_where_they_are() -> None:
    assert Table("core/custody/journal.py", "Journal", "_entries") in tables()
    found = {(one.module, one.name): one for one in constants()}
    assert found["core/custody/journal", "MAX_ENTRIES"].bound
    gain = found["core/custody/journal", "DEVIATION_GAIN"]
    assert (gain.value, gain.bound, gain.about) == ("1 / 8", False, found["core/custody/journal", "TAKES_GAIN"].about)
    assert not any(module.startswith("core/messages") for module, _ in found)

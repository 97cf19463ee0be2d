"""Terms of data are known when a store is opened again, wherever their payloads are."""

from __future__ import annotations

from pathlib import Path

import pytest

from rass_mav.core.datum import TERMS, USUAL, DatumId, Terms, make_datum
from rass_mav.store.quota import BESIDE_BYTES

from .store_helpers import EPOCH, commit, open_store, payload

SEQUENCE_MARK = [Terms(9, 3600), Terms(0), USUAL, Terms(ttl_s=1), USUAL]


@pytest.mark.parametrize("size", [4, 50, 3000, BESIDE_BYTES, 70_000])
def test_a_store_that_is_opened_again_tells_them(tmp_path: Path, size: int) -> None:
    # The last one is cut off: too short for terms, whatever its kind says.
    contents = [terms.pack() + payload(number, size) for number, terms in enumerate(SEQUENCE_MARK[:-1])] + [b"\x09"]
    kinds = [TERMS, TERMS, 1, TERMS, TERMS]
    data = [
        make_datum(DatumId(7, EPOCH, number), kind, 1.5, content)
        for number, (kind, content) in enumerate(zip(kinds, contents, strict=True))
    ]
    with open_store(tmp_path / "node.db") as store:
        for datum in data:
            store.put(datum)
        assert [info.terms for info in store.held()] == SEQUENCE_MARK, "while they wait for the disk"
        commit(store)
        assert [info.terms for info in store.held()] == SEQUENCE_MARK
    with open_store(tmp_path / "node.db") as store:
        assert not store.report.created
        assert [(info.id, info.terms) for info in store.held()] == [
            (datum.id, terms) for datum, terms in zip(data, SEQUENCE_MARK, strict=True)
        ]
        assert [store.get(datum.id) for datum in data] == data

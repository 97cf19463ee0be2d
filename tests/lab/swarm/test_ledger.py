"""Why data count as lost."""

from __future__ import annotations

import pytest

from rass_mav.core.datum import DatumId, Fate, make_datum
from rass_mav.lab.ledger import Ledger

DATUM = make_datum(DatumId(1, 5, 6), 0, 0.0, b"x")


@pytest.mark.parametrize(
    ("fates", "lost"),
    [
        ([Fate.CORRUPTED], Fate.CORRUPTED),
        ([Fate.CORRUPTED, Fate.DIED], Fate.DIED),
        # The node that was believed to have it lost it.
        ([Fate.CORRUPTED, Fate.PASSED_ON], Fate.CORRUPTED),
        # Replicas give way to other data: that alone loses nothing.
        ([Fate.CORRUPTED, Fate.OVERFLOW], Fate.CORRUPTED),
        ([Fate.OVERFLOW, Fate.CORRUPTED, Fate.OVERFLOW], Fate.CORRUPTED),
        ([Fate.DIED, Fate.OVERFLOW, Fate.PASSED_ON], Fate.DIED),
        # A full store without custody drops its oldest datum.
        ([Fate.OVERFLOW], Fate.OVERFLOW),
    ],
)
def test_the_reason_of_a_loss(fates: list[Fate], lost: Fate) -> None:
    ledger = Ledger(custody=True)
    books = [ledger.book(base=False) for _ in fates]
    books[0].created(DATUM)
    for book in books:
        book.gained(DATUM)
    for book, fate in zip(books, fates, strict=True):
        assert not ledger.lost
        book.dropped(DATUM.id, fate)
    assert ledger.lost == {DATUM.id: lost}

"""Who may see the page."""

from __future__ import annotations

import pytest

from rass_mav.page.access import MOST_SESSIONS, Access

TOKEN = "0123456789abcdef"


@pytest.mark.parametrize(
    ("header", "known"),
    [("127.0.0.1:8080", True), ("localhost", True), ("LOCALHOST:1", True), ("[::1]:8080", True),
     ("base.local:80", True), ("10.0.0.7:8080", True), (None, False), ("", False), ("evil.example", False),
     ("evil.example:8080", False), ("127.0.0.1.evil.example", False), ("localhost.evil.example:8080", False),
     ("10.0.0.8", False)],
)  # fmt: skip
def test_only_names_of_this_page_are_known(header: str | None, known: bool) -> None:
    assert Access("0.0.0.0", TOKEN, ["Base.local"]).knows_host(header, "10.0.0.7") is known


@pytest.mark.parametrize(
    ("authorization", "admitted"),
    [(f"Bearer {TOKEN}", True), (f"bearer {TOKEN}", True), (f"Basic {TOKEN}", False), (f"Bearer {TOKEN}x", False),
     ("Bearer", False), ("Bearer ", False), (None, False), ("", False), ("Bearer \udcff", False)],
)  # fmt: skip
def test_the_token(authorization: str | None, admitted: bool) -> None:
    assert Access("127.0.0.1", TOKEN).admits(authorization, None) is admitted
    assert Access("127.0.0.1").admits(authorization, None)


def test_sessions_are_random_end_and_are_not_too_many() -> None:
    access = Access("127.0.0.1", TOKEN)
    first = access.log_in()
    assert access.admits(None, first)
    assert not access.admits(None, first + "x")
    assert not access.admits(None, TOKEN), "the cookie is not the token"
    others = [access.log_in() for _ in range(MOST_SESSIONS)]
    assert len({first, *others}) == MOST_SESSIONS + 1
    assert not access.admits(None, first)
    assert all(access.admits(None, other) for other in others)
    access.log_out(others[0])
    access.log_out(None)
    assert not access.admits(None, others[0])

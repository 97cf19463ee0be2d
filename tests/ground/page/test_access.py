"""Who may see the page."""

from __future__ import annotations

import pytest

from rass_mav.ground.page.access import MOST_SESSIONS, MOST_WRONG, Access, GuessedError

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
    assert Access("127.0.0.1", TOKEN).admits(authorization, None, "10.0.0.9") is admitted
    assert Access("127.0.0.1").admits(authorization, None, "10.0.0.9")


def test_after_some_wrong_tokens_no_other_is_looked_at_for_a_while() -> None:
    now = 0.0
    access = Access("127.0.0.1", TOKEN, now=lambda: now)
    assert access.is_token(TOKEN, "10.0.0.1")
    session = access.log_in()
    for n in range(MOST_WRONG):
        now = float(n)
        assert not access.is_token("guess", f"10.0.0.{n + 2}")
    with pytest.raises(GuessedError, match="try again in 51 s"):
        access.is_token("guess", "10.0.0.9")
    with pytest.raises(GuessedError):
        access.is_token(TOKEN, "10.0.0.9")
    assert access.admits(None, session, "10.0.0.9"), "whoever is logged in stays"
    assert access.admits(f"Bearer {TOKEN}", None, "10.0.0.1"), "and so does a program that had the token before"
    assert not access.admits("Bearer guess", None, "10.0.0.1")
    assert not access.admits(None, None, "10.0.0.9"), "no token is no guess"
    now = 61.5
    assert access.is_token(TOKEN, "10.0.0.9")


def test_the_addresses_that_are_trusted_are_not_too_many() -> None:
    access = Access("127.0.0.1", TOKEN, now=lambda: 0.0)
    for n in range(MOST_SESSIONS + 1):
        assert access.is_token(TOKEN, str(n))
    for _ in range(MOST_WRONG):
        assert not access.is_token("guess", "1")
    with pytest.raises(GuessedError):
        access.is_token(TOKEN, "0")


def test_addresses_have_one_spelling() -> None:
    access = Access("::", TOKEN, ["FD00:0::7"])
    for header in ("[fd00::7]:8080", "[FD00:0:0::7]", "[fe80::1]:80", "[::1]:8080", "[0::1]"):
        assert access.knows_host(header, "fe80:0::1")
    assert not access.knows_host("[fd00::8]:8080", "fe80::1")
    assert access.knows_host("[fe80::1]", "fe80::1%eth0")


@pytest.mark.parametrize(
    "header",
    ["[::1]x.evil", "[::1]x.evil:80", "[::1].evil", "[::1", "[::1]:", "[::1]:80x", "[::1]:80:80", "[::1]]", "[[::1]]",
     "x[::1]", "[127.0.0.1]", "[localhost]", "[]", "::1", "::1:8080", "[::1%lo]", "[::1%25lo]", "[fe80::1%eth0]",
     "localhost:80@evil.example", "localhost:evil.example", "localhost:", "localhost:80:evil", "user@localhost",
     "localhost@evil.example", "localhost/evil", "localhost:80/", "localhost?", "localhost#x", "localhost,evil.example",
     "localhost.", "127.0.0.1.", "127.1", "127.0.1", "2130706433", "0x7f.0.0.1", "0177.0.0.1", "127.0.0.01",
     " localhost", "localhost ", "localhost\t", "localhost\n", "localhost\0", "loc\u0430lhost", "localho\u017ft",
     "\uff4c\uff4f\uff43alhost", "\u212aiosk", "localhost:\u0661", "localhost:123456", "127.0.0.\uff11"],
)  # fmt: skip
def test_what_is_no_host_and_port_is_no_name_of_this_page(header: str) -> None:
    assert not Access("0.0.0.0", TOKEN, ["kiosk"]).knows_host(header, "fe80::1%eth0")


def test_sessions_are_random_end_and_are_not_too_many() -> None:
    access = Access("127.0.0.1", TOKEN)
    first = access.log_in()
    assert access.admits(None, first, "")
    assert not access.admits(None, first + "x", "")
    assert not access.admits(None, TOKEN, ""), "the cookie is not the token"
    others = [access.log_in() for _ in range(MOST_SESSIONS)]
    assert len({first, *others}) == MOST_SESSIONS + 1
    assert not access.admits(None, first, "")
    assert all(access.admits(None, other, "") for other in others)
    access.log_out(others[0])
    access.log_out(None)
    assert not access.admits(None, others[0], "")

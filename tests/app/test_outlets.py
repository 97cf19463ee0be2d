"""The settings of what runs beside a base."""

from __future__ import annotations

from pathlib import Path

import pytest

from rass_mav.app.outlets import PageSection, is_loopback
from rass_mav.errors import ConfigError

TOKEN = "0123456789abcdef"


@pytest.mark.parametrize(
    ("host", "here"),
    [("127.0.0.1", True), ("localhost", True), ("127.8.9.1", True), ("::1", True), ("0.0.0.0", False),
     ("192.168.1.5", False), ("base.local", False), ("localhost.evil.example", False)],
)  # fmt: skip
def test_without_a_token_only_this_computer_may_listen(host: str, here: bool) -> None:
    assert is_loopback(host) is here
    listen = f"[{host}]:8080" if ":" in host else f"{host}:8080"
    PageSection(listen=listen, token_file="token").check()
    if here:
        PageSection(listen=listen).check()
    else:
        with pytest.raises(ConfigError, match=f"{host} is reachable from other computers: add a token file"):
            PageSection(listen=listen).check()


@pytest.mark.parametrize(
    "text", ["", "short", "x" * 15, "x" * 201, "with a blank in it", "\n" + TOKEN, "höchst-geheimes-wort"]
)
def test_what_is_no_token(tmp_path: Path, text: str) -> None:
    path = tmp_path / "token"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match="expected a token on the first line"):
        PageSection(token_file=str(path)).token()


def test_the_first_line_is_the_token(tmp_path: Path) -> None:
    path = tmp_path / "token"
    path.write_text(f"  {TOKEN}\r\nfor the crew\n")
    assert PageSection(token_file=str(path)).token() == TOKEN
    with pytest.raises(ConfigError, match="no such file"):
        PageSection(token_file=str(tmp_path / "missing")).token()
    assert PageSection().token() is None

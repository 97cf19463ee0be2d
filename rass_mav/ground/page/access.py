"""Who may see the page: whoever is on this computer, or has the token."""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import math
import re
import secrets
import time
from collections import deque
from collections.abc import Callable, Iterable
from typing import TypeVar

from rass_mav.errors import RassError

#: Browsers that are logged in at the same time, and addresses from which the right token came; of more, the last ones.
MOST_SESSIONS = 64
#: Wrong tokens in a time, seconds. After so many no token is looked at, except from where the right one came before.
MOST_WRONG, WRONG_S = 10, 60.0
_LOCAL_NAMES = ("localhost", "127.0.0.1", "::1")
# RFC 3986: an IPv6 address in brackets, or a name or an IPv4 address; then a port or none.
_HOST = re.compile(r"(?:\[([0-9a-f:.]*:[0-9a-f:.]*)\]|([a-z0-9._~-]+))(?::[0-9]{1,5})?", re.ASCII | re.IGNORECASE)

T = TypeVar("T")


class GuessedError(RassError):
    """There were too many wrong tokens: the next one is looked at later."""

    def __init__(self, wait_s: float) -> None:
        self.wait_s = math.ceil(wait_s)
        """When, seconds from now."""
        super().__init__(f"too many wrong tokens: try again in {self.wait_s} s")


class Access:
    """Decides about requests."""

    def __init__(
        self, host: str, token: str | None = None, names: Iterable[str] = (),
        now: Callable[[], float] = time.monotonic,
    ) -> None:  # fmt: skip
        """`host`: where the page listens. `names`: by which other names browsers may ask for it. `now`: seconds."""
        self._names = {_plain(name) for name in (*_LOCAL_NAMES, host, *names)}
        self._token = None if token is None else _digest(token)
        self._sessions: dict[bytes, None] = {}
        self._now = now
        self._wrong: deque[float] = deque(maxlen=MOST_WRONG)
        """When the last wrong tokens came."""
        self._trusted: dict[str | None, None] = {}
        """The addresses from which the right token came last."""

    @property
    def needs_token(self) -> bool:
        """Whether there is a token."""
        return self._token is not None

    def knows_host(self, header: str | None, local: str) -> bool:
        """Whether a browser asks for this page, and not for another name that was pointed at this computer.

        `header`: Host; `local`: the address of our end of the connection.
        """
        # `re.IGNORECASE` and `lower` are for ASCII letters only: others do not come this far.
        found = _HOST.fullmatch(header or "")
        if found is None:
            return False
        name = _plain(found[1] or found[2])
        # A browser does not say to which of this computer's networks a link-local address belongs.
        return name in self._names or name == _plain(local.partition("%")[0])

    def admits(self, authorization: str | None, session: str | None, remote: str | None) -> bool:
        """Whether a request has the token, or the cookie of a browser that had it. `remote`: the address from which it
        comes. Raises `GuessedError`."""
        if self._token is None or (session is not None and _digest(session) in self._sessions):
            return True
        scheme, _, given = (authorization or "").partition(" ")
        return scheme.lower() == "bearer" and self.is_token(given.strip(), remote)

    def is_token(self, given: str, remote: str | None) -> bool:
        """Whether this is the token. Takes the same time for each wrong one. Raises `GuessedError`."""
        if self._token is None:
            return False
        now = self._now()
        if remote not in self._trusted and len(self._wrong) == MOST_WRONG:
            # If it were looked at, whoever guesses would learn which one is right.
            wait_s = self._wrong[0] + WRONG_S - now
            if wait_s > 0:
                raise GuessedError(wait_s)
        if not hmac.compare_digest(_digest(given), self._token):
            self._wrong.append(now)
            return False
        self._trusted[remote] = None
        _keep_last(self._trusted)
        return True

    def log_in(self) -> str:
        """A new session, for the cookie."""
        session = secrets.token_urlsafe(32)
        self._sessions[_digest(session)] = None
        _keep_last(self._sessions)
        return session

    def log_out(self, session: str | None) -> None:
        """End a session."""
        if session is not None:
            self._sessions.pop(_digest(session), None)


def _plain(name: str) -> str:
    """A name or an address in one spelling."""
    try:
        return ipaddress.ip_address(name).compressed
    except ValueError:
        return name.lower()


def _keep_last(known: dict[T, None]) -> None:
    while len(known) > MOST_SESSIONS:
        del known[next(iter(known))]


def _digest(text: str) -> bytes:
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).digest()

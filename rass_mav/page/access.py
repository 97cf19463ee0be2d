"""Who may see the page: whoever is on this computer, or has the token."""

from __future__ import annotations

import hashlib
import hmac
import secrets
from collections.abc import Iterable

#: Browsers that are logged in at the same time; of more, the last ones.
MOST_SESSIONS = 64
_LOCAL_NAMES = ("localhost", "127.0.0.1", "::1")


class Access:
    """Decides about requests."""

    def __init__(self, host: str, token: str | None = None, names: Iterable[str] = ()) -> None:
        """`host`: where the page listens. `names`: by which other names browsers may ask for it."""
        self._names = {name.lower() for name in (*_LOCAL_NAMES, host, *names)}
        self._token = None if token is None else _digest(token)
        self._sessions: dict[bytes, None] = {}

    @property
    def needs_token(self) -> bool:
        """Whether there is a token."""
        return self._token is not None

    def knows_host(self, header: str | None, local: str) -> bool:
        """Whether a browser asks for this page, and not for another name that was pointed at this computer.

        `header`: Host; `local`: the address of our end of the connection.
        """
        if not header:
            return False
        name = header.lower()
        if name.startswith("["):
            name = name[1:].partition("]")[0]
        elif name.count(":") <= 1:
            name = name.partition(":")[0]
        return name in self._names or name == local.lower()

    def admits(self, authorization: str | None, session: str | None) -> bool:
        """Whether a request has the token, or the cookie of a browser that had it. Takes the same time for each wrong
        one."""
        if self._token is None:
            return True
        scheme, _, given = (authorization or "").partition(" ")
        if scheme.lower() == "bearer" and self.is_token(given.strip()):
            return True
        return session is not None and _digest(session) in self._sessions

    def is_token(self, given: str) -> bool:
        """Whether this is the token. Takes the same time for each wrong one."""
        return self._token is not None and hmac.compare_digest(_digest(given), self._token)

    def log_in(self) -> str:
        """A new session, for the cookie."""
        session = secrets.token_urlsafe(32)
        self._sessions[_digest(session)] = None
        while len(self._sessions) > MOST_SESSIONS:
            del self._sessions[next(iter(self._sessions))]
        return session

    def log_out(self, session: str | None) -> None:
        """End a session."""
        if session is not None:
            self._sessions.pop(_digest(session), None)


def _digest(text: str) -> bytes:
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).digest()

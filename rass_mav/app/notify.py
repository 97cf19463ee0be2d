"""Tells systemd that the service is ready, works, or stops.

The protocol is a datagram of text to the unix socket that $NOTIFY_SOCKET names (sd_notify(3),
https://www.freedesktop.org/software/systemd/man/latest/sd_notify.html). Without a listener nothing is sent.
"""

from __future__ import annotations

import logging
import math
import socket
from collections.abc import Mapping

log = logging.getLogger(__name__)


class Notifier:
    """Reports the node's state to the service manager. Never blocks and never fails: the node's work comes first."""

    def __init__(self, address: str | None = None, watchdog_s: float | None = None) -> None:
        """:param address: path of a unix datagram socket, or `@name` for an abstract one; None: no listener.
        :param watchdog_s: the service manager kills a node that sends no sign of life for this long; None: never.
        """
        self._address = address
        self._interval = math.inf if watchdog_s is None or address is None else watchdog_s / 2
        self._due = -math.inf
        self._silent = False
        self._socket: socket.socket | None = None

    @classmethod
    def of(cls, environment: Mapping[str, str], pid: int) -> Notifier:
        """From $NOTIFY_SOCKET, $WATCHDOG_USEC and $WATCHDOG_PID (sd_watchdog_enabled(3)). `pid`: this process's."""
        address = environment.get("NOTIFY_SOCKET", "")
        if not address.startswith(("/", "@")):
            return cls()
        period = environment.get("WATCHDOG_USEC", "")
        meant = environment.get("WATCHDOG_PID") in (None, str(pid))
        if not meant or not period.isdecimal() or not int(period):
            return cls(address)
        return cls(address, int(period) / 1e6)

    def ready(self, status: str) -> None:
        """The node runs. `status`: a line for people."""
        self._say(f"READY=1\nSTATUS={status}")

    def stopping(self) -> None:
        """The node is stopping."""
        self._say("STOPPING=1\nSTATUS=stopping: committing pending changes")

    def alive(self, now: float) -> float:
        """The loop that does the work has gone round. Sends a sign of life twice in each period of the watchdog.

        :param now: seconds on any timeline that does not jump.
        :returns: when to call again at the latest, on the same timeline; infinity without a watchdog.
        """
        if now >= self._due and self._interval < math.inf:
            self._due = now + self._interval
            self._say("WATCHDOG=1")
        return self._due if self._interval < math.inf else math.inf

    def close(self) -> None:
        """Send nothing more."""
        self._address = None
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _say(self, text: str) -> None:
        if self._address is None:
            return
        address = "\0" + self._address[1:] if self._address.startswith("@") else self._address
        try:
            if self._socket is None:
                self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
                self._socket.setblocking(False)
            self._socket.sendto(text.encode(), address)
            self._silent = False
        except OSError as error:
            if not self._silent:
                log.warning("cannot report to the service manager: %s", error)
            self._silent = True

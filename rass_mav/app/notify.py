"""What systemd wants to hear of a service: that it is ready, that it works, that it stops.

The protocol is a datagram of text to the unix socket that $NOTIFY_SOCKET names (sd_notify(3),
https://www.freedesktop.org/software/systemd/man/latest/sd_notify.html). Where nobody listens, nothing is said.
"""

from __future__ import annotations

import logging
import math
import socket
from collections.abc import Mapping

log = logging.getLogger(__name__)


class Notifier:
    """Tells the service manager how the node is. Never blocks and never fails: the node's work is more important."""

    def __init__(self, address: str | None = None, watchdog_s: float | None = None) -> None:
        """:param address: path of a unix datagram socket, or `@name` for an abstract one; None: nobody listens.
        :param watchdog_s: the service manager kills the node if it hears no sign of life for so long; None: it waits.
        """
        self._address = address
        self._interval = math.inf if watchdog_s is None or address is None else watchdog_s / 2
        self._due = -math.inf
        self._silent = False
        self._socket: socket.socket | None = None

    @classmethod
    def of(cls, environment: Mapping[str, str], pid: int) -> Notifier:
        """From $NOTIFY_SOCKET, $WATCHDOG_USEC and $WATCHDOG_PID (sd_watchdog_enabled(3)). `pid`: of this process."""
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
        """The node has been told to stop."""
        self._say("STOPPING=1\nSTATUS=stopping: committing what there is")

    def alive(self, now: float) -> float:
        """The loop that does the work has come round. Tells so twice in each period of the watchdog.

        :param now: seconds on any timeline that does not jump.
        :returns: when it should come round again at the latest, on the same timeline; infinity without a watchdog.
        """
        if now >= self._due and self._interval < math.inf:
            self._due = now + self._interval
            self._say("WATCHDOG=1")
        return self._due if self._interval < math.inf else math.inf

    def close(self) -> None:
        """Say nothing more."""
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
                log.warning("the service manager cannot be told how the node is: %s", error)
            self._silent = True

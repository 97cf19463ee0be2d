"""Shows the mission on the maps of TAK: sends Cursor on Target over UDP, TCP or TLS."""

from __future__ import annotations

import asyncio
import contextlib
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from threading import Event as Flag
from typing import Any

from rass_mav.app.outlets import CotSection
from rass_mav.errors import LinkError, why
from rass_mav.ground.archive import Archive
from rass_mav.ground.attention.rules import RuleBook
from rass_mav.ground.attention.watch import as_of
from rass_mav.ground.cot import Event, Picture, deletion
from rass_mav.ground.entry import Opens
from rass_mav.ground.feed import LOOK_S
from rass_mav.ground.follow import Follower

from .task import Task

with warnings.catch_warnings():
    # It misses packages that other ways to a server need.
    warnings.simplefilter("ignore", UserWarning)
    import pytak
    from pytak.asyncio_dgram import TransportClosed

#: What has not changed is sent again after so many seconds, so that clients that come later have it too.
AGAIN_AFTER_S = 30.0
#: Connecting, and sending an event, must be done in this time, seconds.
PATIENCE_S = 5.0
#: So long the last events may take when the connection ends, seconds.
CLOSING_S = 0.5


class CotSender(Task):
    """Follows the base's store, and sends what its data have changed."""

    name = "cot"
    last_s = 1.0
    # It is a picture of now.
    most_again_s = 10.0

    def __init__(
        self, section: CotSection, store: Path, base: int, opens: Opens | None = None, rules: RuleBook | None = None,
        now: Callable[[], float] = time.time,
    ) -> None:  # fmt: skip
        """`base`: the node's id. `opens`: opens sealed data; None: they stay sealed. `rules`: of what needs attention,
        which say where the base is and which contours there are. `now`: the date, seconds since 1970."""
        super().__init__()
        self._section, self._store, self._base, self._opens, self._rules = section, store, base, opens, rules
        self._now = now
        self._follower: Follower[Picture] | None = None
        self._connected = False
        self._sent = 0
        self._shown: dict[str, tuple[Event, float]] = {}
        """What the clients have, by uid, and when it was sent."""

    def report(self) -> dict[str, Any]:
        """For `status`, since the process was started."""
        trouble = self.trouble or ("" if self._follower is None else self._follower.trouble)
        return {
            "url": self._section.url, "connected": self._connected, "sent": self._sent, "trouble": trouble or None,
        }  # fmt: skip

    def work(self, stopping: Flag) -> None:
        """Raises `LinkError`: it cannot be reached; `StoreError`."""
        if self._follower is None:
            # A damaged store is repaired by its node.
            self._follower = Follower(
                lambda: Archive(self._store, salvage=False, opens=self._opens), lambda: Picture(self._base), self._rules
            )
        try:
            asyncio.run(self._serve(self._follower, stopping))
        except (OSError, asyncio.TimeoutError, TransportClosed) as error:
            raise LinkError(f"{self._section.url}: {_why(error)}") from None
        finally:
            self._connected = False

    async def _serve(self, follower: Follower[Picture], stopping: Flag) -> None:
        try:
            reader, writer = await asyncio.wait_for(pytak.protocol_factory(_settings(self._section)), PATIENCE_S)
        except (SyntaxError, ValueError) as error:
            # For files of certificates that it cannot use, and for a server's certificate that it does not believe.
            raise LinkError(f"{self._section.url}: {_why(error)}") from None
        worker = pytak.TXWorker(asyncio.Queue(), {"COT_URL": self._section.url}, writer)
        # A server sends what others report: it is read, so that the connection does not fill up, and thrown away.
        heard = None if reader is None else asyncio.create_task(_drained(reader))
        self._connected, self._shown = True, {}
        self.works()
        try:
            while not stopping.is_set():
                if heard is not None and heard.done():
                    raise LinkError(f"{self._section.url}: the other end has closed the connection")
                follower.look()
                await self._send_changes(follower, worker)
                if not follower.behind:
                    await asyncio.sleep(LOOK_S)
        finally:
            if heard is not None:
                heard.cancel()
            await _close(writer)

    async def _send_changes(self, follower: Follower[Picture], worker: Any) -> None:
        now = self._now()
        # Where the store has no date, its clock says only how old its data are.
        then, _ = as_of(now, follower.date)
        shift_s = 0.0 if follower.date.trusted else now - then
        wanted = {event.uid: event for event in follower.mission.events(now, shift_s)}
        for uid in self._shown.keys() - wanted.keys():
            # A node that is silent stays, as out of date, where it was.
            if not self._shown.pop(uid)[0].type.startswith("a-"):
                await self._send(deletion(uid), worker, now)
        for uid, event in wanted.items():
            known = self._shown.get(uid)
            if known is None or known[0] != event or now - known[1] >= AGAIN_AFTER_S:
                await self._send(event, worker, now)
                self._shown[uid] = event, now

    async def _send(self, event: Event, worker: Any, now: float) -> None:
        await asyncio.wait_for(worker.handle_data(event.xml(now)), PATIENCE_S)
        self._sent += 1


async def _close(writer: Any) -> None:
    """What was sent may still go out, but not for long."""
    writer.close()
    if isinstance(writer, asyncio.StreamWriter):
        with contextlib.suppress(OSError, asyncio.TimeoutError):
            await asyncio.wait_for(writer.wait_closed(), CLOSING_S)
        writer.transport.abort()
    # The loop closes what was ended in its next turn.
    await asyncio.sleep(0)


async def _drained(reader: asyncio.StreamReader) -> None:
    with contextlib.suppress(OSError):
        while await reader.read(1 << 16):
            pass


def _settings(section: CotSection) -> dict[str, str]:
    """As pytak takes them. It would listen at a UDP address that it is not told to write to only."""
    found = {
        "COT_URL": section.url.replace("udp://", "udp+wo://"),
        "PYTAK_TLS_CLIENT_CERT": section.cert_file,
        "PYTAK_TLS_CLIENT_KEY": section.key_file,
        "PYTAK_TLS_CLIENT_CAFILE": section.ca_file,
        "PYTAK_TLS_SERVER_EXPECTED_HOSTNAME": section.server_name,
    }
    return {name: value for name, value in found.items() if value is not None}


def _why(error: Exception) -> str:
    if isinstance(error, asyncio.TimeoutError):
        return f"no answer within {PATIENCE_S:g} s"
    if error.__cause__ is not None:
        return f"{error.__cause__}"
    return why(error) if isinstance(error, OSError) else str(error)

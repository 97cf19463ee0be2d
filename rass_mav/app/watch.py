"""A watched folder: every file in it that is complete is put once (docs/how-to/files.md)."""

from __future__ import annotations

import asyncio
import logging
import os
from collections.abc import Callable
from concurrent.futures import Executor
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from rass_mav.agent.agent import Agent
from rass_mav.core.datum import Kind
from rass_mav.errors import MalformedError, RassError, StoreError, StoreFullError, os_errors_as, why
from rass_mav.mavlink.camera import CAMERA_IMAGE_CAPTURED, Capture, read_capture
from rass_mav.mavlink.frames import Frame

from .driver import Driver
from .files import Files
from .jsonlines import dump_line, load_line
from .payloads import MOST_SMALL, pack_file
from .staging import Staging, in_pieces

log = logging.getLogger(__name__)

T = TypeVar("T")

#: Seconds between two looks at the folder, and until a file for which there is no space is tried again.
LOOK_S = 1.0
FULL_S = 10.0
#: Files that a folder may hold. Nothing is put from one with more.
MOST_FILES = 50_000
#: Pictures of which is known what the camera said.
MOST_CAPTURES = 1024
#: What programs call files that they are still writing.
_UNFINISHED = ("~", ".tmp", ".temp", ".part", ".partial", ".filepart", ".crdownload", ".swp", ".new")


class State(NamedTuple):
    """A file as it is."""

    size: int
    changed_ns: int


class Captures:
    """What the camera has said about its pictures. It listens to the autopilot's port."""

    def __init__(self, agent: Agent) -> None:
        self._agent = agent
        self._captures: dict[str, Capture] = {}

    def hear(self, frame: Frame, now: float) -> None:
        """Take what a camera of the own vehicle says."""
        if frame.message_id != CAMERA_IMAGE_CAPTURED or frame.system_id != self._agent.telemetry.system_id:
            return
        try:
            capture = read_capture(frame)
        except MalformedError:
            return
        self._captures.pop(capture.name, None)
        self._captures[capture.name] = capture
        if len(self._captures) > MOST_CAPTURES:
            del self._captures[next(iter(self._captures))]

    def get(self, name: str) -> Capture | None:
        """The picture with this name of file; None: not heard."""
        return self._captures.get(name)


class Watch:
    """Looks after one folder."""

    def __init__(
        self, folder: Path, settle_s: float, driver: Driver, files: Files, notes: Path, executor: Executor
    ) -> None:
        """`settle_s`: a file is complete when it has not changed for so long, seconds. `notes`: the file with what was
        put. `executor`: one thread, which reads the folder."""
        self._folder = folder
        self._settle_s = settle_s
        self._driver = driver
        self._files = files
        self._notes = notes
        self._executor = executor
        self._captures = Captures(driver.agent)
        driver.agent.listeners.append(self._captures)
        self._done: dict[str, State] = {}
        self._refused: dict[str, State] = {}
        """Files that cannot be read, or put."""
        self._seen: dict[str, tuple[State, float]] = {}
        self._put = 0
        self._trouble = ""

    def report(self) -> dict[str, Any]:
        """For `status`."""
        return {
            "folder": str(self._folder), "put": self._put, "waiting": len(self._seen), "refused": len(self._refused),
            "trouble": self._trouble or None,
        }  # fmt: skip

    async def run(self) -> None:
        """Look after the folder until it is cancelled."""
        await self._aside(self._load)
        while True:
            await asyncio.sleep(await self._look())

    async def _aside(self, call: Callable[..., T], *arguments: Any) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._executor, call, *arguments)

    async def _look(self) -> float:
        """Put what is complete. Returns the seconds until the next look."""
        try:
            found = await self._aside(self._scan)
        except RassError as error:
            self._complain(str(error))
            return FULL_S
        now = asyncio.get_running_loop().time()
        for table in (self._done, self._refused):
            for name in [name for name, state in table.items() if found.get(name) != state]:
                del table[name]
        waiting = {name: state for name, state in found.items() if name not in self._done and name not in self._refused}
        self._seen = {
            name: (state, now if self._seen.get(name, (None,))[0] != state else self._seen[name][1])
            for name, state in waiting.items()
        }
        complete = [name for name, (_, since) in self._seen.items() if now - since >= self._settle_s]
        for name in sorted(complete, key=lambda each: (waiting[each].changed_ns, each)):
            try:
                await self._put_one(name)
            except StoreFullError as error:
                self._complain(f"{error}; the file waits")
                return FULL_S
            except StoreError as error:
                self._complain(str(error))
                return FULL_S
            except RassError as error:
                # It may be readable when it changes, or at the next start.
                log.warning("%s", error)
                self._refused[name] = self._seen.pop(name)[0]
                continue
            self._done[name] = self._seen.pop(name)[0]
            await self._aside(self._remember, name, self._done[name])
            self._put += 1
        self._complain("")
        return LOOK_S

    def _complain(self, trouble: str) -> None:
        if trouble and trouble != self._trouble:
            log.warning("%s: %s", self._folder, trouble)
        self._trouble = trouble

    async def _put_one(self, name: str) -> None:
        """Raises `StoreFullError`: it has to wait; `RassError`: it cannot be put, or changes."""
        capture = self._captures.get(name)
        with closing(await self._aside(lambda: Staging(self._folder / name, follow=False))) as staging:
            about = await self._aside(staging.look)
            if capture is not None and capture.time is not None:
                about = about._replace(time=capture.time)
            place = capture.place if capture is not None and capture.place is not None else None
            place = place or self._files.place_at(about.time)
            if about.size <= MOST_SMALL and (place is None or not about.size):
                payload = pack_file(name, await self._aside(staging.whole))
                if not self._files.has_space(len(payload)):
                    raise StoreFullError(f"{name}: no space in the store")
                await self._driver.put(payload, Kind.FILE)
                return
            draft = await self._files.begin(about, place)
            try:
                pieces = in_pieces(staging.packed(about))
                while piece := await self._aside(next, pieces, b""):
                    await self._files.write(draft, piece)
                await self._files.finish(draft)
            finally:
                self._files.give_up(draft)

    # -- on the executor -----------------------------------------------------------------------------------------------

    def _scan(self) -> dict[str, State]:
        """The plain files of the folder that may be complete. Raises `RassError`."""
        found = {}
        with os_errors_as(RassError, self._folder), os.scandir(self._folder) as entries:
            for entry in entries:
                name = entry.name
                if name.startswith(".") or name.lower().endswith(_UNFINISHED):
                    continue
                try:
                    if not entry.is_file(follow_symlinks=False):
                        continue
                    about = entry.stat(follow_symlinks=False)
                except FileNotFoundError:
                    continue  # it went away meanwhile
                found[name] = State(about.st_size, about.st_mtime_ns)
                if len(found) > MOST_FILES:
                    raise RassError(f"more than {MOST_FILES} files: none is sent until some are removed")
        return found

    def _load(self) -> None:
        """What was put before. A line that the power cut short is of no file."""
        try:
            lines = self._notes.read_bytes().splitlines()
        except FileNotFoundError:
            return
        except OSError as error:
            log.warning("%s: %s; all files of %s will be sent again", self._notes, why(error), self._folder)
            return
        for line in lines:
            try:
                entry = load_line(line)
                self._done[entry["name"]] = State(entry["size"], entry["changed_ns"])
            except (MalformedError, KeyError, TypeError):
                continue
        present: dict[str, State] = {}
        try:
            present = self._scan()
        except RassError:
            return
        # Shorter, for what is there no more is not asked for.
        self._done = {name: state for name, state in self._done.items() if present.get(name) == state}
        draft = self._notes.with_name(f"{self._notes.name}.new")
        try:
            draft.write_bytes(b"".join(_line(name, state) for name, state in self._done.items()))
            draft.replace(self._notes)
        except OSError as error:
            log.warning("%s: %s", draft, why(error))

    def _remember(self, name: str, state: State) -> None:
        try:
            with open(self._notes, "ab") as file:
                # A line that the power cut short ends here.
                file.write(b"\n" * (file.tell() > 0) + _line(name, state))
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            log.warning("%s: %s; %s will be sent again after the next start", self._notes, why(error), name)


def _line(name: str, state: State) -> bytes:
    return dump_line({"name": name, **state._asdict()})

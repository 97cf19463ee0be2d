"""A swarm's computers: each has a disk with a store on it, and power cuts (`disk` in a scenario)."""

from __future__ import annotations

import enum
import random
import weakref
from collections.abc import Container, Sequence

from rass_mav.agent.commits import CommitGate
from rass_mav.agent.outgoing import Outgoing
from rass_mav.agent.settings import AgentSettings
from rass_mav.errors import StoreDamagedError, StoreError
from rass_mav.lab.ledger import Diary, InvariantError, Ledger
from rass_mav.store.sqlite import SqliteStore

from .disk import Disk
from .settings import DiskSection

#: A cut in the middle of a commit comes after fewer file changes than this; some commits make fewer.
CHANGES = 8


class CutMoment(enum.Enum):
    """When the power goes. All except `QUIET` wait for the node's next commit."""

    QUIET = "quiet"
    """Before a turn of the node, between two commits."""
    BEFORE = "before_write"
    DURING = "during_write"
    AFTER = "after_write"
    """The disk has the commit, but nothing that waited for it has left."""


class Computer:
    """One node's disk, store and commit under way."""

    def __init__(self, settings: AgentSettings, rng: random.Random, diary: Diary, seed: int) -> None:
        """`rng`: epochs are drawn from it."""
        self.disk = Disk(random.Random(f"{seed}:disk:{settings.node_id}"))
        self.diary = diary
        self.draws = random.Random(f"{seed}:disk:{settings.node_id}:cuts")
        self.moment: CutMoment | None = None
        """When the power goes next; None: not drawn yet."""
        self._settings = settings
        self._rng = rng
        self._flipped = False
        self._batch: object | None = None
        self._due = 0
        self._retry_at = 0
        self.set_aside = 0
        """Stores that were damaged, and set aside."""
        self.store = self.open()

    def open(self) -> SqliteStore:
        """The power is back: open the store, and record what it has. Raises `StoreError`: not now."""
        self.store = SqliteStore.open(
            self.disk.directory / "node.db",
            node_id=self._settings.node_id,
            draw_epoch=lambda: self._rng.getrandbits(32),
            quota_bytes=self._settings.store.quota_bytes,
            disk=self.disk,
        )
        report = self.store.report
        if report.unwritable:
            # It would stay read-only; this computer starts again when its disk can be written.
            self.store.abandon()
            raise StoreError(f"node {self._settings.node_id}: {report.unwritable}")
        self.set_aside += report.set_aside is not None
        if (report.set_aside is not None or report.closed) and not self._flipped:
            raise InvariantError(f"node {self._settings.node_id}: no bit flipped, but its store is damaged: {report}")
        self.diary.wake(self.store, damaged=self._flipped)
        return self.store

    def shut_down(self) -> None:
        """The power goes, and comes back to a computer that is off."""
        self.disk.cut()
        self.store.abandon()
        self.disk.restart()
        self.moment = None
        self._retry_at = 0

    def wipe(self) -> None:
        """The content of the disk of a computer that is off is gone."""
        for path in self.disk.directory.iterdir():
            path.unlink()
        self.diary.lose_all()

    def flip_bit(self) -> None:
        """A random bit of the database, its log, its large payloads or the log of those flips."""
        names = ("node.db", "node.db-wal", "node.db.payloads", "node.db.partials")
        paths = [self.disk.directory / name for name in names]
        paths = [path for path in paths if path.exists() and path.stat().st_size]
        if paths:
            self.disk.flip_bits(self.draws.choice(paths), 1)
            self._flipped = True

    def commit(self, gate: CommitGate, t: int, steps: int) -> Sequence[Outgoing]:
        """Begin or end a commit that takes `steps` steps. Returns what may leave now.

        Raises `StoreError` if the power goes, or the store is damaged; a write that just fails is tried again.
        """
        if not gate.committing:
            if t < self._retry_at:
                return ()
            self._batch = gate.begin()
            self.diary.begin()
            self._due = t + steps
        if self._batch is not None:
            if t < self._due:
                return ()
            try:
                self._write(self._batch)
            except StoreError as error:
                if self.moment is not None or self.disk.off or isinstance(error, StoreDamagedError):
                    raise
                self._retry_at = t + 1
                gate.failed(error)
                return ()
        self.diary.done()
        return gate.written()

    def _write(self, batch: object) -> None:
        moment = self.moment
        if moment is CutMoment.BEFORE:
            raise StoreError("the power went before the write")
        if moment is CutMoment.DURING:
            self.disk.cut(after=self.draws.randrange(CHANGES))
        self.store.write(batch)
        if moment is not None:
            raise StoreError("the power went after the write")


class Power:
    """The computers of a swarm, the faults of their disks, and how often their power was cut."""

    def __init__(self, settings: DiskSection, ledger: Ledger, *, seed: int, off_steps: int) -> None:
        """`off_steps`: how long a computer whose power was cut is off; at least until the next step."""
        self.settings = settings
        self.off_steps = max(off_steps, 1)
        self.computers: list[Computer] = []
        # By moment; None: its disk failed while it was read, or was damaged, so that it started again.
        self._failed: dict[CutMoment | None, int] = dict.fromkeys([*CutMoment, None], 0)
        self._ledger = ledger
        self._seed = seed
        self.close = weakref.finalize(self, _close, self.computers)
        """Removes the disks, also when this object or the program ends."""

    def add(self, settings: AgentSettings, rng: random.Random) -> Computer:
        """The next node's computer, with an empty store."""
        diary = Diary(self._ledger, base=settings.base)
        self.computers.append(Computer(settings, rng, diary, self._seed))
        return self.computers[-1]

    def begin_step(self, t: int, off: Container[int]) -> list[int]:
        """Apply the disk faults of this step. Returns the nodes whose power goes now, in a quiet moment."""
        settings = self.settings
        quiet = []
        for node_id, computer in enumerate(self.computers):
            disk, draws = computer.disk, computer.draws
            disk.full, disk.read_only = (
                any(begin <= t < end for begin, end in windows) for windows in (settings.full, settings.read_only)
            )
            disk.error_rate = settings.error_rate
            for _ in range(int(settings.flip_rate + draws.random())):
                computer.flip_bit()
            if draws.random() < settings.cut_rate and node_id not in off and computer.moment is None:
                computer.moment = draws.choice(list(CutMoment))
                if computer.moment is CutMoment.QUIET:
                    quiet.append(node_id)
        return quiet

    def fail(self, node_id: int) -> None:
        """A computer goes off: its power was cut, or its disk failed."""
        computer = self.computers[node_id]
        self._failed[computer.moment] += 1
        computer.shut_down()

    def figures(self) -> dict[str, int]:
        """For the summary."""
        return {
            "cuts": sum(self._failed[moment] for moment in CutMoment),
            **{"restarts" if moment is None else moment.value: count for moment, count in self._failed.items()},
            "set_aside": sum(computer.set_aside for computer in self.computers),
        }


def _close(computers: list[Computer]) -> None:
    for computer in computers:
        computer.disk.cut()
        computer.store.abandon()
        computer.disk.close()

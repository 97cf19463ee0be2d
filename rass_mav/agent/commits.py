"""The commit gate: commit, THEN send. No input, output or time: whoever drives a node writes, and says how it went.

What is said while a commit is under way is covered by the next one. When a commit fails, all that it covered waits for
the next one, whose batch holds the same changes again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from rass_mav.agent.outgoing import Outgoing
from rass_mav.core.store import Store
from rass_mav.errors import RassError

#: Frames that may wait for a commit.
MAX_WAITING = 2048


class CommitGate:
    """Holds back what rests on changes that are not on disk yet. At most one commit is under way."""

    def __init__(self, store: Store) -> None:
        """`store`: of the node whose frames these are; one that is driven has no other gate."""
        self._store = store
        # What waits for the next commit, and for the one that is under way.
        self._held: list[Outgoing] = []
        self._covered: list[Outgoing] = []
        self._asked: list[Callable[[RassError | None], None]] = []
        self._told: list[Callable[[RassError | None], None]] = []
        self.committing = False
        """Whether a batch is on its way to the disk."""
        self.commits = 0
        """Commits done."""
        self.failures = 0
        """Commits that failed; each was, or will be, tried again."""
        self.dropped = 0
        """Frames dropped because too many waited for a commit that failed, or was slow."""

    @property
    def idle(self) -> bool:
        """Whether a commit would do nothing: everything is on disk, and nothing waits."""
        return not (self._held or self._covered or self._asked or self._store.unwritten)

    @property
    def waiting(self) -> int:
        """Frames that wait for a commit."""
        return len(self._held) + len(self._covered)

    def say(self, frames: Sequence[Outgoing]) -> Sequence[Outgoing]:
        """What the node says. Returns what may leave now, in the same order; the rest waits for the next commit."""
        if self.idle:
            return frames
        now = []
        for outgoing in frames:
            if not outgoing.promises:
                now.append(outgoing)
            elif self.waiting < MAX_WAITING:
                self._held.append(outgoing)
            else:
                self.dropped += 1
        return now

    def ask(self, tell: Callable[[RassError | None], None]) -> None:
        """Be told when all that has changed up to now is on disk (None), or that a commit has failed before."""
        self._asked.append(tell)

    def begin(self, *, force: bool = False) -> object | None:
        """Begin a commit. Returns the batch that is to be written; None: nothing is, and `written` may be called.

        `force`: also for changes that would wait for company. RuntimeError while the last commit is under way.
        """
        if self.committing:
            raise RuntimeError("the last commit has neither been written nor failed")
        batch = self._store.take(force=force)
        self.committing = batch is not None
        self._covered, self._held = self._covered + self._held, []
        self._told, self._asked = self._asked, []
        return batch

    def written(self) -> Sequence[Outgoing]:
        """All that has been begun is on disk. Returns what may leave now."""
        self.commits += self.committing
        self.committing = False
        covered, self._covered = self._covered, []
        told, self._told = self._told, []
        for tell in told:
            tell(None)
        return covered

    def failed(self, error: RassError) -> None:
        """The batch could not be written: what it covered waits for the next commit. All who asked are told."""
        self.failures += 1
        self.committing = False
        self.give_up(error)

    def roll_back(self, error: RassError) -> None:
        """Drop what the store has changed since the last `begin`, and what waits for that; who asked since is told.

        What has been begun goes on, with all that it covers, whether it is under way or has failed.
        """
        self._store.roll_back()
        self._held = []
        asked, self._asked = self._asked, []
        for tell in asked:
            tell(error)

    def give_up(self, error: RassError) -> None:
        """Nobody who asked need wait any longer."""
        told, self._told, self._asked = self._told + self._asked, [], []
        for tell in told:
            tell(error)

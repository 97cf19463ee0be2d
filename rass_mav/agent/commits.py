"""The commit gate: commit, THEN send. No input, output or time: the driver writes, and reports the result.

A frame sent while a commit is in progress waits for the next commit. When a commit fails, everything it covered waits
for the next one, whose batch contains the same changes again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from rass_mav.agent.outgoing import Outgoing
from rass_mav.core.store import Store
from rass_mav.errors import RassError

#: Frames that may wait for a commit.
MAX_WAITING = 2048


class CommitGate:
    """Holds back frames that depend on changes not yet on disk. At most one commit is in progress."""

    def __init__(self, store: Store) -> None:
        """`store`: the store of the node that sends the frames. A driven node has exactly one gate."""
        self._store = store
        # Frames that wait for the next commit, and for the one in progress.
        self._held: list[Outgoing] = []
        self._covered: list[Outgoing] = []
        self._asked: list[Callable[[RassError | None], None]] = []
        self._asked_covered: list[Callable[[RassError | None], None]] = []
        self.committing = False
        """Whether a batch is being written."""
        self.commits = 0
        """Commits done."""
        self.failures = 0
        """Failed commits. Each is tried again."""
        self.dropped = 0
        """Frames dropped because too many waited for a failed or slow commit."""

    def is_idle(self) -> bool:
        """Whether a commit would do nothing: everything is on disk, and nothing waits."""
        return not (self._held or self._covered or self._asked or self._store.unwritten)

    @property
    def waiting(self) -> int:
        """Frames that wait for a commit."""
        return len(self._held) + len(self._covered)

    def say(self, frames: Sequence[Outgoing]) -> Sequence[Outgoing]:
        """Take the node's frames. Returns those that may leave now, in order. The rest wait for the next commit."""
        if self.is_idle():
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
        """Call `tell` when all changes up to now are on disk (with None), or with the error if a commit fails first."""
        self._asked.append(tell)

    def begin(self, *, force: bool = False) -> object | None:
        """Begin a commit. Returns the batch to write. None: there is nothing to write; call `written` at once.

        `force`: also write changes that would otherwise wait to share a commit. Raises RuntimeError while the last
        commit is in progress.
        """
        if self.committing:
            raise RuntimeError("the last commit is still in progress")
        batch = self._store.take(force=force)
        self.committing = batch is not None
        self._covered, self._held = self._covered + self._held, []
        self._asked_covered, self._asked = self._asked, []
        return batch

    def written(self) -> Sequence[Outgoing]:
        """The commit is on disk. Returns the frames that may leave now."""
        self.commits += self.committing
        self.committing = False
        covered, self._covered = self._covered, []
        asked, self._asked_covered = self._asked_covered, []
        for tell in asked:
            tell(None)
        return covered

    def failed(self, error: RassError) -> None:
        """The batch could not be written. Its frames wait for the next one; each `ask` gets the error."""
        self.failures += 1
        self.committing = False
        self.give_up(error)

    def roll_back(self, error: RassError) -> None:
        """Drop the store's changes since the last `begin`, and the frames that depend on them.

        Every `ask` since then is answered with the error. The commit that was begun continues with its frames, whether
        it is in progress or has failed.
        """
        self._store.roll_back()
        self._held = []
        asked, self._asked = self._asked, []
        for tell in asked:
            tell(error)

    def give_up(self, error: RassError) -> None:
        """Answer every open `ask` with the error."""
        asked, self._asked_covered, self._asked = self._asked_covered + self._asked, [], []
        for tell in asked:
            tell(error)

"""Which data of a store an export writes: for the command and for the page."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator

from .demands import counted
from .entry import ALL, Data, Entry, Filter
from .formats import Format


class Selection:
    """The data that somebody wants, without those that no file can hold."""

    def __init__(self, wanted: Filter = ALL) -> None:
        self._wanted = wanted
        self.sealed = self.parts = 0
        """How many of these data are sealed, or parts of files: they were left out."""

    def of(self, entries: Iterable[Entry]) -> Iterator[Entry]:
        """These data of all."""
        singly = self._wanted.kinds == {"part"}
        for entry in entries:
            if not self._wanted.admits(entry):
                continue
            # Parts are in their files.
            if entry.part is not None and not singly:
                self.parts += 1
            elif entry.sealed:
                self.sealed += 1
            else:
                yield entry

    def reasons(self, why: Counter[str], name: str, format: Format) -> str:
        """What was left out, sealed data included, for people. `why`: `Exported.left_out`; `name`: of the format."""
        said = counted(why + Counter({"sealed: --keys opens them": self.sealed}))
        return f"{said} ({name} holds {format.holds})" if why else said

    def nothing(self, why: Counter[str], name: str, format: Format, data: Data) -> str:
        """Why nothing was written, for people; as for `reasons`."""
        parts = Counter({"parts of files: --kind part": self.parts})
        none = "no data match the options" if data.count() else "the store holds no data"
        return self.reasons(why + parts, name, format) or none

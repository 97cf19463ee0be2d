"""Files that are put: taken whole into the spool, then created as data of the store, one by one (docs/how-to/files.md).

A file is put when the spool has it. Its data are created as the store has space, with the number of the last one in the
same commit. So after whatever end of the program the node continues with the next.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, field
from typing import Any, TypeVar

from rass_mav.agent.agent import VehicleService
from rass_mav.core.datum import TERMS_SIZE, DatumId, Kind
from rass_mav.core.messages import INLINE_BYTES
from rass_mav.errors import DatumError, StoreDamagedError, StoreError, StoreFullError
from rass_mav.store.disk import space
from rass_mav.store.quota import ROW_OVERHEAD
from rass_mav.wire.file import PART_HEAD, Cut, Manifest, Part, cut_file, encode_manifest, encode_part

from .driver import Driver
from .spool import MOST_WAITING, Draft, Spool, Spooled
from .staging import About
from .track import Track

log = logging.getLogger(__name__)

T = TypeVar("T")

#: Files of which `status` tells how far they are; of more, the latest. And files of which the node remembers it when
#: all their data are created.
MOST_TOLD, MOST_KNOWN = 64, 1024
#: The smallest part that is worth its head, bytes.
LEAST_PART = 1024
#: The largest part, bytes. On a slow link a part that is not across when drones lose sight of each other has to wait
#: (docs/evaluation/air.md, "Pictures over SiK"): there it is what the node may send in so many turns, but at least the
#: third number.
USUAL_PART, PART_TURNS, SLOW_PART = 1 << 15, 20, 1 << 12
# The store keeps under these: the number of the last file whose manifest was created; the number of the file whose
# other data are being created, with the index from which on they are missing in the lower bits.
_ANNOUNCED, _PLACE = "file.manifest", "file.part"
_BITS = 32


@dataclass
class Progress:
    """How far a file is."""

    manifest: Manifest
    id: DatumId | None = None
    """Of its manifest, in this run."""
    begun: int = 0
    """Data that were created before this run."""
    made: dict[int, int] = field(default_factory=dict)
    """The sequence numbers of those created in this run, by index."""
    damaged: bool = False
    """Whether the others can never be created."""


class Files(VehicleService):
    """The files of a node. Also a service of its agent, which is called once a step."""

    def __init__(self, driver: Driver, spool: Spool, part_bytes: int | None, executor: Executor, track: Track) -> None:
        """`part_bytes`: of a part at most; None: as the link allows. `executor`: one thread, for the spool. `track`:
        where the node was."""
        self._driver = driver
        self._spool = spool
        self._part_bytes = part_bytes
        self._executor = executor
        self.place_at = track.place_at
        self._coming: list[Cut] = []
        """Of the files that are being taken: space is kept for them."""
        self._drafts: set[Draft] = set()
        self._wake = asyncio.Event()
        self._reported: dict[int, Progress] = {}
        spool.number_after(max(self._place[0], self._announced))
        driver.agent.services.append(self)

    # -- taking files --------------------------------------------------------------------------------------------------

    async def begin(
        self, about: About, place: tuple[float, float, float] | None = None, redundancy: tuple[int, int] | None = None
    ) -> Draft:
        """Begin to take a file. `place`: where it was made; None: where the node was then. `redundancy`: K and N.

        Raises `StoreFullError`: there is no space for it; `StoreError`, `DatumError`.
        """
        node = self._driver.agent.node
        most = min(self._most_part, node.most_put - PART_HEAD - TERMS_SIZE)
        if most < LEAST_PART:
            raise DatumError(f"{about.name}: too large: under this policy a datum holds {node.most_put} bytes")
        if not about.size:
            raise DatumError(f"{about.name}: empty, so it cannot be split")
        cut = cut_file(about.size, about.length, about.digest, about.packing, most, redundancy)
        self._admit(about.name, cut)
        manifest = Manifest(cut, about.name, about.size, about.digest, about.time, place or self.place_at(about.time))
        # Before anything is waited for, or two files could be promised the same space.
        self._coming.append(cut)
        try:
            draft = await self._aside(self._spool.draft, manifest, about.terms)
        except BaseException:
            self._coming.remove(cut)
            raise
        self._drafts.add(draft)
        return draft

    @property
    def _most_part(self) -> int:
        if self._part_bytes is not None:
            return self._part_bytes
        in_time = PART_TURNS * self._driver.agent.node.pace.items * INLINE_BYTES
        # A power of two: the same file, cut in the same way again, is the same data.
        return min(USUAL_PART, max(SLOW_PART, 1 << in_time.bit_length() - 1))

    def _admit(self, name: str, cut: Cut) -> None:
        """Raises `StoreFullError` if the data of one more file would not fit the store's quota, or the disk, and
        `DatumError` if they never will."""
        if len(self._spool.waiting) + len(self._coming) >= MOST_WAITING:
            raise StoreFullError(f"{name}: {MOST_WAITING} files are already waiting")
        store, bound = self._driver.agent.store, self._driver.agent.settings.store.quota_bytes
        more, waiting = self._cost(cut), self._waiting()
        if bound is not None and more > bound:
            raise DatumError(f"{name}: quota of {bound} bytes, but {more} are needed; nothing was submitted")
        quota = store.quota_bytes
        if quota is not None and store.used_bytes + waiting + more > quota:
            raise StoreFullError(
                f"{name}: quota of {quota} bytes: {store.used_bytes} are in use, {waiting} are waiting to be "
                f"stored, {more} more do not fit; nothing was submitted"
            )
        # Until its last part is stored, it is there twice.
        free = space(self._spool.folder.parent).usable
        if 2 * more + waiting > free:
            raise StoreFullError(
                f"{name}: the disk has {free} bytes free, but {2 * more + waiting} are needed; nothing was submitted"
            )

    def _cost(self, cut: Cut, begun: int = 0) -> int:
        """Bytes of the store for the data of a file, without the first `begun`."""
        each = TERMS_SIZE + PART_HEAD + self._driver.agent.node.seals.added + ROW_OVERHEAD
        return max(0, cut.total() - begun * cut.part_bytes) + max(0, cut.data() - begun) * each

    def _waiting(self) -> int:
        number, index = self._place
        taken = sum(
            self._cost(file.manifest.cut, index if file.number == number else 0)
            for file in self._spool.waiting.values()
        )
        return taken + sum(map(self._cost, self._coming))

    async def write(self, draft: Draft, data: bytes) -> None:
        """The next bytes. Raises `StoreError`."""
        await self._aside(draft.write, data)

    async def finish(self, draft: Draft) -> DatumId:
        """Take a file. Returns the id of its manifest when all is on disk. Raises `StoreError`: no part of it was put,
        or it is kept, and its manifest written as soon as possible."""
        spooled = await self._aside(self._spool.take, draft)
        self._spool.waiting[spooled.number] = spooled
        self._forget(draft)
        self._wake.set()
        try:
            self._announce()
        except StoreFullError:
            await self._remove(spooled)
            raise
        await self._driver.writer.durable()
        id = self._tell(spooled).id
        assert id is not None
        return id

    def give_up(self, draft: Draft) -> None:
        """Leave nothing of a file that was not finished."""
        if draft in self._drafts:
            self._forget(draft)
            draft.give_up()

    def _forget(self, draft: Draft) -> None:
        self._drafts.discard(draft)
        self._coming.remove(draft.manifest.cut)

    async def _remove(self, spooled: Spooled) -> None:
        del self._spool.waiting[spooled.number]
        await self._aside(spooled.delete)

    async def _aside(self, call: Callable[..., T], *arguments: Any) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._executor, call, *arguments)

    # -- creating data -------------------------------------------------------------------------------------------------

    @property
    def _announced(self) -> int:
        return self._driver.agent.store.get_meta(_ANNOUNCED) or 0

    @property
    def _place(self) -> tuple[int, int]:
        """The file whose data are being created, and the index from which on they are missing."""
        return divmod(self._driver.agent.store.get_meta(_PLACE) or 0, 1 << _BITS)

    async def run(self) -> None:
        """Create the data of the files that wait, until it is cancelled. Raises `StoreDamagedError`."""
        while True:
            self._wake.clear()
            try:
                busy = await self._go_on()
            except StoreDamagedError:
                raise
            except StoreError as error:
                log.warning("%s", error)
                busy = False
            if not busy:
                await self._wake.wait()

    def step(self, now: float) -> None:
        """There may be space now."""
        if self._spool.waiting:
            self._wake.set()

    async def _go_on(self) -> bool:
        """Create the next datum of the first file that waits. False: there is none, or no space. `StoreError`."""
        spooled = next(iter(self._spool.waiting.values()), None)
        if spooled is None:
            return False
        cut = spooled.manifest.cut
        number, index = self._place
        if spooled.number < number or (spooled.number == number and index >= cut.end):
            # Its last datum is on disk, or this place would not be.
            await self._driver.writer.durable()
            await self._remove(spooled)
            return True
        if spooled.number > self._announced:
            if not self.has_space(len(encode_manifest(spooled.manifest))):
                return False
            self._announce()
        else:
            index = index if spooled.number == number else 0
            if not self.has_space(PART_HEAD + cut.size(index)):
                return False
            try:
                content = await self._aside(spooled.read, index)
            except StoreError as error:
                self._spool.set_aside(spooled.number, spooled.path, str(error))
                self._tell(spooled).damaged = True
                return True
            if self.has_space(PART_HEAD + cut.size(index)):
                self._create(spooled, index, content)
        await self._driver.writer.durable()
        return True

    def has_space(self, size: int) -> bool:
        """Whether a datum may be created. On a drone files take no more than half of the store, so that there is space
        for measurements."""
        agent = self._driver.agent
        node, store = agent.node, agent.store
        holdings, size = node.holdings, size + TERMS_SIZE + node.seals.added
        if not (store.accepting and store.room_for(size - holdings.replica_bytes)):
            return False
        if node.sink:
            return True
        items, most = holdings.capacity_items, node.settings.store.capacity_bytes
        half_free = (items is None or 2 * (len(holdings.custody) + 1) <= items) and (
            most is None or 2 * (holdings.custody_bytes + size) <= most
        )
        return holdings.room_for(size, own=True) and (half_free or not holdings.custody)

    def _announce(self) -> None:
        """Create the manifests of all files that were taken. Raises `StoreError`."""
        for spooled in self._spool.waiting.values():
            if spooled.number > self._announced:
                self._tell(spooled).id = self._driver.create(
                    encode_manifest(spooled.manifest), Kind.MANIFEST, spooled.terms
                )
                self._driver.agent.store.set_meta(_ANNOUNCED, spooled.number)

    def _create(self, spooled: Spooled, index: int, content: bytes) -> None:
        """Create the datum of an index. Raises `StoreError`."""
        cut = spooled.manifest.cut
        kind = Kind.SHARE if cut.needed else Kind.PART
        id = self._driver.create(encode_part(Part(cut, index, content)), kind, spooled.terms)
        following = next((after for after in range(index + 1, cut.end) if cut.size(after)), cut.end)
        self._driver.agent.store.set_meta(_PLACE, spooled.number << _BITS | following)
        self._tell(spooled).made[index] = id.sequence

    # -- progress ------------------------------------------------------------------------------------------------------

    def _tell(self, spooled: Spooled) -> Progress:
        """The progress of a file. One of an earlier run may have data already."""
        progress = self._reported.get(spooled.number)
        if progress is None:
            number, index = self._place
            begun = (
                sum(1 for each in range(index) if spooled.manifest.cut.size(each)) if spooled.number == number else 0
            )
            progress = self._reported[spooled.number] = Progress(spooled.manifest, begun=begun)
            for number in [each for each in self._reported if each not in self._spool.waiting][:-MOST_KNOWN]:
                del self._reported[number]
        return progress

    def report(self) -> list[dict[str, Any]]:
        """For `status`: the files that are under way, or were at last, the oldest first."""
        waiting = list(self._spool.waiting.values())[:MOST_TOLD]
        reported = {spooled.number: self._tell(spooled) for spooled in waiting}
        others = [each for each in self._reported.items() if each[0] not in self._spool.waiting]
        reported.update(others[max(0, len(others) + len(reported) - MOST_TOLD) :])
        losses = {id for id, _ in self._driver.agent.store.losses()} if reported else set()
        return [self._plain(progress, losses) for _, progress in sorted(reported.items())]

    def progress(self, id: DatumId) -> dict[str, int] | None:
        """How far the file of a manifest is, as far as is known: how many `data` are needed, and how many of them have
        `arrived` or are `lost`. None: it is of no file."""
        node = self._driver.agent.node
        receipts = node.receipts
        file = next((each for each in self._reported.values() if each.id == id), None)
        if file is None:
            return None
        arrived, lost = int(node.sink or id in receipts), int(receipts.is_reported_lost(id))
        cut = file.manifest.cut
        ids = {index: id._replace(sequence=made) for index, made in file.made.items()}
        gone = {index for index, each in ids.items() if receipts.is_reported_lost(each)}
        may_come = ids if file.damaged else cut.indexes()
        return {
            "data": 1 + cut.parts,
            "arrived": arrived + cut.enough(index for index, each in ids.items() if node.sink or each in receipts),
            "lost": lost + cut.parts - cut.enough(index for index in may_come if index not in gone),
        }

    def _plain(self, progress: Progress, losses: set[DatumId]) -> dict[str, Any]:
        """`losses`: those that this node has not handed over yet."""
        node, manifest = self._driver.agent.node, progress.manifest
        ids = [DatumId(node.id, node.store.epoch, sequence) for sequence in progress.made.values()]
        receipts = node.receipts
        lost = {id for id in ids if receipts.is_reported_lost(id) or (id in losses and id not in receipts)}
        return {
            "name": manifest.name,
            "id": None if progress.id is None else str(progress.id),
            "size": manifest.size,
            "parts": manifest.cut.data(),
            "created": progress.begun + len(ids),
            "handed_over": sum(id not in node.holdings.custody and id not in lost for id in ids),
            "arrived": sum(node.sink or id in receipts for id in ids) if node.sink or receipts.active else None,
            "lost": len(lost),
            "damaged": progress.damaged,
        }

"""The time lived: over restarts, power cuts and jumps of the date, ages stay true or are said to be lower bounds."""

from __future__ import annotations

import asyncio
import math
import random
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rass_mav.app.clock import NOTE_S, DateNote, LivedClock, TimeSources, boot_number, boot_time, synchronised
from rass_mav.app.driver import Driver
from rass_mav.core.datum import DatumId, make_datum
from rass_mav.station.node import build_node
from rass_mav.store.memory import MemoryStore
from rass_mav.store.reader import SqliteReader
from rass_mav.store.sqlite import SqliteStore
from tests.extent import examples
from tests.patience import PATIENCE_S

from .app_drivers import Stepped
from .app_drivers import settings as about

YEAR_S = 365.25 * 86400.0
#: Notes count microseconds; each restart may round by so much.
ROUNDING_S = 1e-5


class Computer:
    """A computer with a date of its own: `true` is what an onlooker's watch says."""

    def __init__(self) -> None:
        self.true = 1.7e9
        self.boot = 1
        self.booted = self.true
        self.error = 0.0
        """By how much its date is wrong; trusted means right."""
        self.trusted = True

    def sources(self) -> TimeSources:
        return TimeSources(
            elapsed=lambda: self.true - self.booted,
            boot=lambda: self.boot,
            wall=lambda: self.true + self.error,
            trusted=lambda: self.trusted,
        )

    def off(self, seconds: float) -> None:
        """Without power for a while."""
        self.true += seconds
        self.boot += 1
        self.booted = self.true

    def date(self, error: float | None) -> None:
        """Somebody sets the date wrong (and the kernel says so), or a time server right (None)."""
        self.error, self.trusted = (0.0, True) if error is None else (error, False)


class Life:
    """A node's data and their ages, from life to life on one computer; each datum with its true time of creation."""

    def __init__(self, computer: Computer, store: MemoryStore | None = None) -> None:
        self.computer = computer
        self.store = store or MemoryStore(5)
        self.born: dict[DatumId, float] = {}
        self.clock = LivedClock(self.store, computer.sources())

    def put(self) -> None:
        id = DatumId(7, 5, self.store.next_sequence())
        self.born[id] = self.computer.true
        self.store.put(make_datum(id, 0, self.clock.now(), b"x"))
        self.clock.note()  # the commit

    def live(self, seconds: float) -> None:
        """Steps of a second or more, no more than a hundred."""
        for _ in range(100):
            self.computer.true += seconds / 100
            self.clock.tend(bool(self.born))

    def hear_date(self, error: float = 0.0) -> bool:
        """The autopilot says the date, which is wrong by so much. Returns whether ages have changed."""
        self.clock.hear_date(self.computer.true + error, self.clock.now())
        return self.clock.tend(bool(self.born))

    def restart(self) -> None:
        self.clock = LivedClock(self.store, self.computer.sources())
        self.clock.tend(bool(self.born))  # with the first step

    def ages(self) -> dict[DatumId, tuple[float, bool]]:
        """Age and whether it may be more."""
        now = self.clock.now()
        return {info.id: (now - info.created, info.at_least) for info in self.store.held()}

    def only(self) -> tuple[float, bool]:
        """The same of the only datum, to the millisecond."""
        [(age_s, at_least)] = self.ages().values()
        return round(age_s, 3), at_least


_SECONDS = st.floats(0.0, 3 * YEAR_S)
_DEEDS = st.one_of(
    st.tuples(st.just("live"), st.floats(0.0, 100 * NOTE_S)),
    st.tuples(st.just("put"), st.none()),
    st.tuples(st.just("stop and start"), _SECONDS),
    st.tuples(st.just("kill and start"), st.floats(0.0, 1000.0)),
    st.tuples(st.just("power cut"), _SECONDS),
    st.tuples(st.just("stop and power off"), _SECONDS),
    st.tuples(st.just("date"), st.none() | st.floats(-20 * YEAR_S, 20 * YEAR_S)),
    st.tuples(st.just("gps"), st.none()),
)


@pytest.mark.no_cover
@settings(max_examples=examples(300), deadline=None)
@given(st.lists(_DEEDS, max_size=25))
def test_whatever_the_date_does_an_age_is_true_or_a_lower_bound_that_never_falls(
    deeds: list[tuple[str, float | None]],
) -> None:
    computer = Computer()
    life = Life(computer)
    life.put()
    restarts = 0
    vague: set[DatumId] = set()
    """What was a lower bound before this life."""
    for deed, much in deeds:
        before = life.ages()
        off_known = life.clock.off_known
        unnoted = NOTE_S * 1.02
        if deed == "live":
            life.live(much or 0.0)
        elif deed == "put":
            life.put()
        elif deed == "date":
            computer.date(much)
        elif deed == "gps":
            life.hear_date()
        else:
            restarts += 1
            vague = {id for id, (_, at_least) in before.items() if at_least}
            if deed.startswith("stop"):
                life.clock.note()
                unnoted = 0.0
            if "power" in deed:
                computer.off(much or 0.0)
            else:
                computer.true += much or 0.0
                unnoted = 0.0
            life.restart()
            off_known = life.clock.off_known
        learnt = life.clock.off_known and not off_known
        slack = ROUNDING_S * (restarts + 1)
        for id, (old, at_least) in life.ages().items():
            lived = computer.true - life.born[id]
            assert 0.0 <= old <= lived + slack, "nothing is older than it is, so nothing expires early"
            if not at_least:
                assert old == pytest.approx(lived, abs=slack)
            if id in before:
                # A power cut takes off what was not noted, if the date cannot tell it.
                assert old >= before[id][0] - slack - (unnoted if at_least else 0.0)
                assert at_least >= before[id][1] or (learnt and id not in vague), "a lower bound stays one"


def test_a_date_corrected_after_the_start_ages_nothing() -> None:
    computer = Computer()
    computer.date(-5 * YEAR_S)
    life = Life(computer)
    life.put()
    life.live(100.0)
    computer.date(None)
    assert life.only() == (100.0, False)
    life.clock.note()
    computer.off(10.0)
    life.restart()
    assert life.only() == (110.0, False), "the note was taken by a right date"
    computer.date(3 * YEAR_S)
    life.clock.note()
    computer.off(10.0)
    computer.date(None)
    life.restart()
    assert life.only() == (110.0, True), "the last note was taken by a wrong one"


def test_a_restart_of_the_program_alone_needs_no_date() -> None:
    computer = Computer()
    computer.date(-5 * YEAR_S)
    life = Life(computer)
    life.put()
    computer.true += 1000.0
    life.restart()
    assert life.clock.off_known
    assert life.only() == (1000.0, False)


def test_a_right_date_that_goes_back_is_not_believed() -> None:
    computer = Computer()
    life = Life(computer)
    life.put()
    computer.off(10.0)
    computer.error = -1000.0
    life.restart()
    assert not life.clock.off_known
    assert life.only() == (0.0, True)


@pytest.mark.parametrize(
    "dates", [[1e9, 1.7e9], [1.7e9, math.inf], [1.7e9, -math.inf], [1.7e9, math.nan], [1.7e9, 1e300]]
)
def test_a_store_without_notes_begins_at_its_newest_datum(dates: list[float]) -> None:
    store = MemoryStore(5)
    for sequence, created in enumerate(dates):
        store.put(make_datum(DatumId(7, 5, sequence), 0, created, b"x"))
    life = Life(Computer(), store)
    assert life.clock.now() == pytest.approx(1.7e9)
    assert not life.clock.off_known
    assert all(info.at_least for info in store.held())


def test_a_flipped_bit_in_one_row_does_not_move_the_time() -> None:
    life = Life(Computer())
    life.put()
    life.store.put(make_datum(DatumId(7, 5, 1), 0, 1e15, b"x"))
    life.restart()
    assert life.clock.now() < 1.0


def test_notes_are_few() -> None:
    life = Life(Computer())
    noted = 0

    def count(note: Callable[[], None] = life.clock.note) -> None:
        nonlocal noted
        noted += 1
        note()

    life.clock.note = count  # type: ignore[method-assign]
    life.live(1000.0)
    assert noted == 0, "nothing is held"
    life.put()
    life.live(1000.0)
    assert noted <= 1 + 1000.0 / NOTE_S + 1


def test_a_store_at_rest_tells_dates(tmp_path: Path) -> None:
    computer = Computer()
    with SqliteStore.open(tmp_path / "n.db", node_id=7, draw_epoch=lambda: 5) as store:
        clock = LivedClock(store, computer.sources())
        computer.true += 50.0
        store.put(make_datum(DatumId(7, 5, store.next_sequence()), 0, clock.now(), b"x"))
        computer.true += 25.0
        clock.note()
    with SqliteReader(tmp_path / "n.db") as reader:
        [info] = reader.held()
        assert info.created + DateNote.of(reader.meta()).offset_s == pytest.approx(computer.true - 25.0)
    assert DateNote.of({}).offset_s == 0.0


def test_this_computer_tells_its_time() -> None:
    assert 0.0 < boot_time() <= boot_time()
    assert 0 <= boot_number() == boot_number() < 1 << 63
    assert synchronised() in (True, False)


async def test_commits_bring_the_time_and_the_time_brings_no_commits(tmp_path: Path) -> None:
    computer = Computer()

    async def life(steps: int, put: int) -> tuple[int, list[float]]:
        """Steps of a node, with data put. Returns how many commits there were, and the ages of what it had at first."""
        with (
            SqliteStore.open(tmp_path / "n.db", node_id=7, draw_epoch=lambda: 5) as store,
            ThreadPoolExecutor(1) as executor,
        ):
            clock = LivedClock(store, computer.sources())
            ages = [clock.now() - info.created for info in store.held()]
            agent = build_node(about(7), store, random.Random(1), now=clock.now())
            driver = Driver(agent, [], None, clock.now, executor, lived=clock)
            stepped = Stepped(agent)
            task = asyncio.create_task(driver.run())
            for number in range(put):
                await driver.put(bytes([number + 1]), 0)
            await stepped.until(lambda: agent.steps >= steps)
            computer.true += 5.0
            driver.stop()
            await asyncio.wait_for(task, PATIENCE_S)
            return driver.writer.gate.commits, ages

    commits, _ = await life(steps=2, put=3)
    assert commits <= 2 * 3 + 2
    computer.off(100.0)
    computer.date(-YEAR_S)
    commits, ages = await life(steps=10, put=0)
    assert ages == [pytest.approx(5.0, abs=ROUNDING_S)] * 3, "the stop was noted, the time off is unknown"
    assert commits <= 3, "the first step, the end, and what else the node keeps"
    computer.true += 100.0
    _, ages = await life(steps=1, put=0)
    assert ages == [pytest.approx(110.0, abs=ROUNDING_S)] * 3

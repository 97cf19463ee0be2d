"""The date from the autopilot: it tells how long a node was off, or it is ignored; no datum becomes too old."""

from __future__ import annotations

import asyncio
import logging
import random
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from rass_mav.app.clock import AMEND_S, DISAGREE_S, MOST_OFF_S, DateNote, LivedClock
from rass_mav.app.driver import Driver
from rass_mav.core.datum import Datum, DatumId, Fate, make_datum
from rass_mav.lab.swarm.autopilot import autopilot_heartbeat
from rass_mav.mavlink.dialect import common
from rass_mav.mavlink.frames import FrameWriter
from rass_mav.station.node import build_node
from rass_mav.store.reader import SqliteReader
from rass_mav.store.sqlite import SqliteStore
from tests.patience import PATIENCE_S

from .app_drivers import Stepped
from .app_drivers import settings as about
from .test_clock import ROUNDING_S, YEAR_S, Computer, Life

OFF_S = 1000.0


def without_date() -> Computer:
    """A computer whose date is wrong for good: a Pi without a network."""
    computer = Computer()
    computer.true = computer.booted = 1.8e9
    computer.date(-5 * YEAR_S)
    return computer


def after_a_power_cut(off_s: float = OFF_S) -> Life:
    """A node whose last note has the date from GPS, and whose one datum is 10 s old but for the time off."""
    life = Life(without_date())
    life.hear_date()
    life.put()
    life.computer.true += 10.0
    life.clock.note()
    life.computer.off(off_s)
    life.restart()
    assert not life.clock.off_known
    assert life.only() == (10.0, True)
    return life


def warnings(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.message for record in caplog.records if record.levelno >= logging.WARNING]


@pytest.mark.parametrize("later_s", [0.0, 30.0, AMEND_S - 1.0])
def test_a_date_that_comes_late_tells_the_time_off(later_s: float) -> None:
    life = after_a_power_cut()
    life.live(later_s)
    assert life.hear_date()
    assert life.only() == (10.0 + OFF_S + later_s, False)
    assert life.clock.off_known
    assert life.clock.trusted
    assert not life.clock.tend(True), "once in a life"


def test_the_time_server_tells_it_too() -> None:
    life = after_a_power_cut()
    life.computer.true += 100.0
    life.computer.date(None)
    assert life.clock.tend(True)
    assert life.only() == (10.0 + OFF_S + 100.0, False)


def test_a_date_that_comes_too_late_tells_nothing() -> None:
    life = after_a_power_cut()
    life.live(AMEND_S + 1.0)
    assert not life.hear_date()
    assert life.only() == (10.0 + AMEND_S + 1.0, True)
    assert not life.clock.off_known


def test_a_note_with_gps_counts_at_the_next_start() -> None:
    life = Life(without_date())
    life.hear_date()
    life.put()
    life.computer.off(OFF_S)
    life.computer.date(None)
    life.restart()
    assert life.clock.off_known
    assert life.only() == (OFF_S, False)


def test_after_an_untrusted_note_nothing_tells_the_time_off() -> None:
    life = Life(without_date())
    life.put()
    life.computer.off(OFF_S)
    life.restart()
    assert not life.hear_date()
    assert life.only() == (0.0, True)


def test_the_date_that_is_noted_is_that_of_gps() -> None:
    life = Life(without_date())
    life.put()
    note = DateNote.of(life.store._meta)
    assert not note.trusted
    life.hear_date()
    life.clock.note()
    note = DateNote.of(life.store._meta)
    assert note.trusted
    assert note.lived_s + note.offset_s == pytest.approx(life.computer.true)


def test_a_second_date_changes_no_age_again() -> None:
    life = after_a_power_cut()
    assert life.hear_date()
    assert not life.hear_date(DISAGREE_S - 1.0)
    assert life.only() == (10.0 + OFF_S, False)
    assert life.clock.trusted


@pytest.mark.parametrize("jump_s", [-YEAR_S, -DISAGREE_S - 1.0, DISAGREE_S + 1.0, YEAR_S])
def test_an_autopilot_that_contradicts_itself_is_not_believed(jump_s: float, caplog: pytest.LogCaptureFixture) -> None:
    life = after_a_power_cut()
    life.clock.hear_date(life.computer.true, life.clock.now())
    for error in (jump_s, 0.0, jump_s):
        assert not life.hear_date(error), "and ages remain as they are"
    assert not life.clock.trusted
    assert len(warnings(caplog)) == 1
    life.clock.note()
    assert not DateNote.of(life.store._meta).trusted
    assert life.only() == (10.0, True)
    # The computer's date counts as ever.
    life.computer.date(None)
    assert life.clock.tend(True)
    assert life.only() == (10.0 + OFF_S, False)


@pytest.mark.parametrize("error", [-OFF_S - 1.0, MOST_OFF_S, 73 * YEAR_S])
def test_an_impossible_time_off_is_ignored(error: float, caplog: pytest.LogCaptureFixture) -> None:
    life = after_a_power_cut()
    for _ in range(3):
        assert not life.hear_date(error)
    assert life.only() == (10.0, True)
    assert not life.clock.off_known
    [warning] = warnings(caplog)
    assert "cannot have been off" in warning


@pytest.mark.parametrize("error", [-DISAGREE_S - 1.0, DISAGREE_S + 1.0])
def test_a_synchronised_computer_knows_better(error: float, caplog: pytest.LogCaptureFixture) -> None:
    life = Life(Computer())
    life.put()
    for _ in range(3):
        life.hear_date(error)
        life.clock.note()
    note = DateNote.of(life.store._meta)
    assert note.trusted
    assert note.lived_s + note.offset_s == pytest.approx(life.computer.true)
    [warning] = warnings(caplog)
    assert "synchronised" in warning


def test_gps_that_agrees_with_the_computer_is_noted() -> None:
    life = Life(Computer())
    life.put()
    life.hear_date(2.0)
    life.clock.note()
    note = DateNote.of(life.store._meta)
    assert note.lived_s + note.offset_s == pytest.approx(life.computer.true + 2.0)


def test_only_what_this_start_made_uncertain_changes() -> None:
    life = Life(without_date())
    store, ids = life.store, [DatumId(9, 5, sequence) for sequence in range(6)]

    def put(id: DatumId, age_s: float, at_least: bool) -> None:
        store.put(make_datum(id, 0, life.clock.now() - age_s, b"x")._replace(at_least=at_least))

    for id in ids[:4]:
        put(id, 1.0, False)
    put(ids[4], 1.0, True)
    life.hear_date()
    life.clock.note()
    life.computer.off(OFF_S)
    life.restart()
    life.computer.true += 5.0
    store.remove(ids[1], Fate.PASSED_ON)  # handed over
    store.remove(ids[2], Fate.PASSED_ON)  # handed over, and back with the age that the neighbour counts
    put(ids[2], 6.5, True)
    store.remove(ids[3], Fate.PASSED_ON)  # the same, from a neighbour that knows it
    put(ids[3], 1006.0, False)
    put(ids[5], 2.0, True)  # a neighbour's
    assert life.hear_date()
    assert {id.sequence: (round(age_s, 3), at_least) for id, (age_s, at_least) in life.ages().items()} == {
        0: (1006.0, False), 2: (6.5, True), 3: (1006.0, False), 4: (6.0, True), 5: (2.0, True),
    }  # fmt: skip


def test_nothing_to_change_is_no_change() -> None:
    life = after_a_power_cut()
    [id] = life.born
    life.store.remove(id, Fate.PASSED_ON)
    assert not life.hear_date()
    assert life.clock.off_known


# -- on a disk ---------------------------------------------------------------------------------------------------------

IDS = [DatumId(7, 5, sequence) for sequence in range(3)]


def opened(directory: Path) -> SqliteStore:
    return SqliteStore.open(directory / "n.db", node_id=7, draw_epoch=lambda: 5)


def cut_off(directory: Path, computer: Computer) -> None:
    """A node with three data goes without power, after a note with the date from GPS."""
    with opened(directory) as store:
        clock = LivedClock(store, computer.sources())
        clock.hear_date(computer.true, clock.now())
        for id in IDS:
            assert store.next_sequence() == id.sequence
            store.put(make_datum(id, 0, clock.now(), bytes([1 + id.sequence])))
        computer.true += 10.0
        clock.note()
    computer.off(OFF_S)


def ages(store: SqliteStore, clock: LivedClock) -> list[tuple[float, bool]]:
    data = [datum for id in IDS if (datum := store.get(id)) is not None]
    infos = {info.id: (info.created, info.at_least) for info in store.held()}
    assert infos == {datum.id: (datum.created, datum.at_least) for datum in data}
    assert all(datum.intact for datum in data)
    return [(round(clock.now() - datum.created, 3), datum.at_least) for datum in data]


@pytest.mark.parametrize("cut", ["before the batch", "before the write", "after the write"])
def test_a_power_cut_between_the_change_and_its_commit(tmp_path: Path, cut: str) -> None:
    computer = without_date()
    cut_off(tmp_path, computer)
    store = opened(tmp_path)
    clock = LivedClock(store, computer.sources())
    clock.note()
    store.write(store.take())
    computer.true += 20.0
    clock.hear_date(computer.true, clock.now())
    assert clock.tend(True)
    known, vague = [(OFF_S + 30.0, False)] * 3, [(30.0, True)] * 3
    assert ages(store, clock) == known
    assert store.unwritten
    if cut != "before the batch":
        clock.note()
        batch = store.take()
        assert ages(store, clock) == known
        if cut == "after the write":
            store.write(batch)
            assert ages(store, clock) == known
    store.abandon()
    computer.boot += 1
    computer.booted = computer.true
    with opened(tmp_path) as store:
        clock = LivedClock(store, computer.sources())
        written = cut == "after the write"
        # Without the commit, the last note on the disk is the one before the date was known.
        assert ages(store, clock) == ([(OFF_S + 30.0, True)] * 3 if written else [(10.0, True)] * 3)
        clock.hear_date(computer.true, clock.now())
        assert clock.tend(True) is written
        assert ages(store, clock) == (known if written else [(age_s - 20.0, at_least) for age_s, at_least in vague])


def test_what_is_not_written_yet_is_changed_with_the_rest(tmp_path: Path) -> None:
    """Rows on the disk, a datum in the batch that is being written, and one that waits for the next."""
    with opened(tmp_path) as store:
        for id in IDS:
            store.put(make_datum(id, 0, 100.0, b"x"))
            if id != IDS[2]:
                batch = store.take()
            if id == IDS[0]:
                store.write(batch)
        store.amend(IDS, 25.0)
        expected = dict.fromkeys(IDS, 75.0)
        assert {info.id: info.created for info in store.held()} == expected
        store.write(batch)
        store.put(make_datum(IDS[1], 0, 90.0, b"x"))
        expected = {IDS[0]: 75.0, IDS[2]: 75.0, IDS[1]: 90.0}
        assert {info.id: info.created for info in store.held()} == expected
    with SqliteReader(tmp_path / "n.db") as reader:
        assert {info.id: info.created for info in reader.held()} == expected


def test_a_change_that_is_rolled_back_is_forgotten(tmp_path: Path) -> None:
    computer = without_date()
    cut_off(tmp_path, computer)
    with opened(tmp_path) as store:
        clock = LivedClock(store, computer.sources())
        clock.hear_date(computer.true, clock.now())
        assert clock.tend(True)
        store.roll_back()
        assert ages(store, clock) == [(10.0, True)] * 3


# -- in a running node -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("held", [True, False])
async def test_a_running_node_learns_the_ages_from_its_autopilot(tmp_path: Path, held: bool) -> None:
    computer = without_date()
    cut_off(tmp_path, computer)
    with opened(tmp_path) as store, ThreadPoolExecutor(1) as executor:
        clock = LivedClock(store, computer.sources())
        if not held:
            for id in IDS:
                store.remove(id, Fate.PASSED_ON)
        agent = build_node(about(7), store, random.Random(1), now=clock.now())
        driver = Driver(agent, [], None, clock.now, executor, lived=clock)
        before = agent.node
        autopilot = FrameWriter(9, 1)
        task = asyncio.create_task(driver.run())
        computer.true += 20.0
        for message in (
            autopilot_heartbeat(),
            common.MAVLink_system_time_message(0, 1000),
            common.MAVLink_system_time_message(round(computer.true * 1e6), 2000),
        ):
            agent.vehicle_bytes(autopilot.message(message), clock.now())
        await Stepped(agent).until(lambda: clock.off_known)
        assert (agent.node is before) is not held, "a new node only if an age has changed"
        for id in IDS if held else ():
            holding = agent.node.holdings.get(id)
            assert holding is not None
            assert clock.now() - holding.created == pytest.approx(OFF_S + 30.0, abs=ROUNDING_S)
        driver.stop()
        await asyncio.wait_for(task, PATIENCE_S)
    with SqliteReader(tmp_path / "n.db") as reader:
        data: list[Datum] = [datum for id in reader.ids() if (datum := reader.get(id)) is not None]
        note = DateNote.of(reader.meta())
    assert note.trusted
    assert len(data) == (3 if held else 0)
    for datum in data:
        assert not datum.at_least
        assert datum.created + note.offset_s == pytest.approx(computer.true - OFF_S - 30.0, abs=1e-3)

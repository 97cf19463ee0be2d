"""What the ground is told when a node lacks something for long: seldom, and once for each change."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import pytest

from rass_mav.lab.swarm.autopilot import local_position_ned
from rass_mav.mavlink.frames import FrameWriter
from rass_mav.station.shortages import AGAIN_S, BACK_S, NO_BASE_S, NO_POSITION_S, NO_READING_S, Shortages

from .field import BASE, DRONE, Field

WARNING, INFO = 4, 6
STALE_S = 10.0
NOTHING = "RASS: no measurements: no position, no reading"


def watched(trouble: str = "", interval_steps: int = 0) -> Field:
    field = Field(data={"interval_steps": interval_steps})
    field.drone.services.append(Shortages(field.drone, 0.0, position=True, reading=True, trouble=lambda: trouble))
    return field


def lose_base(field: Field, lost: bool) -> None:
    field.silent = {BASE} if lost else set()


def lose_fix(field: Field, lost: bool) -> None:
    field.fix = not lost


def lose_reading(field: Field, lost: bool) -> None:
    field.reading = None if lost else 0.5


CASES = [
    (
        lose_base,
        NO_BASE_S,
        "RASS: no base in reach for 120 s, data wait here",
        "RASS: base 1 in reach again",
    ),
    (
        lose_fix,
        NO_POSITION_S,
        "RASS: no position for 60 s, none in new data",
        "RASS: position available again",
    ),
    (
        lose_reading,
        NO_READING_S,
        "RASS: no radiation reading, worst risk assumed",
        "RASS: radiation readings available again",
    ),
]
#: It takes so long until what is not heard any more is not known any more.
FORGOTTEN_S = STALE_S + 5.0


@pytest.mark.no_cover
@pytest.mark.parametrize(("lose", "after_s", "missing", "back"), CASES)
def test_the_ground_is_told_when_it_has_been_missing_for_long_and_when_it_is_back(
    lose: Callable[[Field, bool], None], after_s: float, missing: str, back: str
) -> None:
    field = watched()
    field.until(30.0)
    lose(field, True)
    field.until(30.0 + after_s)
    assert field.told() == [], "not yet"
    field.until(30.0 + after_s + FORGOTTEN_S)
    [(_, severity, text)] = field.texts
    assert (severity, text) == (WARNING, missing)
    assert len(text) <= 50, "one STATUSTEXT"
    field.until(field.now + 2 * AGAIN_S)
    assert field.told() == [missing], "once, however long it lasts"
    lose(field, False)
    field.until(field.now + BACK_S - 3.0)
    assert field.told() == []
    field.until(field.now + 30.0)
    [(_, severity, text)] = field.texts
    assert (severity, text) == (INFO, back)
    assert len(text) <= 50
    field.until(field.now + AGAIN_S)
    assert field.told() == [back]


@pytest.mark.no_cover
@pytest.mark.parametrize(("lose", "after_s", "missing", "back"), CASES)
def test_what_is_missing_only_now_and_then_is_not_told(
    lose: Callable[[Field, bool], None], after_s: float, missing: str, back: str
) -> None:
    field = watched()
    field.until(600.0, lambda: lose(field, field.now % after_s < after_s / 2))
    assert field.told() == []


@pytest.mark.no_cover
@pytest.mark.parametrize(("lose", "after_s", "missing", "back"), CASES)
def test_what_comes_and_goes_slowly_is_told_no_more_than_once_in_a_while(
    lose: Callable[[Field, bool], None], after_s: float, missing: str, back: str
) -> None:
    field = watched()
    period = after_s + 2 * (FORGOTTEN_S + BACK_S)
    field.until(6 * period, lambda: lose(field, field.now % period < after_s + FORGOTTEN_S))
    times = [at for at, _, text in field.texts if text == missing]
    assert len(times) >= 2
    assert min(later - at for at, later in pairwise(times)) >= AGAIN_S
    words = [text for _, _, text in field.texts]
    assert all(text != other for text, other in pairwise(words)), "in turns"


def test_from_the_start_on_it_is_missing() -> None:
    field = watched("the cable is loose")
    field.silent = {BASE}
    field.autopilot = False
    field.until(NO_BASE_S + 1.0)
    assert field.told() == [
        "RASS: no radiation reading, worst risk assumed: th",
        "e cable is loose",
        NOTHING,
        "RASS: no base in reach for 120 s, data wait here",
    ]


def lose_autopilot(field: Field, lost: bool) -> None:
    field.autopilot = not lost


def created(field: Field) -> int:
    """How many data of the drone there are, with it or at the base."""
    return len({*field.drone.store.ids(), *field.base.store.ids()})


def test_nothing_is_measured_that_would_say_nothing() -> None:
    """A node whose autopilot has died would fill its store, until it has a position or a reading again."""
    field = watched(interval_steps=1)

    field.until(30.0)
    assert created(field) == 30
    lose_autopilot(field, True)
    field.until(30.0 + STALE_S)
    assert created(field) == 30 + STALE_S, "what was heard last is still of use"
    field.until(600.0)
    assert created(field) == 30 + STALE_S
    assert field.told() == ["RASS: no radiation reading, worst risk assumed", NOTHING]
    lose_autopilot(field, False)
    field.until(660.0)
    assert created(field) == 30 + STALE_S + 60
    assert field.told() == ["RASS: position available again", "RASS: radiation readings available again"]


def test_what_went_missing_last_is_told_with_its_effect() -> None:
    field = watched()
    lose_fix(field, True)
    field.until(2 * NO_POSITION_S)
    lose_reading(field, True)
    field.until(field.now + NO_READING_S + FORGOTTEN_S)
    assert field.told() == ["RASS: no position for 60 s, none in new data", NOTHING]
    assert len(NOTHING) <= 50, "one STATUSTEXT"


def test_nothing_to_measure_is_told_with_the_reason() -> None:
    field = watched("no program submits readings")
    lose_fix(field, True)
    field.until(2 * NO_POSITION_S)
    lose_reading(field, True)
    field.until(field.now + NO_READING_S + FORGOTTEN_S)
    assert "".join(field.told()).endswith("RASS: no measurements: no position, and no program submits readings")


@pytest.mark.no_cover
@pytest.mark.parametrize("lose", [lose_fix, lose_reading])
def test_a_position_or_a_reading_alone_is_measured(lose: Callable[[Field, bool], None]) -> None:
    field = watched(interval_steps=1)
    lose(field, True)
    field.until(100.0)
    assert created(field) == 100


def test_a_position_relative_to_the_origin_is_one() -> None:
    field = watched()
    field.fix = False
    vehicle = FrameWriter(DRONE, 1)

    def says_where() -> None:
        field.drone.vehicle_bytes(vehicle.message(local_position_ned(1.0, 2.0, -3.0, 1000)), field.now)

    field.until(2 * NO_POSITION_S, says_where)
    assert field.told() == []


def test_what_a_node_is_not_to_have_it_does_not_lack() -> None:
    field = Field(data={"interval_steps": 0})
    field.autopilot = False
    field.base.services.append(Shortages(field.base, 0.0, position=False, reading=False))
    field.drone.services.append(Shortages(field.drone, 0.0, position=False, reading=False))
    field.until(2 * NO_BASE_S)
    assert field.told() == []

"""Heartbeats: once a second, and to the autopilot as rarely as its radio demands."""

from __future__ import annotations

from itertools import pairwise

import pytest

from rass_mav.agent.turns import HEARTBEAT_BYTES, Heartbeats


def said(beats: Heartbeats, until: float, begin: float = 0.0) -> tuple[list[float], list[float]]:
    """When there is one to the ground and one to the autopilot, if it is looked at every 0.25 s."""
    ground, vehicle = [], []
    for quarter in range(round(4 * begin), round(4 * until)):
        now = quarter / 4
        if beats.due(now):
            ground.append(now)
            if beats.due_to_vehicle():
                vehicle.append(now)
                beats.greeted()
    return ground, vehicle


def test_once_a_second_both_ways() -> None:
    ground, vehicle = said(Heartbeats(0.0), 10.0)
    assert ground == vehicle == [float(n) for n in range(10)]


@pytest.mark.parametrize("rate", [100.0, 21.0, 20.9, 7.0, 1.7])
def test_never_more_to_the_autopilot_than_its_radio_bears(rate: float) -> None:
    beats = Heartbeats(0.0)
    beats.pace(rate)
    ground, vehicle = said(beats, 120.0)
    assert len(ground) == 120
    [gap] = {b - a for a, b in pairwise(vehicle)}
    assert HEARTBEAT_BYTES / gap <= rate
    assert gap == 1.0 or HEARTBEAT_BYTES / (gap - 1.0) > rate, "and no less"


def test_a_port_that_was_opened_gets_one_at_once_and_the_next_one_after_a_full_pause() -> None:
    beats = Heartbeats(0.0)
    beats.pace(HEARTBEAT_BYTES / 5)
    assert said(beats, 2.0)[1] == [0.0]
    beats.soon(2.0)
    assert said(beats, 10.0, 2.0)[1] == [2.0, 7.0]

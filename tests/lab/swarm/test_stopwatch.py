"""Processor time is what robot-steps are counted by."""

from __future__ import annotations

import subprocess
import sys
import time

import pytest

from rass_mav.commands.common import LINE_EVERY_S
from rass_mav.lab.commands.swarm import Pace
from rass_mav.lab.swarm.statistics import Stopwatch

#: Uses so much processor time, seconds.
BUSY = "import time\nwhile time.process_time() < 0.3: pass"


def test_children_that_have_ended_count() -> None:
    watch = Stopwatch()
    subprocess.run([sys.executable, "-c", BUSY], check=True)
    took = watch.figures(300)
    assert took["cpu_s"] >= 0.29
    assert took["robot_steps_per_s"] <= 300 / 0.29


def test_a_second_of_processor_time_is_what_steps_are_counted_by() -> None:
    watch = Stopwatch()
    begin = time.process_time()
    while time.process_time() - begin < 0.1:
        pass
    took = watch.figures(1000)
    assert abs(took["robot_steps_per_s"] * took["cpu_s"] - 1000) < 20


def test_a_mission_that_one_watches_says_how_fast_it_really_is() -> None:
    pace = Pace(10.0, 1.0, 100.0)
    assert pace.wait(50, 102.0) == pytest.approx(3.0)
    assert pace.wait(50, 106.0) == 0.0
    assert pace.line(290, 100.0 + LINE_EVERY_S - 1.0) is None
    assert pace.line(300, 100.0 + LINE_EVERY_S) is None, "as fast as wanted"
    slow = 100.0 + 2 * LINE_EVERY_S
    assert pace.line(360, slow) == (
        "this computer is too slow: 360 s of the mission took 60 s: a pace of 6.0 instead of 10"
    )
    assert pace.line(366, slow + 1.0) is None, "said a second ago"
    assert pace.closing(400, 200.0) == "400 s of the mission took 100 s: a pace of 4.0 instead of 10"

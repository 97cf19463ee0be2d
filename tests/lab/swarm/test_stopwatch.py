"""Processor time is what robot-steps are counted by."""

from __future__ import annotations

import subprocess
import sys
import time

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

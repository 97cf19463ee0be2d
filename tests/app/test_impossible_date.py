"""Real nodes whose computer begins in 1970, as one does whose clock has no battery, and before GPS knows the date."""

from __future__ import annotations

import json
import signal
from pathlib import Path

import pytest

from .app_nodes import RunningNode, command

#: The program, where the date begins with `wall`, and nothing tells which boot of the computer it is.
DATED = """
import sys, time
real, begun = time.time, time.time()
time.time = lambda: {wall} + real() - begun
from rass_mav.app import clock
clock._BOOT_ID = clock.Path("/none")
from rass_mav.cli import main
sys.exit(main(sys.argv[1:]))
"""
TODAY = 1.8e9


class Computer(RunningNode):
    """A node on a computer whose date is `wall` at the start, seconds since 1970. Nothing tells which boot it is."""

    wall = 720.0

    def program(self) -> list[str]:
        return ["-c", DATED.format(wall=self.wall)]


@pytest.mark.parametrize("clock", ["auto", "trusted"])
def test_data_of_1970_have_no_date_and_do_not_expire_when_the_clock_is_set(clock: str, tmp_path: Path) -> None:
    node = Computer(
        tmp_path, 5, node={"clock": clock}, sensor={"type": "program"}, risk={"unit": "usvh", "low": 1, "high": 100},
        links=[{"type": "udp", "listen": "127.0.0.1:0", "peers": [{"address": "127.0.0.1:9"}]}],
        data={"interval_steps": 1, "lifetime_s": 86_400.0},
    )  # fmt: skip
    try:
        node.start(forked=False)
        assert node.status()["clock"]["trusted"] is False
        assert command(tmp_path, "measure", "0.5", "--unit", "uSv/h", "-c", node.config).returncode == 0
        assert command(tmp_path, "put", "-c", node.config, "--line", "here").returncode == 0
        node.until(lambda: any(entry.measurement is not None for entry in node.listing().values()))
        before = json.loads(command(tmp_path, "ls", node.config, "--json").stdout)["data"]
        assert {datum["kind"] for datum in before} >= {"measurement", "bytes"}
        assert not any(datum.keys() & {"utc", "error_s"} for datum in before)
        shown = command(tmp_path, "ls", node.config).stdout.decode()
        assert "unknown" in shown
        assert "1970" not in shown
        assert node.signal(signal.SIGTERM) == 0
        # The clock is set, and the computer is started again.
        node.wall = TODAY
        node.start(forked=False)
        # Nobody knows how long it was off; nothing has expired by the 57 years between the two dates.
        node.until(lambda: all(node.listing()[datum["id"]].at_least for datum in before))
        assert node.signal(signal.SIGTERM) == 0
    finally:
        node.end()

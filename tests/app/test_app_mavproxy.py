"""MAVProxy, an independent ground station, and a running node behind an autopilot."""

from __future__ import annotations

import importlib.util
import os
import re
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from rass_mav.station.parameters import INDEX
from tests.patience import PATIENCE_S

from .app_nodes import RunningNode, free_ports
from .app_relay import autopilot

SYSTEM, COMPANION = 12, 191

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("MAVProxy") is None, reason="MAVProxy is not installed (extra interop)"
)


class MavProxy:
    """MAVProxy at its prompt."""

    def __init__(self, directory: Path, port: int) -> None:
        self.text = ""
        self._read = 0
        # MAVProxy looks for its start-up files at home.
        home = {**os.environ, "HOME": str(directory), "PYTHONUNBUFFERED": "1", "PYTHONWARNINGS": "ignore"}
        command = [sys.executable, "-m", "MAVProxy.mavproxy", f"--master=udpin:127.0.0.1:{port}"]
        command += ["--default-modules=param,misc,cmdlong,ftp", f"--state-basedir={directory}", "--logfile=mav.tlog"]
        self._process = subprocess.Popen(
            command, cwd=directory, env=home, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        )

    def type(self, line: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(line.encode() + b"\n")
        self._process.stdin.flush()

    def until(self, pattern: str) -> re.Match[str]:
        """Wait for text behind what has been waited for before."""
        assert self._process.stdout is not None
        deadline = time.monotonic() + PATIENCE_S
        while True:
            found = re.compile(pattern).search(self.text, self._read)
            if found:
                self._read = found.end()
                return found
            left = deadline - time.monotonic()
            ready, _, _ = select.select([self._process.stdout], [], [], max(0.0, left))
            data = os.read(self._process.stdout.fileno(), 65536) if ready else b""
            assert data, f"no {pattern!r} in: {self.text}"
            self.text += data.decode(errors="replace")

    def end(self) -> None:
        self._process.kill()
        self._process.communicate()


@pytest.fixture
def proxy(tmp_path: Path) -> Iterator[MavProxy]:
    """With a node and its autopilot to talk to."""
    vehicle, link, ground = free_ports(3)
    node = RunningNode(
        tmp_path,
        7,
        autopilot={"url": f"udpin:127.0.0.1:{vehicle}"},
        links=[{"listen": f"127.0.0.1:{link}", "peers": [{"address": f"127.0.0.1:{ground}"}]}],
        ground={"values_s": 1.0, "may_set_by_radio": True},
        policy={"name": "rass"},
        mavlink={"system_id": SYSTEM},
    )
    proxy = MavProxy(tmp_path, ground)
    try:
        node.start()
        with autopilot(vehicle, ground, SYSTEM):
            yield proxy
        assert node.signal(signal.SIGTERM) == 0
    finally:
        proxy.end()
        node.end()


def test_mavproxy_lists_reads_and_sets_our_parameters(proxy: MavProxy) -> None:
    proxy.until(f"Detected vehicle {SYSTEM}:{COMPANION}")
    proxy.type(f"vehicle {SYSTEM}:{COMPANION}")
    proxy.until("Set vehicle")
    proxy.type("param fetch")
    # It asks by file transfer first, and as soon as that is refused, by PARAM_REQUEST_LIST.
    proxy.until(r"Requested parameter list \(ftp\)")
    proxy.until(f"Received {len(INDEX)} parameters")
    proxy.type("param show RASS_*")
    for name in sorted(INDEX):
        proxy.until(rf"{name} +\d")

    proxy.type("watch PARAM_VALUE")
    proxy.type("param set RASS_ALPHA 2.5")
    proxy.until(r"param_id : RASS_ALPHA, param_value : 2\.5")
    proxy.type("param show RASS_ALPHA")
    proxy.until(r"RASS_ALPHA +2\.5")
    proxy.type("param set RASS_ALPHA -1")
    # The text comes first, then MAVProxy gives up.
    proxy.until("RASS_ALPHA: expected a number >= 0, got -1")
    proxy.until(r"Failed to set RASS_ALPHA to -1 \(invalid returned value 2.5\)")
    proxy.type("param show RASS_ALPHA")
    proxy.until(r"RASS_ALPHA +2\.5")


def test_mavproxy_sees_what_the_node_is_and_says(proxy: MavProxy) -> None:
    proxy.until(f"Detected vehicle {SYSTEM}:{COMPANION}")
    proxy.type(f"vehicle {SYSTEM}:{COMPANION}")
    proxy.until("Set vehicle")
    for name, fields in (
        ("HEARTBEAT", r"type : 18, autopilot : 8"),  # onboard controller, no autopilot
        ("TUNNEL", r"payload_type : 33200"),
        ("NAMED_VALUE_FLOAT", r"name : RASS_RISK, value : 1\.0"),
    ):
        proxy.type(f"watch {name}")
        proxy.until(rf"{name} \{{.*{fields}")

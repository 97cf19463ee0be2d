"""docs/examples/rass-wifi joins the network, and joins it again: with real interfaces, and a stand-in for iw.

A cable is in the place of the Wi-Fi, because few machines have a radio to spare. Its far end comes up when `iw`
joins.
"""

from __future__ import annotations

import os
import select
import subprocess
from pathlib import Path

from tests.namespaces import in_namespace, ip

EXAMPLES = Path(__file__).resolve().parents[2] / "docs" / "examples"
DEADLINE_S = 30.0
IW = """#!/bin/sh
echo "$*" >> iw.log
case "$*" in *" ibss join "*) ip link set air up ;; esac
case "$*" in *" power_save "*) exit 95 ;; esac
"""
JOIN = "dev wlan0 ibss join rass 2412 NOHT fixed-freq 02:52:41:53:53:01 mcast-rate 6"


def test_it_joins_and_joins_again(tmp_path: Path) -> None:
    (tmp_path / "iw").write_text(IW)
    (tmp_path / "iw").chmod(0o755)
    settings = (EXAMPLES / "rass-wifi.conf").read_text().replace("EVERY_S=2 ", "EVERY_S=0.05 ")
    (tmp_path / "rass-wifi.conf").write_text(settings)

    def work() -> list[str]:
        os.chdir(tmp_path)
        said = []
        arguments = [str(EXAMPLES / "rass-wifi"), str(tmp_path / "rass-wifi.conf")]
        path = f"{tmp_path}:{os.environ['PATH']}"
        with subprocess.Popen(arguments, env={"PATH": path}, stdout=subprocess.PIPE) as script:
            assert script.stdout is not None
            try:
                for lose in ("link set air down", "link set wlan0 down", None):
                    ready, _, _ = select.select([script.stdout], [], [], DEADLINE_S)
                    assert ready, "it has not joined"
                    said.append(script.stdout.readline().decode())
                    shown = subprocess.run(["ip", "addr", "show", "dev", "wlan0"], capture_output=True, check=True)
                    assert b"LOWER_UP" in shown.stdout
                    assert b"inet 192.168.4.7/24 brd 192.168.4.255 " in shown.stdout
                    if lose:
                        ip(lose)
            finally:
                script.kill()
        return said

    said = in_namespace(["link add wlan0 type veth peer name air"], work)
    assert said == 3 * ["wlan0 has joined rass\n"]
    done = (tmp_path / "iw.log").read_text().splitlines()
    assert done[:3] == ["dev wlan0 set type ibss", JOIN, "dev wlan0 set power_save off"]
    assert done.count(JOIN) == 3

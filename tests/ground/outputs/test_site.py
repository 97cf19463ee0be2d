"""The page of real bases."""

from __future__ import annotations

import json
import os
import signal
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

import psutil
import pytest

from tests.app.app_nodes import RunningNode, Tidy, command, line_of
from tests.patience import PATIENCE_S

from .beside import served

pytest.importorskip("aiohttp", reason="aiohttp is not installed (extra ground)")

PAGE = {"listen": "127.0.0.1:0"}
TOKEN = "a token, long enough".replace(" ", "-")


def ask(url: str, *, token: str = "") -> dict[str, Any]:
    request = urllib.request.Request(url, headers={"Authorization": f"Bearer {token}"} if token else {})
    with urllib.request.urlopen(request, timeout=PATIENCE_S) as answer:
        found: dict[str, Any] = json.load(answer)
    return found


@pytest.mark.processes_measured
def test_a_base_shows_what_arrives_and_who_runs_it(tmp_path: Path, tidy: Tidy) -> None:
    base, far = (tidy(node) for node in line_of(tmp_path, [1, 2]))
    with (tmp_path / base.config).open("a") as file:
        file.write(f"page: {json.dumps(PAGE)}\n")
    base.start()
    far.start()
    url = served(base, "page")
    for number in range(3):
        far.ask("put", payload=b"datum %d" % number)

    def shown() -> bool:
        mission = ask(f"{url}api/mission")
        return mission["totals"]["arrived"] == 3 and mission["node"] is not None and mission["node"]["node_id"] == 1

    base.until(shown)
    assert f"page: {url}, 0 open" in command(tmp_path, "status", "n1.yaml").stdout.decode()

    # The process beside the node is killed: another one serves the page, with all that has arrived.
    pid = base.status()["outputs"]["pid"]
    os.kill(pid, signal.SIGKILL)
    base.until(lambda: base.status()["outputs"]["pid"] not in (pid, None))
    again = served(base, "page")
    base.until(lambda: ask(f"{again}api/mission")["totals"]["arrived"] == 3)
    # The node is killed: the process beside it ends.
    beside = psutil.Process(base.status()["outputs"]["pid"])
    base.signal(signal.SIGKILL)
    assert psutil.wait_procs([beside], timeout=PATIENCE_S)[1] == []
    with pytest.raises(urllib.error.URLError):
        ask(f"{again}api/mission")
    assert far.signal(signal.SIGTERM) == 0


def test_a_token_admits_others(tmp_path: Path, tidy: Tidy) -> None:
    token = tmp_path / "token"
    token.write_text(TOKEN + "\n")
    node = tidy(
        RunningNode(tmp_path, 1, node={"role": "base"}, page={"listen": "0.0.0.0:0", "token_file": str(token)})
    ).start()
    url = served(node, "page").replace("0.0.0.0", "127.0.0.1")
    with pytest.raises(urllib.error.HTTPError, match="401"):
        ask(f"{url}api/mission")
    assert ask(f"{url}api/mission", token=TOKEN)["totals"]["arrived"] == 0
    assert node.signal(signal.SIGTERM) == 0

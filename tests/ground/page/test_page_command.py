"""`rass-mav page`: its options, its start and its end."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import select
import signal
import socket
import subprocess
import sys
import urllib.error
import urllib.request
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest

from rass_mav.errors import installing
from tests.commands import output
from tests.environment import environment
from tests.ground.missions import HERE, Base
from tests.patience import PATIENCE_S
from tests.some import some

from .test_tiles import JPEG, mbtiles

Capture = pytest.CaptureFixture[str]


@pytest.fixture
def store(tmp_path: Path) -> Path:
    base = Base(tmp_path / "rass-1.db")
    base.arrive(base.measurement(7, 0, HERE))
    base.close()
    return base.path


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (["--listen", "0.0.0.0:8080"], "--listen: 0.0.0.0 is reachable from other computers: add a token file"),
        (["--listen", "127.0.0.1"], "--listen: expected host:port"),
        (["--token-file", "missing"], "missing: no such file"),
        (["--tiles", "missing.mbtiles"], "missing.mbtiles: no such file"),
        (["--tiles", "rass-1.db"], "rass-1.db: not a file of tiles (no such table: metadata)"),
    ],
)
def test_what_cannot_be_is_said_in_one_line(
    store: Path, options: list[str], why: str, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("aiohttp", reason="aiohttp is not installed (extra ground)")
    monkeypatch.chdir(store.parent)
    error = output(capsys, "page", str(store), *options, code=2).err
    assert error.startswith(why)
    assert error.count("\n") == 1


def test_without_its_package_it_says_what_to_install(
    store: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(sys.modules, "rass_mav.ground.page.server", raising=False)
    monkeypatch.setitem(sys.modules, "aiohttp", None)
    assert (
        output(capsys, "page", str(store), code=1).err == f"page: needs the package aiohttp: {installing('ground')}\n"
    )


@pytest.mark.processes_measured
def test_it_serves_until_it_is_stopped(store: Path) -> None:
    pytest.importorskip("aiohttp", reason="aiohttp is not installed (extra ground)")
    tiles = mbtiles(store.with_name("map.mbtiles"), {(0, 0, 0): JPEG})
    config = store.with_name("base.yaml")
    config.write_text(
        "node: {id: 1, role: base}\nlinks: [{listen: '127.0.0.1:0', peers: [{address: '127.0.0.1:9'}]}]\n"
        f"store: {{path: {json.dumps(str(store))}}}\n"
    )
    words = ["page", str(config), "--listen", "127.0.0.1:0", "--tiles", str(tiles), "--json"]
    command = [sys.executable, "-m", "rass_mav", *words]
    with subprocess.Popen(command, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE) as page:
        try:
            assert page.stdout is not None
            assert select.select([page.stdout], [], [], PATIENCE_S)[0]
            url = json.loads(page.stdout.readline())["url"]
            with urllib.request.urlopen(f"{url}api/mission", timeout=PATIENCE_S) as answer:
                shown = json.load(answer)
            assert shown["store"] == "rass-1.db"
            assert shown["node"] is None
            again = subprocess.run(
                [sys.executable, "-m", "rass_mav", "page", str(store), "--listen", url[7:-1]],
                env=environment(), capture_output=True, text=True, timeout=PATIENCE_S, check=False,
            )  # fmt: skip
            assert again.returncode == 1
            assert "in use" in again.stderr
            page.send_signal(signal.SIGTERM)
            assert page.wait(PATIENCE_S) == 0
            assert some(page.stderr).read() == b""
        finally:
            page.kill()


def test_connections_that_ask_nothing_keep_nobody_out(store: Path) -> None:
    """More of them than the program may open files; and whoever asks slowly, or never takes an answer."""
    pytest.importorskip("aiohttp", reason="aiohttp is not installed (extra ground)")
    command = [sys.executable, "-m", "rass_mav", "page", str(store), "--listen", "127.0.0.1:0", "--json"]
    with (
        ExitStack() as stack,
        subprocess.Popen(command, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE) as page,
    ):
        try:
            url = json.loads(some(page.stdout).readline())["url"]
            resource.prlimit(page.pid, resource.RLIMIT_NOFILE, (256, 256))
            host, port = url[7:-1].split(":")
            for said in (b"", b"GET / HTTP/1.1\r\nHost: ", b"GET /api/events HTTP/1.1\r\nHost: localhost\r\n\r\n"):
                for _ in range(300):
                    one = stack.enter_context(socket.create_connection((host, int(port)), PATIENCE_S))
                    with suppress(OSError):
                        one.sendall(said)
                with urllib.request.urlopen(f"{url}healthz", timeout=PATIENCE_S) as answer:
                    assert answer.status == 200
            page.send_signal(signal.SIGTERM)
            assert page.wait(PATIENCE_S) == 0
            assert len(some(page.stderr).read()) < 1000
        finally:
            page.kill()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_the_page_of_a_swarm_ends_with_it(number: signal.Signals) -> None:
    pytest.importorskip("aiohttp", reason="aiohttp is not installed (extra ground)")
    words = ["swarm", "demo", "--nodes", "9", "--page", "127.0.0.1:0", "--pace", "1"]
    command = [sys.executable, "-m", "rass_mav", *words]
    with subprocess.Popen(
        command, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as swarm:  # fmt: skip
        try:
            url = next(line for line in some(swarm.stderr) if line.startswith("http://")).split()[0]
            with urllib.request.urlopen(f"{url}api/mission", timeout=PATIENCE_S) as answer:
                assert json.load(answer)["title"] == "demo"
            swarm.send_signal(number)
            # Returns when the page has ended too: it has the same stderr.
            swarm.communicate(timeout=PATIENCE_S)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(swarm.pid, signal.SIGKILL)
    assert swarm.returncode == (128 + number if number == signal.SIGTERM else -number)
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(url, timeout=PATIENCE_S)

"""What a running node must not load: a Pi Zero has 512 MiB for everything."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.environment import environment

ROOT = Path(__file__).resolve().parents[1]

_LOAD = """
import json, sys
from rass_mav.cli import build_parser
build_parser("run").parse_args(["run", "drone.yaml"])
import rass_mav.app.config, rass_mav.app.run
print(json.dumps(sorted(sys.modules)))
"""

_WITHOUT_OPENSSL = """
import sys
from rass_mav.app.light import load_without_openssl
load_without_openssl()
import asyncio, hashlib, rass_mav.app.run
assert not {"ssl", "_ssl", "_hashlib"} & set(sys.modules)
assert asyncio.run(asyncio.sleep(0, "works")) == "works"
assert hashlib.sha256(b"abc").hexdigest().startswith("ba7816bf8f01cfea414140de5dae2223")
import ssl
load_without_openssl()
print(sys.modules["ssl"] is ssl, ssl.OPENSSL_VERSION_NUMBER > 0)
"""

_SPEAK = """
import json, sys
from rass_mav.mavlink.dialect import common, forget_texts
if sys.argv[1] == "forget":
    forget_texts()
    assert not common.enums
from rass_mav.mavlink import messages
from rass_mav.mavlink.frames import FrameWriter
from rass_mav.mavlink.frames import FrameReader
writer, reader = FrameWriter(1, 191), FrameReader()
home = common.MAVLink_home_position_message(1, 2, 3, 0.0, 0.0, 0.0, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0)
said = [messages.companion_heartbeat(), home, *messages.statustext(4, "x" * 60)]
frames = [writer.message(message) for message in said]
heard = [messages.parse(frame).to_dict() for raw in frames for frame in reader.feed(raw)]
print(json.dumps([[frame.hex() for frame in frames], heard]))
"""


def _python(code: str, *arguments: str) -> str:
    command = [sys.executable, "-c", code, *arguments]
    done = subprocess.run(command, cwd=ROOT, env=environment(), capture_output=True, text=True, timeout=60, check=True)
    return done.stdout


@pytest.fixture(scope="module")
def loaded() -> set[str]:
    return set(json.loads(_python(_LOAD)))


@pytest.mark.parametrize(
    "module", ["shutil", "lzma", "difflib", "tempfile", "tqdm", "pymavlink.mavutil", "lxml", "serial", "nacl"]
)
def test_a_node_does_not_load(module: str, loaded: set[str]) -> None:
    assert module not in loaded


def test_a_node_does_not_load_sensors_that_it_does_not_have(loaded: set[str]) -> None:
    kinds = {"bgeigie", "bgeigie_log", "gmc", "mightyohm", "playback", "radpro", "serial_sensor"}
    assert not {f"rass_mav.sensor.{kind}" for kind in kinds} & loaded


def test_a_node_does_not_load_what_handles_files_streams_and_terminals_before_it_has_some(loaded: set[str]) -> None:
    app = {"companion", "file_requests", "files", "keyed", "narration", "packing", "redundancy", "spool", "watch"}
    link = {"airtime", "radio", "serialport", "stream", "udp", "vehicle_stream", "vehicle_udp"}
    assert not {f"rass_mav.app.{name}" for name in app} & loaded
    assert not {f"rass_mav.link.{name}" for name in link} & loaded
    store = {"memory", "reader", "reading", "salvage"}
    assert not {f"rass_mav.store.{name}" for name in store} & loaded
    assert {"rass_mav.app.on_demand", "rass_mav.store.sqlite"} <= loaded


def test_a_node_without_keys_loads_nothing_of_trust(loaded: set[str]) -> None:
    assert not [name for name in loaded if name.startswith("rass_mav.trust")]
    assert "rass_mav.agent.seam" in loaded


@pytest.mark.parametrize("wing", ["ground", "lab"])
def test_a_node_does_not_load_the_other_wings(wing: str, loaded: set[str]) -> None:
    assert not [name for name in loaded if name.startswith(f"rass_mav.{wing}")]
    assert "rass_mav.app.driver" in loaded


def test_without_its_texts_the_dialect_says_and_understands_the_same() -> None:
    assert _python(_SPEAK, "forget") == _python(_SPEAK, "keep")


def test_openssl_is_left_out_but_others_can_load_it() -> None:
    assert _python(_WITHOUT_OPENSSL) == "True True\n"


def test_a_running_node_does_not_map_openssl(tmp_path: Path) -> None:
    config = tmp_path / "drone.yaml"
    config.write_text("node: {id: 7}\nlinks: [{listen: '127.0.0.1:0', peers: [{address: '127.0.0.1:9'}]}]\n")
    command = [sys.executable, "-m", "rass_mav", "run", config.name, "--json"]
    with subprocess.Popen(command, cwd=tmp_path, env=environment(), stdout=subprocess.PIPE) as node:
        try:
            assert node.stdout is not None
            assert json.loads(node.stdout.readline())["node_id"] == 7
            mapped = Path(f"/proc/{node.pid}/maps").read_text()
            assert "libssl" not in mapped
            assert "libcrypto" not in mapped
        finally:
            node.terminate()

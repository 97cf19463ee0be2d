"""What any bytes may do: one function for each way in. A target returns, whatever the bytes, or it has found a bug."""

from __future__ import annotations

import io
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from pkgutil import resolve_name

from rass_mav.app.config import load_config
from rass_mav.app.control import _command, _request
from rass_mav.app.jsonlines import load_bytes
from rass_mav.config.loading import convert, read_yaml
from rass_mav.errors import ConfigError, MalformedError
from rass_mav.lab.replay.tlog import TlogReader
from rass_mav.lab.swarm.scenario import Scenario
from rass_mav.mavlink.frames import FrameReader
from rass_mav.mavlink.telemetry import Telemetry
from rass_mav.sensor.bgeigie_log import read_bgeigie
from rass_mav.sensor.kinds import KINDS
from rass_mav.wire import MAX_TUNNEL, decode, encode

from . import agents, captured, disk, nodes
from . import attackers as overhearing

#: A directory in memory, where there is such a place: a store waits for its disk.
_MEMORY = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None


def frames(data: bytes) -> None:
    """A stream of MAVLink bytes: whole and in pieces the same frames, and telemetry takes them all."""
    whole, pieces, telemetry = FrameReader(), FrameReader(), Telemetry(1)
    found = whole.feed(data) + whole.flush()
    again = []
    size = data[0] % 17 + 1 if data else 1
    for at in range(0, len(data), size):
        again += pieces.feed(data[at : at + size])
    again += pieces.flush()
    assert [frame.payload for frame in found] == [frame.payload for frame in again]
    for frame in found:
        telemetry.handle(frame, 1.0)


def payloads(data: bytes) -> None:
    """A TUNNEL payload: malformed, or a message that means the same when it is said again."""
    try:
        message = decode(data[:MAX_TUNNEL], 1e6)
    except MalformedError:
        return
    try:
        said = encode(message, 1e6)
    except ValueError:
        # What nobody of ours says, such as a query of more entries than fit one frame.
        return
    assert all(len(payload) <= MAX_TUNNEL for payload in said)
    for payload in said:
        decode(payload, 1e6)


def conversation(data: bytes) -> None:
    """Two drones and a base that hear anything in any order, and are restarted over their stores."""
    nodes.play(data)


def agent(data: bytes) -> None:
    """What an autopilot, a ground station and a neighbour say to an agent, in whole frames."""
    agents.play(data)


def keyed(data: bytes) -> None:
    """Two drones and a base with all their keys, among strangers and with a captured drone."""
    captured.play(data)


def attackers(data: bytes) -> None:
    """A base and drones, open or with keys, between two attackers who understand what they overhear."""
    overhearing.play(data)


def tlog(data: bytes) -> None:
    """A telemetry log."""
    reader = TlogReader(io.BytesIO(data))
    records = list(reader)
    assert len(records) + reader.rejected == reader.read


def bgeigie(data: bytes) -> None:
    """A bGeigie log."""
    log = read_bgeigie(io.BytesIO(data))
    assert log.read == len(log.records) + log.rejected


def sensors(data: bytes) -> None:
    """What a counter says: the first byte chooses which one, and how the rest arrives."""
    if not data:
        return
    protocols = [kind.protocol for kind in KINDS.values() if kind.protocol]
    protocol = resolve_name(protocols[data[0] % len(protocols)])()
    size = data[0] // len(protocols) % 16 + 1
    for at in range(1, len(data), size):
        protocol.ask(at * 0.1)
        for sample in protocol.feed(data[at : at + size], at * 0.1):
            assert sample.cpm >= 0


def settings(data: bytes) -> None:
    """A configuration: of a node, or of a mock swarm."""
    with tempfile.TemporaryDirectory(dir=_MEMORY) as directory:
        path = Path(directory) / "settings.yaml"
        path.write_bytes(data)
        try:
            if data[:1] == b"#":
                convert(read_yaml(path), Scenario, "scenario.yaml")
            else:
                load_config(path).agent_settings()
        except ConfigError:
            pass


def store(data: bytes) -> None:
    """The files of a store."""
    with tempfile.TemporaryDirectory(dir=_MEMORY) as directory:
        disk.damage(data, Path(directory))


def control(data: bytes) -> None:
    """Lines on the control socket."""
    for line in data.split(b"\n"):
        try:
            request = _request(*_command(line))
            load_bytes(getattr(request, "payload", ""))
        except (MalformedError, ConfigError):
            pass


_ALL = (frames, payloads, conversation, agent, keyed, attackers, tlog, bgeigie, sensors, settings, store, control)
TARGETS: dict[str, Callable[[bytes], None]] = {target.__name__: target for target in _ALL}

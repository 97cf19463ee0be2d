"""A mock flight controller with parameters, on a thread of its own or in virtual time. Its frames are built and read by
pymavlink alone.

It behaves as the MAVLink pages and the firmware say: ArduPilot casts whole numbers to floats, PX4 sends their bytes; a
parameter that it does not have it passes over in silence; a new system id holds at once.
"""

from __future__ import annotations

import math
import os
import select
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

from pymavlink.dialects.v20 import common

from tests.virtual import VirtualTime

INT8, INT16, INT32, REAL32 = 2, 4, 6, 9
ARDUPILOT, PX4 = 3, 12
LAYOUTS = {INT8: "<b3x", INT16: "<h2x", INT32: "<i", REAL32: "<f"}
PERIOD_S = 0.2


class MockVehicle:
    """Speaks over a UDP socket that is connected to the node's port, or over the far end of a pseudo-terminal."""

    def __init__(self, system_id: int = 1, *, firmware: int = ARDUPILOT, version: tuple[int, int, int] = (4, 6, 3)):
        self.system_id = system_id
        self.firmware = firmware
        self.version = version
        self.capabilities: int | None = 16 if firmware == PX4 else 131072
        """None: it does not tell its version."""
        self.parameters: dict[str, tuple[float, int]] = {}
        """Value and MAV_PARAM_TYPE."""
        self.refusing: dict[str, int | None] = {}
        """Names that cannot be set: the MAV_PARAM_ERROR that it says, None: it says the old value only."""
        self.takes_keys = True
        """Whether it obeys SETUP_SIGNING."""
        self.answers_questions = True
        self.mavlink_1 = False
        """Whether its port sends MAVLink 1 (SERIALn_PROTOCOL 1). It still hears MAVLink 2, and takes keys."""
        self.radio = False
        """Whether a telemetry radio is on the way."""
        self.armed = False
        self.beats = True
        self.position: tuple[float, float] | None = (48.8584, 2.2945)
        """None: no fix yet."""
        self.reading: float | None = None
        self.lose: Callable[[Any], bool] = lambda message: False
        """Which of the messages that it gets are lost on the way."""
        self.id_changes = True
        self.heard: list[Any] = []
        self.sets: list[str] = []
        self._mav = common.MAVLink(None, system_id, 1)
        self._mav.robust_parsing = True
        self._descriptor = -1
        self._send: Callable[[bytes], int] = len
        self._began: float | None = None
        self._beat = -math.inf
        self._closed = False
        """Whether the other end is not open."""

    @property
    def key(self) -> bytes | None:
        """With it, it signs what it sends, and passes over what is not signed or old, as pymavlink does."""
        key: bytes | None = self._mav.signing.secret_key
        return key

    @key.setter
    def key(self, key: bytes | None) -> None:
        self._mav.signing.secret_key = key
        self._mav.signing.sign_outgoing = key is not None

    @property
    def timestamp(self) -> int:
        """Of its next frame."""
        timestamp: int = self._mav.signing.timestamp
        return timestamp

    def reboot(self, timestamp: int) -> None:
        """It forgets whom it has heard, and goes on a minute above a timestamp that it has saved, as ArduPilot does."""
        self._mav.signing.stream_timestamps = {}
        self._mav.signing.timestamp = timestamp + 60 * 100_000

    @contextmanager
    def on_udp(self, port: int, virtual: VirtualTime | None = None) -> Iterator[MockVehicle]:
        """Connected to 127.0.0.1:`port`, where the node listens."""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            sock.connect(("127.0.0.1", port))
            sock.setblocking(False)
            self._descriptor, self._send = sock.fileno(), sock.send
            with self._running() if virtual is None else virtual.with_participant(self._turn):
                yield self

    @contextmanager
    def on_pty(self, descriptor: int) -> Iterator[MockVehicle]:
        """At the far end of a pseudo-terminal."""
        self._descriptor, self._send = descriptor, lambda data: os.write(descriptor, data)
        with self._running():
            yield self

    @contextmanager
    def _running(self) -> Iterator[None]:
        stop_read, stop_write = os.pipe()
        thread = threading.Thread(target=self._run, args=(stop_read,), name="mock vehicle")
        thread.start()
        try:
            yield
        finally:
            os.write(stop_write, b"x")
            thread.join()
            os.close(stop_read)
            os.close(stop_write)

    def _run(self, stop: int) -> None:
        ready: list[int] = []
        while stop not in ready:
            now = time.monotonic()
            wait = max(0.0, self._turn(now) - now)
            if self._closed:
                # A pseudo-terminal says so at once, again and again.
                ready, _, _ = select.select([stop], [], [], 0.02)
            else:
                ready, _, _ = select.select([self._descriptor, stop], [], [], wait)

    def _turn(self, now: float) -> float:
        """Say what is due, and answer what has arrived. Returns when something is due again."""
        if now >= self._beat:
            self._began = now if self._began is None else self._began
            self._beat = now + PERIOD_S
            for message in self._telemetry(int((now - self._began) * 1000) + 1):
                self._say(message)
        self._closed = False
        while select.select([self._descriptor], [], [], 0)[0]:
            try:
                data = os.read(self._descriptor, 4096)
            except OSError:
                self._closed = True
                break
            for message in self._mav.parse_buffer(data) or []:
                self.heard.append(message)
                if not self.lose(message):
                    for answer in self._answers(message):
                        self._say(answer)
        return self._beat

    def _say(self, message: Any) -> None:
        self._mav.srcSystem = self.system_id
        with suppress(ConnectionRefusedError, BlockingIOError):  # nobody has opened the port yet, or nobody reads it
            self._send(bytes(message.pack(self._mav, force_mavlink1=self.mavlink_1)))

    def _telemetry(self, boot_ms: int) -> Iterator[Any]:
        if not self.beats:
            return
        yield common.MAVLink_heartbeat_message(2, self.firmware, 128 if self.armed else 0, 0, 3, 3)
        latitude, longitude = self.position or (0.0, 0.0)
        yield common.MAVLink_global_position_int_message(
            boot_ms, round(latitude * 1e7), round(longitude * 1e7), 1000, 0, 0, 0, 0, 0
        )
        if self.radio:
            yield common.MAVLink_radio_status_message(200, 200, 90, 30, 30, 0, 0)
        if self.reading is not None:
            yield common.MAVLink_named_value_float_message(boot_ms, b"RAD", self.reading)

    def _answers(self, message: Any) -> Iterator[Any]:
        kind = message.get_type()
        if getattr(message, "target_system", self.system_id) != self.system_id or not self.answers_questions:
            return
        if kind == "SETUP_SIGNING" and self.takes_keys and not self.armed:
            key, timestamp = bytes(message.secret_key), message.initial_timestamp
            self.key = key if any(key) or timestamp else None
            self._mav.signing.timestamp = timestamp + 60 * 100_000
        if kind == "COMMAND_LONG" and message.command == 512 and message.param1 == 148:
            if self.capabilities is not None:
                number = int.from_bytes([*self.version, 255], "big")
                yield common.MAVLink_autopilot_version_message(
                    self.capabilities, number, 0, 0, 0, bytes(8), bytes(8), bytes(8), 0, 0, 0
                )
        elif kind == "PARAM_REQUEST_READ" and message.param_id in self.parameters:
            yield self._value(message.param_id)
        elif kind == "PARAM_SET" and message.param_id in self.parameters:
            yield from self._set(message)

    def _value(self, name: str) -> Any:
        value, kind = self.parameters[name]
        if self.firmware == PX4:
            (value,) = struct.unpack("<f", struct.pack(LAYOUTS[kind], value if kind == REAL32 else int(value)))
        return common.MAVLink_param_value_message(name.encode(), value, kind, len(self.parameters), 0)

    def _set(self, message: Any) -> Iterator[Any]:
        name = message.param_id
        self.sets.append(name)
        _, kind = self.parameters[name]
        if name in self.refusing:
            error = self.refusing[name]
            if error is not None:
                yield common.MAVLink_param_error_message(message.get_srcSystem(), 191, name.encode(), -1, error)
                return
        else:
            value = message.param_value
            if self.firmware == PX4:
                (value,) = struct.unpack(LAYOUTS[kind], struct.pack("<f", value))
            elif kind != REAL32:
                value = round(value)
            self.parameters[name] = (value, kind)
            if name in ("SYSID_THISMAV", "MAV_SYSID", "MAV_SYS_ID") and self.id_changes:
                self.system_id = int(value)
        yield self._value(name)

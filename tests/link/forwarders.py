"""Autopilots that pass frames on as real ones were measured to do, in virtual time.

What both do: nothing goes to a port before something was heard on it; broadcasts go to every other port; no hop is
counted and no copy is looked for. ArduPilot remembers 20 routes, and its output buffers hold 1024 bytes; PX4 forwards
through a buffer of two messages.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from rass_mav.lab.swarm.autopilot import autopilot_heartbeat
from rass_mav.mavlink.frames import FrameWriter
from rass_mav.mavlink.messages import HEARTBEAT, TUNNEL

from .shared_radio import Simulation

MAX_ROUTES = 20
ARDUPILOT_BUFFER_BYTES = 1024
PX4_BUFFER_FRAMES = 2
#: PX4 looks into its forward buffer that often, seconds: 200 frames a second pass.
PX4_TURN_S = 0.005


class Port:
    """One serial port of an autopilot, with its output buffer."""

    def __init__(self, simulation: Simulation, bytes_s: float, buffer_bytes: int) -> None:
        self._simulation = simulation
        self._bytes_s = bytes_s
        self._limit = buffer_bytes
        self._out: deque[bytes] = deque()
        self._waiting = 0
        self.heard = False
        self.lost = 0
        self.passed = 0
        self.deliver: Callable[[bytes], None] = lambda frame: None
        """What is wired to the port."""

    def send(self, frame: bytes) -> None:
        if self._waiting + len(frame) > self._limit:
            self.lost += 1
            return
        self._out.append(frame)
        self._waiting += len(frame)
        if len(self._out) == 1:
            self._begin()

    def _begin(self) -> None:
        frame = self._out[0]

        def end() -> None:
            self._out.popleft()
            self._waiting -= len(frame)
            self.passed += 1
            if self._out:
                self._begin()
            self.deliver(frame)

        self._simulation.at(self._simulation.now + len(frame) / self._bytes_s, end)


class Forwarder:
    """An autopilot with some ports. Frames come in by `hear`."""

    def __init__(self, simulation: Simulation, system_id: int, *, px4: bool = False) -> None:
        self._simulation = simulation
        self._px4 = px4
        self._writer = FrameWriter(system_id, 1)
        self.system_id = system_id
        self.ports: list[Port] = []
        self.routes: dict[tuple[int, int], int] = {}
        self._forward: deque[tuple[int, bytes]] = deque()
        self.forwarded = 0
        self.lost = 0
        simulation.at(0.01 * system_id, self._heartbeat)

    def port(self, bytes_s: float) -> Port:
        port = Port(self._simulation, bytes_s, ARDUPILOT_BUFFER_BYTES)
        self.ports.append(port)
        return port

    def _heartbeat(self) -> None:
        frame = self._writer.message(autopilot_heartbeat())
        for port in self.ports:
            port.send(frame)
        self._simulation.at(self._simulation.now + 1.0, self._heartbeat)

    def hear(self, port: Port, frame: bytes) -> None:
        at = self.ports.index(port)
        port.heard = True
        system_id, component_id, message_id = frame[5], frame[6], int.from_bytes(frame[7:10], "little")
        if (system_id, component_id) in self.routes or len(self.routes) < MAX_ROUTES:
            self.routes.setdefault((system_id, component_id), at)
        if message_id not in (HEARTBEAT, TUNNEL):
            return
        if self._px4:
            if len(self._forward) >= PX4_BUFFER_FRAMES:
                self.lost += 1
                return
            self._forward.append((at, frame))
            if len(self._forward) == 1:
                self._simulation.at(self._simulation.now + PX4_TURN_S, self._pass_on)
        else:
            self._route(at, frame)

    def _pass_on(self) -> None:
        self._route(*self._forward.popleft())
        if self._forward:
            self._simulation.at(self._simulation.now + PX4_TURN_S, self._pass_on)

    def _route(self, at: int, frame: bytes) -> None:
        target = frame[12] if int.from_bytes(frame[7:10], "little") == TUNNEL else 0
        to = range(len(self.ports))
        if target:
            known = {port for (system, _), port in self.routes.items() if system == target}
            to = [number for number in to if number in known]  # type: ignore[assignment]
        for number in to:
            if number != at and self.ports[number].heard:
                self.forwarded += 1
                self.ports[number].send(frame)


def wire(simulation: Simulation, a: tuple[Forwarder, Port], b: tuple[Forwarder, Port]) -> None:
    """Join two autopilots by a cable, or by a pair of radios. They have heard each other."""
    (one, port), (other, far) = a, b
    port.deliver = lambda frame: other.hear(far, frame)
    far.deliver = lambda frame: one.hear(port, frame)
    port.heard = far.heard = True

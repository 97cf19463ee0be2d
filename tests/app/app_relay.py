"""An autopilot for a node and a ground station: it says a heartbeat, and passes everything on between its two ports."""

from __future__ import annotations

import select
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from rass_mav.lab.swarm.autopilot import autopilot_heartbeat
from rass_mav.mavlink.frames import FrameWriter

Address = tuple[str, int]


class Relay:
    """Two UDP ports on 127.0.0.1: the node speaks to `node_port`; the ground station listens at `ground`.

    Frames pass unchanged, as through ArduPilot.
    """

    def __init__(self, node: Address, ground: Address, system_id: int) -> None:
        self._to_node = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._to_ground = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._to_node.connect(node)
        self._to_ground.connect(ground)
        for sock in (self._to_node, self._to_ground):
            # An error that made a port readable may be gone, and nothing there, when it is read.
            sock.setblocking(False)
        self._writer = FrameWriter(system_id, 1)
        self._stop, self._stopped = socket.socketpair()
        self._thread = threading.Thread(target=self._run)

    def _run(self) -> None:
        beat = 0.0
        while True:
            now = time.monotonic()
            if now >= beat:
                beat = now + 1.0
                for sock in (self._to_node, self._to_ground):
                    self._send(sock, self._writer.message(autopilot_heartbeat(armed=False)))
            ready, _, _ = select.select([self._to_node, self._to_ground, self._stopped], [], [], max(0.0, beat - now))
            if self._stopped in ready:
                return
            for sock, other in ((self._to_node, self._to_ground), (self._to_ground, self._to_node)):
                if sock in ready:
                    try:
                        self._send(other, sock.recv(2048))
                    except (ConnectionRefusedError, BlockingIOError):
                        continue  # the other program has not opened its port yet

    @staticmethod
    def _send(sock: socket.socket, data: bytes) -> None:
        try:
            sock.send(data)
        except ConnectionRefusedError:
            return

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        self._stop.send(b"x")
        self._thread.join()
        for sock in (self._to_node, self._to_ground, self._stop, self._stopped):
            sock.close()


@contextmanager
def autopilot(node_port: int, ground_port: int, system_id: int) -> Iterator[None]:
    """One that runs until the end of the block."""
    relay = Relay(("127.0.0.1", node_port), ("127.0.0.1", ground_port), system_id)
    relay.start()
    try:
        yield
    finally:
        relay.close()

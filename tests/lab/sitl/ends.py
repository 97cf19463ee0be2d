"""Who is at the other end of a wire."""

from __future__ import annotations

import socket

from rass_mav.mavlink.dialect import MavlinkMessage
from rass_mav.mavlink.frames import Frame, FrameReader, FrameWriter
from rass_mav.mavlink.messages import TUNNEL
from tests.some import some


class End:
    """A socket that says and hears MAVLink frames."""

    def __init__(self, system_id: int, component_id: int, port: int | None = None) -> None:
        """`port`: whom it speaks to; None: whom it has heard last."""
        self._sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._sock.bind(("127.0.0.1", 0))
        self._sock.setblocking(False)
        self._reader = FrameReader()
        self._peer = None if port is None else ("127.0.0.1", port)
        self.writer = FrameWriter(system_id, component_id)

    @property
    def address(self) -> tuple[str, int]:
        host, port = self._sock.getsockname()
        return host, port

    def put(self, raw: bytes) -> bytes:
        self._sock.sendto(raw, some(self._peer))
        return raw

    def say(self, message: MavlinkMessage) -> bytes:
        return self.put(self.writer.message(message))

    def tunnel(self, target: int = 0, component: int = 0, text: bytes = b"hello") -> bytes:
        return self.put(self.writer.tunnel(text, payload_type=33200, target_system=target, target_component=component))

    def heard(self) -> list[Frame]:
        frames: list[Frame] = []
        while True:
            try:
                data, self._peer = self._sock.recvfrom(4096)
            except BlockingIOError:
                return frames
            frames += self._reader.feed(data)

    def tunnels(self) -> list[int]:
        """Who sent those that it has heard."""
        return [frame.system_id for frame in self.heard() if frame.message_id == TUNNEL]

    def close(self) -> None:
        self._sock.close()

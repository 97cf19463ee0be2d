"""TUNNEL messages at the autopilot's port, for a sensor whose device sends them."""

from __future__ import annotations

from rass_mav.agent.agent import VehicleListener
from rass_mav.errors import MalformedError
from rass_mav.mavlink.frames import Frame
from rass_mav.mavlink.messages import TUNNEL
from rass_mav.mavlink.tunnel import decode_tunnel
from rass_mav.sensor.base import TunnelSensor


class TunnelListener(VehicleListener):
    """Hears the autopilot's port."""

    def __init__(self, sensor: TunnelSensor) -> None:
        self._sensor = sensor

    def hear(self, frame: Frame, now: float) -> None:
        """A frame from there."""
        if frame.message_id != TUNNEL:
            return
        try:
            fields = decode_tunnel(frame.payload)
        except MalformedError:
            return  # nobody's: its own length is wrong
        self._sensor.tunnel(frame.system_id, frame.component_id, fields.payload_type, fields.payload)

"""What a radio between processes counts: only it hears all nodes, also those that are killed."""

from __future__ import annotations

from rass_mav.core.messages import NO_ROUTE, Beacon, Chunk, Data, Put
from rass_mav.errors import MalformedError
from rass_mav.mavlink.tunnel import tunnel_from_datagram
from rass_mav.wire import decode


class AirCounts:
    """Figures over all frames between nodes."""

    def __init__(self, payload_type: int) -> None:
        """`payload_type`: of the nodes' TUNNEL messages."""
        self._payload_type = payload_type
        self.malformed = 0
        self.data_sent = 0
        """Data, copies and chunks."""
        self.max_hop_count = 0

    def count(self, frame: bytes) -> None:
        """A frame that a node put on the air."""
        fields = tunnel_from_datagram(frame)
        if fields is None or fields[4] != self._payload_type:
            self.malformed += 1
            return
        try:
            message = decode(fields[5], 0.0)
        except MalformedError:
            self.malformed += 1
            return
        if isinstance(message, Beacon):
            if self.max_hop_count < message.hops != NO_ROUTE:
                self.max_hop_count = message.hops
        elif isinstance(message, Data):
            self.data_sent += len(message.handovers)
        elif isinstance(message, (Chunk, Put)):
            self.data_sent += 1

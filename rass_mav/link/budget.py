"""What may be sent on a link, and the frames that wait for it."""

from __future__ import annotations

from typing import NamedTuple

#: Frames that may wait, by urgency. A waiting beacon is replaced by the next one: only the newest is useful. Chunks:
#: those of two transfers of which all that an acknowledgement can name is under way.
MAX_WAITING = (8, 1, 32, 64, 512)
#: The longest frame of ours on the air, bytes: a full TUNNEL with a signature.
FRAME_BYTES = 158
#: Frames that are sent at once share a datagram of at most this many bytes: each time that a Wi-Fi radio takes the air
#: costs as much as a frame.
DATAGRAM_BYTES = 512


class Budget(NamedTuple):
    """What may be sent on a link."""

    bytes_s: float
    """Capacity of the link in bytes/s: 5760 for 57,600 bit/s with start and stop bit."""
    duty: float = 0.3
    """Share of the capacity for this swarm, all nodes in range together, 0..1."""
    beacons: float = 0.3
    """Share of the swarm's part for beacons, 0..1."""
    burst_bytes: int = 512
    """The most bytes at once, however long the link was idle; at least one frame."""
    burst_frames: int = 2
    """The most frames at once."""
    frames_s: float = 100.0
    """The most frames per second."""
    listen_s: float = 0.0
    """After a frame of another sender, wait for a random part of this before sending, seconds. 0: do not wait."""
    packet_bytes: int = 0
    """Frames that leave in the same moment share a packet of at most this many bytes, and none of them waits for the
    others; 0: each goes alone."""


#: What may be sent where nothing else is known: over a radio of 57,600 bit/s.
USUAL = Budget(5760.0)


class Queued(NamedTuple):
    """A frame that waits."""

    frame: bytes
    target: int
    since: float

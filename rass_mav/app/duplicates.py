"""Detects frames that were heard before: copies forwarded by autopilots and routers, and own frames that come back.

Autopilots forward without counting hops and without checking for copies. Two autopilots joined by two links pass a
frame round endlessly. So a node must recognise a copy before it answers. Otherwise the answers would go round too.

A frame is recognised by its content, including the sequence number and the timestamp of its signature: a forwarder
leaves the frame unchanged, and a sender that repeats a message uses the next number. Each copy renews the memory, so a
frame that keeps going round is never forgotten.
"""

from __future__ import annotations

from rass_mav.mavlink.frames import FLAG_SIGNED, MAGIC_V2, Frame

#: A frame is forgotten when no copy has come for this long, seconds: longer than a frame waits in any buffer.
WINDOW_S = 5.0
#: Frames remembered: 5 s at 400 frames a second. When there are more, the one with the oldest last copy is forgotten.
MAX_REMEMBERED = 2048


class Duplicates:
    """The frames heard and sent recently, on all links together."""

    __slots__ = ("_heard", "echoes", "heard_twice")

    def __init__(self) -> None:
        # By digest, in the order of the last copy: its time, and whether the frame is our own.
        self._heard: dict[int, tuple[float, bool]] = {}
        self.heard_twice = 0
        """Copies of other nodes' frames."""
        self.echoes = 0
        """Own frames that came back."""

    def __len__(self) -> int:
        return len(self._heard)

    def is_new(self, frame: Frame, now: float) -> bool:
        """Whether a frame is heard for the first time. From then on it counts as a copy."""
        digest = hash((frame.sequence, frame.system_id, frame.component_id, frame.payload, frame.timestamp))
        before = self._heard.pop(digest, None)
        fresh = before is None or now - before[0] > WINDOW_S
        own = not fresh and before is not None and before[1]
        self._remember(digest, now, own)
        if own:
            self.echoes += 1
        elif not fresh:
            self.heard_twice += 1
        return fresh

    def sent(self, frame: bytes, now: float) -> None:
        """Remember an own MAVLink 2 frame that is about to leave."""
        assert frame[0] == MAGIC_V2
        timestamp = int.from_bytes(frame[-12:-6], "little") if frame[2] & FLAG_SIGNED else 0
        digest = hash((frame[4], frame[5], frame[6], frame[10 : 10 + frame[1]], timestamp))
        self._heard.pop(digest, None)
        self._remember(digest, now, True)

    def _remember(self, digest: int, now: float, own: bool) -> None:
        heard = self._heard
        heard[digest] = (now, own)
        while len(heard) > MAX_REMEMBERED:
            del heard[next(iter(heard))]

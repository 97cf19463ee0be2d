"""Frames that were heard before: copies that autopilots and routers pass on, and own frames that come back.

Autopilots forward without counting hops and without looking for copies. Two of them joined by two links pass a frame
round for ever. So a copy must be known before anything is answered: otherwise the answers would go round too.

A frame is known by its content, the sequence number included: who forwards a frame leaves it as it is, and who says
the same thing again counts on. Each copy makes it remembered anew: what goes round for ever stays known for ever.
"""

from __future__ import annotations

from rass_mav.mavlink.frames import MAGIC_V2, Frame

#: A frame is forgotten when no copy of it came for so long, seconds: longer than a frame waits in anybody's buffer.
WINDOW_S = 5.0
#: Frames remembered; beyond it the one whose last copy is oldest is forgotten. 5 s of 400 frames a second.
MAX_REMEMBERED = 2048


class Duplicates:
    """What was heard and said lately, on all links together."""

    __slots__ = ("_known", "echoes", "heard_twice")

    def __init__(self) -> None:
        # By digest, in the order of the last copy: when that was, and whether the frame is our own.
        self._known: dict[int, tuple[float, bool]] = {}
        self.heard_twice = 0
        """Copies of others' frames."""
        self.echoes = 0
        """Own frames that came back."""

    def __len__(self) -> int:
        return len(self._known)

    def is_new(self, frame: Frame, now: float) -> bool:
        """Whether a frame that was heard is no copy. It is one the next time."""
        digest = hash((frame.sequence, frame.system_id, frame.component_id, frame.payload))
        known = self._known.pop(digest, None)
        fresh = known is None or now - known[0] > WINDOW_S
        own = not fresh and known is not None and known[1]
        self._remember(digest, now, own)
        if own:
            self.echoes += 1
        elif not fresh:
            self.heard_twice += 1
        return fresh

    def said(self, frame: bytes, now: float) -> None:
        """An own MAVLink 2 frame is about to leave."""
        assert frame[0] == MAGIC_V2
        digest = hash((frame[4], frame[5], frame[6], frame[10 : 10 + frame[1]]))
        self._known.pop(digest, None)
        self._remember(digest, now, True)

    def _remember(self, digest: int, now: float, own: bool) -> None:
        known = self._known
        known[digest] = (now, own)
        while len(known) > MAX_REMEMBERED:
            del known[next(iter(known))]

"""A port whose other end signs with one key: that of an autopilot with MAVLink signing.

No clock is needed. As https://mavlink.io/en/guide/message_signing.html says, both ends raise their timestamps to those
that they hear. So a node that starts with an old timestamp is ignored until it has heard its autopilot, and an
autopilot whose timestamps have gone back is ignored until it has heard the node.
"""

from __future__ import annotations

from .frames import MAGIC_V1, Stream
from .identity import AUTOPILOT_COMPONENT
from .messages import RADIO_STATUS
from .signing import SignatureCheck, Signer, SigningKey

#: Timestamps in a second.
PER_SECOND = 100_000
#: The first frame of a stream may be older than the newest one of all streams by a minute. ArduPilot has the same rule.
LEEWAY = 60 * PER_SECOND
#: Frames with a higher timestamp (the year 2059) are refused, so that nobody can use up all timestamps.
MOST = 1 << 47
#: Other streams than these are refused. An autopilot forwards those of 16.
MAX_STREAMS = 64
#: Link id of all programs that use a node's port. An autopilot remembers 16 streams and forgets none until it restarts.
LINK_ID = 0


class SignedPort(SignatureCheck):
    """Signs what leaves on the port, and lets in what is signed with the key and new, and RADIO_STATUS.

    Frames must come in the order in which they were sent, as they do on a wire.
    """

    __slots__ = ("_newest", "_signer", "_start", "_streams", "mavlink_1", "old")

    def __init__(self, key: SigningKey, start: int) -> None:
        """:param start: `next` of the last program that used the port. 0: there was none, or it is not known.

        An older frame of the autopilot is a repetition.
        """
        super().__init__(key, lambda message_id: message_id != RADIO_STATUS)
        self._start = self._newest = start
        self._signer: Signer = key.signer(LINK_ID, start)
        self._streams: dict[Stream, int] = {}
        self.old = 0
        """Frames with the right signature that were refused: heard before, too old, or of too many streams."""
        self.mavlink_1 = 0
        """Those of the unsigned frames that are MAVLink 1, which has no signatures."""

    @property
    def next(self) -> int:
        """The next timestamp: above all that were heard and used. 48 bits."""
        return self._signer.timestamp

    @property
    def newest(self) -> int:
        """The highest timestamp heard, or `start`."""
        return self._newest

    def sign(self, frame: bytes) -> bytes:
        """A frame as it leaves. Call it in the order of leaving.

        :param frame: with incompatibility flag 1 (`FrameWriter.flags`).
        """
        return self._signer.sign(frame)

    def passes(self, frame: bytes, message_id: int, *, signed: bool) -> bool:
        """As in `SignatureCheck`."""
        if not super().passes(frame, message_id, signed=signed):
            self.mavlink_1 += frame[0] == MAGIC_V1
            return False
        if not signed or not self._needed(message_id) or self._is_new(frame):
            return True
        self.old += 1
        return False

    def report(self) -> dict[str, int]:
        """As in `SignatureCheck`."""
        return {"unsigned": self.unsigned, "mavlink_1": self.mavlink_1, "forged": self.forged, "old": self.old}

    def _is_new(self, frame: bytes) -> bool:
        stream = frame[5], frame[6], frame[-13]
        timestamp = int.from_bytes(frame[-12:-6], "little")
        last = self._streams.get(stream)
        if last is None:
            least = self._newest - LEEWAY
            if frame[6] == AUTOPILOT_COMPONENT:
                least = max(least, self._start)
            new = timestamp >= least and len(self._streams) < MAX_STREAMS
        else:
            new = timestamp > last
        if not new or timestamp >= MOST:
            return False
        self._streams[stream] = timestamp
        self._newest = max(self._newest, timestamp)
        self._signer.raise_to(timestamp + 1)
        return True

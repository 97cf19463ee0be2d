"""Signatures of MAVLink 2 frames (https://mavlink.io/en/guide/message_signing.html).

Behind the checksum of a signed frame stand 13 bytes: a link id (1), a timestamp (6, little-endian, in units of 10 us
since 2015-01-01 UTC), and the first 48 bits of SHA-256 over the key, the frame with its checksum, the link id and the
timestamp.

The timestamps of a stream (system id, component id, link id) only ever rise, so an old frame cannot be played again.
They rise by one with each frame. Because a clock is not at hand here, it is passed in by `set_time`.
"""

from __future__ import annotations

import hashlib
import hmac

SIGNATURE_SIZE = 13
KEY_SIZE = 32
#: A stream not heard before may be this much behind the verifier's clock: 60 s in units of 10 us.
NEW_STREAM_WINDOW = 60 * 100_000
#: Streams that a verifier remembers.
MAX_STREAMS = 1024

_EPOCH_UNIX = 1_420_070_400
_TICKS_PER_SECOND = 100_000
_TIMESTAMP_MASK = (1 << 48) - 1


def signing_timestamp(now_unix: float) -> int:
    """Unix time in seconds as a signature's timestamp: units of 10 us since 2015-01-01, 0 for earlier times."""
    return max(0, int((now_unix - _EPOCH_UNIX) * _TICKS_PER_SECOND))


def _keyed_hash(key: bytes) -> hashlib._Hash:
    if len(key) != KEY_SIZE:
        raise ValueError(f"a signing key has {KEY_SIZE} bytes, not {len(key)}")
    return hashlib.sha256(key)


class Signer:
    """Signs the frames that leave by one link.

    `timestamp` is that of the next frame. It must never fall, not even over a restart: store it, and start from the
    larger of what was stored and the clock.
    """

    __slots__ = ("_hash", "_link", "timestamp")

    def __init__(self, key: bytes, link_id: int, timestamp: int) -> None:
        """:param key: 32 bytes, the same on all systems.
        :param link_id: 0..255; each link of a component has its own.
        :param timestamp: of the first frame, in units of 10 us since 2015-01-01 UTC.
        :raises ValueError: a key, link id or timestamp out of its range.
        """
        if not 0 <= timestamp <= _TIMESTAMP_MASK:
            raise ValueError(f"a signing timestamp has 48 bits, not {timestamp}")
        self._hash = _keyed_hash(key)
        self._link = bytes((link_id,))
        self.timestamp = timestamp

    def set_time(self, now_unix: float) -> None:
        """Raise the timestamp to the clock (Unix time in seconds); never lowers it. Call it about once a second."""
        self.raise_to(signing_timestamp(now_unix))

    def raise_to(self, timestamp: int) -> None:
        """Raise the timestamp to one that was heard (`Verifier.clock`); never lowers it.

        An autopilot whose clock is ahead refuses a companion that has not taken over its time.
        """
        if timestamp > self.timestamp:
            self.timestamp = timestamp & _TIMESTAMP_MASK

    def sign(self, frame: bytes) -> bytes:
        """The frame with its signature behind it.

        :param frame: from the magic byte to the checksum, incompatibility flag 1 set.
        """
        timestamp = self.timestamp
        self.timestamp = (timestamp + 1) & _TIMESTAMP_MASK
        frame += self._link + timestamp.to_bytes(6, "little")
        digest = self._hash.copy()
        digest.update(frame)
        return frame + digest.digest()[:6]


class Verifier:
    """Checks the signatures of what arrives, and refuses what was heard before.

    A stream's timestamp is noted only after the signature has proved good: else one forged frame with a timestamp far
    ahead would lock out the real sender.

    At most `MAX_STREAMS` streams are remembered. In a full table only streams that are more than a minute behind the
    clock make room: frames of theirs that are played again are then refused as too old, so nothing is lost. If there
    are none, new streams are refused.
    """

    __slots__ = ("_hash", "_streams", "accept_unsigned", "clock", "forged", "replayed")

    def __init__(self, key: bytes, *, accept_unsigned: bool = False) -> None:
        """:param key: 32 bytes, the same on all systems.
        :param accept_unsigned: whether unsigned frames pass. Frames with a bad signature never do.
        :raises ValueError: a key that has not 32 bytes.
        """
        self._hash = _keyed_hash(key)
        self._streams: dict[tuple[int, int, int], int] = {}
        self.accept_unsigned = accept_unsigned
        self.clock = 0
        """The newest time known, from `set_time` or from an accepted frame, in units of 10 us since 2015-01-01 UTC."""
        self.forged = 0
        """Frames whose signature does not fit the key."""
        self.replayed = 0
        """Frames with a good signature that were not newer than the stream's last, or too old for a new stream, or of
        a new stream in a full table."""

    def set_time(self, now_unix: float) -> None:
        """Raise the own clock (Unix time in seconds); never lowers it."""
        self.clock = max(self.clock, signing_timestamp(now_unix))

    def verify(self, frame: bytes) -> bool:
        """Whether a signed frame is genuine and new. A frame for which this says yes is refused the next time.

        :param frame: the whole frame, from the magic byte to the last byte of the signature.
        """
        digest = self._hash.copy()
        digest.update(frame[:-6])
        if not hmac.compare_digest(digest.digest()[:6], frame[-6:]):
            self.forged += 1
            return False
        timestamp = int.from_bytes(frame[-12:-6], "little")
        stream = (frame[5], frame[6], frame[-13])
        if not self._is_new(stream, timestamp):
            self.replayed += 1
            return False
        self._streams[stream] = timestamp
        if timestamp > self.clock:
            self.clock = timestamp
        return True

    def _is_new(self, stream: tuple[int, int, int], timestamp: int) -> bool:
        last = self._streams.get(stream)
        if last is not None:
            return timestamp > last
        oldest = self.clock - NEW_STREAM_WINDOW
        if timestamp < oldest:
            return False
        if len(self._streams) >= MAX_STREAMS:
            self._streams = {known: heard for known, heard in self._streams.items() if heard >= oldest}
        return len(self._streams) < MAX_STREAMS

"""Signatures of MAVLink 2 frames (https://mavlink.io/en/guide/message_signing.html).

The signature is 13 bytes after the checksum: a link id (1), a timestamp (6, little-endian, in units of 10 us since
2015-01-01 UTC), and the first 48 bits of SHA-256 over the key, the frame with its checksum, the link id and the
timestamp.

The timestamps of a stream (system id, component id, link id) only rise, so an old frame cannot be replayed. They rise
by one with each frame. This module has no clock: `set_time` provides the time.
"""

from __future__ import annotations

import hashlib
import hmac

SIGNATURE_SIZE = 13
KEY_SIZE = 32
#: A new stream may be this far behind the verifier's clock: 60 s in units of 10 us.
NEW_STREAM_WINDOW = 60 * 100_000
#: Streams that a verifier remembers.
MAX_STREAMS = 1024

_EPOCH_UNIX = 1_420_070_400
_TICKS_PER_SECOND = 100_000
_TIMESTAMP_MASK = (1 << 48) - 1


def signing_timestamp(now_unix: float) -> int:
    """Convert Unix time in seconds to a signature's timestamp: units of 10 us since 2015-01-01; 0 for earlier times."""
    return max(0, int((now_unix - _EPOCH_UNIX) * _TICKS_PER_SECOND))


def _keyed_hash(key: bytes) -> hashlib._Hash:
    if len(key) != KEY_SIZE:
        raise ValueError(f"a signing key has {KEY_SIZE} bytes, got {len(key)}")
    return hashlib.sha256(key)


class Signer:
    """Signs the frames that leave through one link.

    `timestamp` is that of the next frame. It must never fall, not even across a restart: store it, and start from the
    stored value or the clock, whichever is larger.
    """

    __slots__ = ("_hash", "_link", "timestamp")

    def __init__(self, key: bytes, link_id: int, timestamp: int) -> None:
        """:param key: 32 bytes, the same on all systems.
        :param link_id: 0..255; each link of a component has its own.
        :param timestamp: of the first frame, in units of 10 us since 2015-01-01 UTC.
        :raises ValueError: a key, link id or timestamp out of range.
        """
        if not 0 <= timestamp <= _TIMESTAMP_MASK:
            raise ValueError(f"a signing timestamp has 48 bits, got {timestamp}")
        self._hash = _keyed_hash(key)
        self._link = bytes((link_id,))
        self.timestamp = timestamp

    def set_time(self, now_unix: float) -> None:
        """Raise the timestamp to the clock (Unix time in seconds); never lowers it. Call it about once a second."""
        self.raise_to(signing_timestamp(now_unix))

    def raise_to(self, timestamp: int) -> None:
        """Raise the timestamp to one that was heard (`Verifier.clock`); never lowers it.

        An autopilot whose clock is ahead refuses a companion that has not adopted its time.
        """
        if timestamp > self.timestamp:
            self.timestamp = timestamp & _TIMESTAMP_MASK

    def sign(self, frame: bytes) -> bytes:
        """The frame, followed by its signature.

        :param frame: from the magic byte to the checksum, with incompatibility flag 1 set.
        """
        timestamp = self.timestamp
        self.timestamp = (timestamp + 1) & _TIMESTAMP_MASK
        frame += self._link + timestamp.to_bytes(6, "little")
        digest = self._hash.copy()
        digest.update(frame)
        return frame + digest.digest()[:6]


class Verifier:
    """Checks the signatures of incoming frames, and refuses frames that were heard before.

    A stream's timestamp is stored only after its signature was verified. Otherwise one forged frame with a timestamp
    far ahead would lock out the real sender.

    At most `MAX_STREAMS` streams are remembered. If the table is full, only streams more than a minute behind the clock
    are forgotten. Replayed frames of theirs are then refused as too old, so forgetting them is safe. If there are none,
    new streams are refused.
    """

    __slots__ = ("_hash", "_streams", "accept_unsigned", "clock", "forged", "replayed")

    def __init__(self, key: bytes, *, accept_unsigned: bool = False) -> None:
        """:param key: 32 bytes, the same on all systems.
        :param accept_unsigned: whether unsigned frames pass. Frames with a wrong signature never pass.
        :raises ValueError: a key that does not have 32 bytes.
        """
        self._hash = _keyed_hash(key)
        self._streams: dict[tuple[int, int, int], int] = {}
        self.accept_unsigned = accept_unsigned
        self.clock = 0
        """The latest known time, from `set_time` or from an accepted frame, in units of 10 us since 2015-01-01 UTC."""
        self.forged = 0
        """Frames whose signature does not match the key."""
        self.replayed = 0
        """Frames with a good signature that were not newer than the stream's last one, too old for a new stream, or
        from a new stream when the table was full."""

    def set_time(self, now_unix: float) -> None:
        """Raise the verifier's clock (Unix time in seconds); never lowers it."""
        self.clock = max(self.clock, signing_timestamp(now_unix))

    def verify(self, frame: bytes) -> bool:
        """Whether a signed frame is genuine and new. A frame that is accepted once is refused the next time.

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

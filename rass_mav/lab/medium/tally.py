"""What has been put on the air: counts, and a hash of all bytes."""

from __future__ import annotations

import hashlib
from collections.abc import Callable

#: Called with each frame put on the air, and its step.
Record = Callable[[bytes, int], None]
# Bytes of frames that are hashed together: one call for each frame would cost more than its bytes.
_HASH_BYTES = 1 << 14


class Tally:
    """The base class of every air."""

    def __init__(self, record: Record | None) -> None:
        """`record` is called with each frame put on the air and its step, in order."""
        self._record = record
        self._hash = hashlib.sha256()
        self._unhashed = bytearray()
        self.sent = 0
        """Frames put on the air."""
        self.dropped = 0
        """Frames lost, one for each hearer that lost it."""
        self.bytes_sent = 0

    def count(self, frame: bytes, step: int) -> None:
        """A frame is put on the air at `step`."""
        self.sent += 1
        self.bytes_sent += len(frame)
        unhashed = self._unhashed
        unhashed += frame
        if len(unhashed) >= _HASH_BYTES:
            self._take_in()
        if self._record is not None:
            self._record(frame, step)

    @property
    def sha256(self) -> str:
        """SHA-256 over all frames put on the air, in order, in hexadecimal."""
        self._take_in()
        return self._hash.hexdigest()

    def _take_in(self) -> None:
        self._hash.update(self._unhashed)
        self._unhashed.clear()

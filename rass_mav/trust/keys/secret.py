"""Secret bytes that do not show themselves, and the keys that are derived from them."""

from __future__ import annotations

from enum import Enum, unique
from hashlib import blake2b
from hmac import compare_digest
from typing import NoReturn

#: Bytes of a secret.
SECRET_SIZE = 32


@unique
class Purpose(bytes, Enum):
    """What a key, a signature or a digest is for. With different purposes the same bytes have nothing in common.

    At most 16 bytes (the personalisation of BLAKE2b).
    """

    GROUND_SIGNS = b"rass ground sign"
    GROUND_OPENS = b"rass ground seal"
    NODE = b"rass node secret"
    LINK = b"rass link key"
    PAIR = b"rass pair key"
    SEAL = b"rass seal key"
    LOSS = b"rass loss key"
    MISSION = b"rass mission"
    CERTIFICATE = b"rass certificate"
    STATEMENT_SIGNATURE = b"rass voucher"
    ANCHOR = b"rass anchor"
    CHAIN = b"rass chain"
    FILE = b"rass key file"
    KEY_UPDATE = b"rass letter"
    KEY_UPDATE_KEY = b"rass letter key"
    AUTOPILOT = b"rass autopilot"
    BEACONS = b"rass beacon keys"


class Secret:
    """A secret of 32 bytes. It appears in no representation, no message and no pickle."""

    __slots__ = ("_bytes",)

    def __init__(self, value: bytes) -> None:
        """:raises ValueError: not 32 bytes."""
        if len(value) != SECRET_SIZE:
            raise ValueError(f"a secret has {SECRET_SIZE} bytes, got {len(value)}")
        self._bytes = value

    def reveal(self) -> bytes:
        """The bytes, for a cipher or a file."""
        return self._bytes

    def derive(self, purpose: Purpose, about: bytes = b"") -> Secret:
        """Another secret, which does not tell this one: BLAKE2b-256 of `about`, keyed and personalised (RFC 7693)."""
        return Secret(blake2b(about, digest_size=SECRET_SIZE, key=self._bytes, person=purpose).digest())

    def __repr__(self) -> str:
        return "Secret(hidden)"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Secret) and compare_digest(self._bytes, other._bytes)

    __hash__ = None  # type: ignore[assignment]

    def __reduce__(self) -> NoReturn:
        raise TypeError("a secret is not pickled or copied")

"""The key of a drone's autopilot, for MAVLink signing (docs/how-to/autopilot.md).

Ground station programs take a passphrase, and use its SHA-256 as the key. The drone's secret gives the passphrase, and
nothing more has to be kept: the ground can always tell which one a drone's autopilot has.
"""

from __future__ import annotations

from base64 import b32encode
from hashlib import sha256

from .secret import Purpose, Secret

_GROUPS, _KEY_UPDATES = 5, 5


def autopilot_passphrase(secret: Secret) -> str:
    """The passphrase, 125 bits: 25 of `a` to `z` and `2` to `7`, in five groups with hyphens, which belong to it.

    :param secret: the drone's. Show the result only on request.
    """
    text = b32encode(secret.derive(Purpose.AUTOPILOT).reveal()).decode("ascii").lower()
    return "-".join(text[_KEY_UPDATES * group :][:_KEY_UPDATES] for group in range(_GROUPS))


def autopilot_key(secret: Secret) -> Secret:
    """The key that the autopilot and the node sign with."""
    return Secret(sha256(autopilot_passphrase(secret).encode("ascii")).digest())

"""pymavlink as the second opinion: builds and parses frames without a line of ours."""

from __future__ import annotations

from hashlib import sha256 as _sha256
from typing import Any

from pymavlink.dialects.v20 import common

KEY = bytes(range(100, 132))


def sender(system_id: int, component_id: int, sequence: int = 0, signing: tuple[bytes, int, int] | None = None) -> Any:
    """A pymavlink sender; `signing` is (key, link id, timestamp)."""
    mav = common.MAVLink(None, system_id, component_id)
    mav.seq = sequence
    if signing is not None:
        mav.signing.secret_key, mav.signing.link_id, mav.signing.timestamp = signing
        mav.signing.sign_outgoing = True
    return mav


def tunnel(data: bytes, payload_type: int, target_system: int, target_component: int) -> Any:
    """A TUNNEL message; pymavlink wants all 128 bytes."""
    return common.MAVLink_tunnel_message(
        target_system, target_component, payload_type, len(data), data.ljust(128, b"\0")
    )


def heartbeat(sequence: int = 0, system_id: int = 1) -> bytes:
    """A whole frame with some autopilot's heartbeat."""
    message = common.MAVLink_heartbeat_message(2, 3, 81, 5, 4, 3)
    return bytes(message.pack(sender(system_id, 1, sequence)))


def sha256(passphrase: str) -> bytes:
    """The key that ground stations make of a passphrase."""
    return _sha256(passphrase.encode()).digest()

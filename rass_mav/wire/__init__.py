"""TUNNEL payloads <-> core's messages. docs/protocol.md describes the format, with golden vectors."""

from .codec import INLINE_BYTES, MAX_TUNNEL, beacon_sender, decode, encode, is_overheard, target_of

__all__ = ["INLINE_BYTES", "MAX_TUNNEL", "beacon_sender", "decode", "encode", "is_overheard", "target_of"]

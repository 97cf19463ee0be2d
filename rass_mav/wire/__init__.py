"""TUNNEL payloads <-> core's messages. The format is stated in docs/protocol.md, with golden vectors."""

from .codec import INLINE_BYTES, MAX_TUNNEL, decode, encode, target_of

__all__ = ["INLINE_BYTES", "MAX_TUNNEL", "decode", "encode", "target_of"]

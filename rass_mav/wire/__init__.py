"""TUNNEL payloads <-> core's messages. docs/reference/protocol.md describes the format, with golden vectors."""

from .codec import MAX_TUNNEL, beacon_sender, decode, encode, is_overheard, target_of

__all__ = ["MAX_TUNNEL", "beacon_sender", "decode", "encode", "is_overheard", "target_of"]

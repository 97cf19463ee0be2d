"""Reading the tags of messages: whether nodes have said what ends custody, or is about copies, in their name.

docs/protocol.md ("Words between two nodes") has the rules. The codec writes tags, and ignores them when it reads.
"""

from __future__ import annotations

from itertools import zip_longest
from struct import Struct
from typing import NamedTuple, Protocol

from rass_mav.core.fingerprints import CRC_MASK
from rass_mav.core.messages import BROADCAST, Beacon, Committed, Data, Message, PassedOn, Word, Words

from .codec import COMMITTED, PASSED_ON, PLACE_BYTES, TAG_BYTES, TAGS, WORDS, answer_said

_BEACON_BYTES = 43
_DATA_HEAD, _DATUM_HEAD = 6, 25
_SENDER_BYTES, _ANSWER_HEAD, _DONE_BYTES, _NUMBER_BYTES = 3, 4, 8, 4
_ROWS_HEAD = 6
_ROW_BYTES = {PASSED_ON: 10, WORDS: 11}
_BACKER = Struct(f"<H{TAG_BYTES}s")
_PLACE = Struct("<I")


class Said(NamedTuple):
    """What a tag shows that `sender` has said to this node."""

    sender: int
    type: int
    """Of the message, on the wire."""
    data: bytes
    """What the tag covers, but for a word's place."""
    tag: bytes
    """Empty: there is none."""
    place: int | None = None
    """Of a word, 32 bits; None: of an answer."""


class Checks(Protocol):
    """What a node with keys knows."""

    def fingerprint(self, number: int) -> int | None:
        """What was last handed over under this number; None: nothing is known."""

    def is_said(self, said: Said) -> bool:
        """Whether the sender has said this, and it is new if it has a place."""


def believed(message: Message, payload: bytes, own: int, checks: Checks) -> Message | None:
    """The message without what its sender has not said to this node, for all that is known; None: nothing is left. What
    is for other nodes may stay.

    :param payload: the TUNNEL payload from which it was decoded. :param own: this node's id.
    """
    if type(message) is Beacon or type(message) is Data:
        for answer in message.answers:
            if answer.target == own:
                break
        else:
            # Answers to others end nothing here.
            return message
        tags = _tags_in(payload, _end_of_fields(message))
        kept = [
            answer
            for answer, tag in zip_longest(message.answers, tags[: len(message.answers)], fillvalue=b"")
            if type(answer) is Committed and answer.target == own and _is_answered(answer, tag or b"", checks)
        ]
        return message._replace(answers=tuple(kept))
    if type(message) is Committed:
        end = _SENDER_BYTES + _ANSWER_HEAD + _DONE_BYTES * len(message.committed)
        end += _NUMBER_BYTES * len(message.refused)
        return message if _is_answered(message, payload[end : end + TAG_BYTES], checks) else None
    if type(message) is PassedOn:
        return message if _is_told(message, PASSED_ON, len(message.ids), payload, own, checks) else None
    if type(message) is Words:
        if message.target == BROADCAST:
            # Everybody may ask everybody.
            return message._replace(entries=tuple([entry for entry in message.entries if entry.word == Word.WANTED]))
        return message if _is_told(message, WORDS, len(message.entries), payload, own, checks) else None
    return message


def _end_of_fields(message: Beacon | Data) -> int:
    if isinstance(message, Beacon):
        return _BEACON_BYTES
    return _DATA_HEAD + sum(_DATUM_HEAD + len(datum.payload) for _, datum in message.handovers)


def _tags_in(payload: bytes, at: int) -> list[bytes]:
    """The tags in the blocks of a payload that the codec has read."""
    tags = []
    while at < len(payload):
        kind, size = payload[at], payload[at + 1]
        at += 2
        if kind == TAGS:
            tags += [payload[i : i + TAG_BYTES] for i in range(at, at + size, TAG_BYTES)]
        at += size
    return tags


def _is_answered(answer: Committed, tag: bytes, checks: Checks) -> bool:
    confirmed = []
    for number, crc in answer.committed:
        fingerprint = checks.fingerprint(number)
        if fingerprint is None or fingerprint & CRC_MASK != crc:
            # Without it nothing can be known of the rest.
            return False
        confirmed.append((number, fingerprint))
    return checks.is_said(Said(answer.sender, COMMITTED, answer_said(answer._replace(committed=tuple(confirmed))), tag))


def _is_told(message: PassedOn | Words, type_: int, rows: int, payload: bytes, own: int, checks: Checks) -> bool:
    end = _ROWS_HEAD + rows * _ROW_BYTES[type_]
    place, tags = payload[end : end + PLACE_BYTES], payload[end + PLACE_BYTES :]
    if len(place) < PLACE_BYTES:
        return checks.is_said(Said(message.sender, type_, payload[:end], b"", 0))
    tag = tags[:TAG_BYTES]
    if message.target == BROADCAST:
        named = (_BACKER.unpack_from(tags, at) for at in range(0, len(tags) - _BACKER.size + 1, _BACKER.size))
        tag = next((tag for node_id, tag in named if node_id == own), b"")
        if not tag:
            # It is for others.
            return False
    return checks.is_said(Said(message.sender, type_, payload[:end], tag, *_PLACE.unpack(place)))

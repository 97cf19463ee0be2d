"""Reading the tags of messages: whether nodes have said what ends custody, or is about copies, in their name.

docs/reference/protocol-keys.md ("Tags between two nodes") has the rules. The codec writes tags, and ignores
them when it reads.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import zip_longest
from typing import NamedTuple, Protocol

from rass_mav.core.messages import BROADCAST, Beacon, Committed, CopyStatus, CopyStatuses, Message
from rass_mav.core.seals import CRC_MASK

from .codec import BEACON_BYTES, answer_claim
from .generated import (
    COMMITTED,
    COMMITTED_FIELDS,
    COPY_STATUS_ENTRY_FIELDS,
    COPY_STATUSES,
    COPY_STATUSES_FIELDS,
    PAIR_FIELDS,
    REFUSED_FIELDS,
    TAGS,
)
from .parts import PLACE, PLACE_BYTES, TAG_BYTES


class Claim(NamedTuple):
    """What a tag shows that `sender` has said to this node."""

    sender: int
    type: int
    """Of the message, on the wire."""
    data: bytes
    """What the tag covers, but for a message's place."""
    tag: bytes
    """Empty: there is none."""
    place: int | None = None
    """Of a message, 32 bits; None: of an answer."""


class Checks(Protocol):
    """What a node with keys knows."""

    def content_hash(self, number: int) -> int | None:
        """What was last handed over under this number; None: nothing is known."""

    def is_true(self, claim: Claim) -> bool:
        """Whether the sender has said this, and it is new if it has a place."""


def believed(message: Message, payload: bytes, own: int, checks: Checks) -> Message | None:
    """The message without what its sender has not said to this node, for all that is known; None: nothing is left. What
    is for other nodes may stay.

    :param payload: the TUNNEL payload from which it was decoded. :param own: this node's id.
    """
    if type(message) is Beacon:
        for answer in message.answers:
            if answer.target == own:
                break
        else:
            # Answers to others end nothing here.
            return message
        tags = tags_in(payload, BEACON_BYTES)
        kept = [
            answer
            for answer, tag in zip_longest(message.answers, tags[: len(message.answers)], fillvalue=b"")
            if type(answer) is Committed and answer.target == own and _is_answered(answer, tag or b"", checks)
        ]
        return message._replace(answers=tuple(kept))
    if type(message) is Committed:
        end = end_of_fields(message)
        return message if _is_answered(message, payload[end : end + TAG_BYTES], checks) else None
    if type(message) is CopyStatuses:
        if message.target == BROADCAST:
            # Everybody may ask everybody.
            return message._replace(
                entries=tuple([entry for entry in message.entries if entry.status == CopyStatus.WANTED])
            )
        return message if _is_authentic(message, payload, checks) else None
    return message


def is_tagged(message: Message) -> bool:
    """Whether a message that is `believed` had a tag for all that it says."""
    return type(message) is Committed or (type(message) is CopyStatuses and message.target != BROADCAST)


def end_of_fields(message: Committed | CopyStatuses) -> int:
    """Where in its payload the blocks of a message begin, or its place and its tags."""
    if isinstance(message, Committed):
        numbers = PAIR_FIELDS.size * len(message.committed) + REFUSED_FIELDS.size * len(message.refused)
        return COMMITTED_FIELDS.size + numbers
    return COPY_STATUSES_FIELDS.size + COPY_STATUS_ENTRY_FIELDS.size * len(message.entries)


def blocks_in(payload: bytes, at: int) -> Iterator[tuple[int, bytes]]:
    """The kinds and contents of the blocks of a payload that the codec has read, from `at` to the end."""
    while at < len(payload):
        kind, size = payload[at], payload[at + 1]
        at += 2
        yield kind, payload[at : at + size]
        at += size


def tags_in(payload: bytes, at: int) -> list[bytes]:
    """The tags of the answers in a payload that the codec has read, whose blocks begin at `at`."""
    tags = []
    for kind, content in blocks_in(payload, at):
        if kind == TAGS:
            tags += [content[i : i + TAG_BYTES] for i in range(0, len(content), TAG_BYTES)]
    return tags


def _is_answered(answer: Committed, tag: bytes, checks: Checks) -> bool:
    confirmed = []
    for number, crc in answer.committed:
        content_hash = checks.content_hash(number)
        if content_hash is None or content_hash & CRC_MASK != crc:
            # Without it nothing can be known of the rest.
            return False
        confirmed.append((number, content_hash))
    return checks.is_true(
        Claim(answer.sender, COMMITTED, answer_claim(answer._replace(committed=tuple(confirmed))), tag)
    )


def _is_authentic(statuses: CopyStatuses, payload: bytes, checks: Checks) -> bool:
    fields = payload[: end_of_fields(statuses)]
    place, tag = tag_of(statuses, payload)
    return checks.is_true(Claim(statuses.sender, COPY_STATUSES, fields, tag, place or 0))


def tag_of(statuses: CopyStatuses, payload: bytes) -> tuple[int | None, bytes]:
    """The place, 32 bits, and the tag of what is said to one node; None: it has none, and no tag."""
    end = end_of_fields(statuses)
    place, tag = payload[end : end + PLACE_BYTES], payload[end + PLACE_BYTES : end + PLACE_BYTES + TAG_BYTES]
    return (PLACE.unpack(place)[0], tag) if len(place) == PLACE_BYTES else (None, b"")

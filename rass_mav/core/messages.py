"""The messages that nodes send to each other. `rass_mav.wire` turns these into TUNNEL payloads and back.

Node ids are 16 bits. Fields that leave a node are bounded as stated, so that a message always fits the wire. The
decorator of each kind of message states what other code needs to know: which nodes receive it, how urgent it is, and
what it depends on. No message leaves before what it depends on is on disk; the agent ensures that.
"""

from __future__ import annotations

import enum
from collections.abc import Callable, Hashable, Iterable
from typing import Any, NamedTuple, TypeAlias, TypeVar

from rass_mav.core.datum import Datum, DatumId

#: As a target: every neighbour. Not a valid node id.
BROADCAST = 0xFFFF
#: What a `Distance` takes on the wire.
DISTANT_BYTES = 7
#: Largest payload of a datum that goes whole in one frame. Larger data go in chunks.
INLINE_BYTES = 97
#: Largest payload of a chunk.
CHUNK_BYTES = 123
#: Bits in the report of a transfer: of an Accept or of a Sack, and of the other transfers in a Sack.
REPORT_BITS, OTHER_BITS = 256, 128
#: The most other transfers in a Sack.
MAX_OTHERS = 3
#: As a hop count: no route.
NO_ROUTE = 255
#: Free items or potential of a node without bounds (a base).
UNBOUNDED_FREE = 0xFFFF


class Target(enum.Enum):
    """Which nodes receive a kind of message."""

    EVERYBODY = enum.auto()
    """Every neighbour; the message has no target."""
    NAMED = enum.auto()
    """The `target` that the message names, on the wire after the sender; BROADCAST: every neighbour."""
    HANDLE = enum.auto()
    """The node that knows its handle. `target` is for the link, and is not on the wire."""


class Urgency(enum.IntEnum):
    """What goes first where airtime is short."""

    VEHICLE = 0
    """To the autopilot, and to the ground station behind it. There is little of it, and the sender paces it
    (`Pacer.vehicle_rate`): a heartbeat has to be the first frame on a port."""
    BEACON = 1
    ANSWER = 2
    """A neighbour waits for it: until it arrives, the neighbour keeps its datum and sends it again."""
    DATA = 3
    BULK = 4
    """A piece of a large datum. There may be thousands: they take the airtime that all else leaves."""


#: What a message depends on: these data are on disk (none: it depends on nothing), or None: on all earlier changes.
Rests: TypeAlias = Callable[[Any], Iterable[DatumId] | None]


class MessageKind(NamedTuple):
    """The common properties of all messages of a kind."""

    target: Target
    urgency: Urgency
    rests: Rests
    """Called for each message."""


#: All kinds of messages.
KINDS: dict[type, MessageKind] = {}
_M = TypeVar("_M", bound=type)


def _kind(target: Target, urgency: Urgency, rests: Rests) -> Callable[[_M], _M]:
    def register(message: _M) -> _M:
        KINDS[message] = MessageKind(target, urgency, rests)
        return message

    return register


def _on_nothing(message: Any) -> Iterable[DatumId]:
    return ()


def _on_all_changes(message: Any) -> None:
    return None


@_kind(Target.NAMED, Urgency.ANSWER, lambda answer: None if answer.committed else ())
class Committed(NamedTuple):
    """The receiver's answer: these hand-overs are on disk, custody has passed; those were refused."""

    sender: int
    target: int
    committed: tuple[tuple[int, int], ...]
    """(hand-over number, content hash of what is on disk). Only the low 32 bits of a content hash are on the wire, its
    CRC-32; where there are keys, the rest is in the proof of who says so (`rass_mav.core.seals`)."""
    refused: tuple[int, ...]
    """Hand-over numbers that were not accepted (no space): the sender keeps custody."""


class Route(NamedTuple):
    """A base's announcement as a node relays it (Alg. 2, with the sequence numbers of Babel, RFC 8966)."""

    base: int
    """Node id of the base."""
    base_life: int
    """The base's life (32 bits): a wiped base is another base."""
    number: int
    """The base's announcement number, 16 bits, compared by RFC 1982."""
    hops: int
    """Hops from the sending node to the base, 0 (the base itself) .. 254."""


@_kind(Target.EVERYBODY, Urgency.BEACON, _on_nothing)
class Beacon(NamedTuple):
    """The one-hop broadcast, sent once a turn."""

    sender: int
    life: int
    """The sender's life: it distinguishes two nodes with the same id, and a wiped node from its former self."""
    number: int
    """Beacon number, 16 bits, RFC 1982: an older or equal one is a duplicate."""
    flags: int
    """Bit 0: the sender is a base. Bit 1: `wanted_*` holds a request."""
    base: int
    base_life: int
    route_number: int
    hops: int
    """The chosen route; `hops` NO_ROUTE: none, the other three are 0."""
    wanted_base: int
    wanted_number: int
    """With flag bit 1: the sender needs an announcement of this base at least as new as this number."""
    risk: int
    """Local risk, 0..65535 for 0..1."""
    free: int
    """Items that can still be accepted, 0..65535 (65535: no bound). Replicas count as free."""
    policy: int
    """Tag of the policy and its weights, 16 bits; potentials of different tags cannot be compared."""
    potential: int
    """The policy's potential (fitness phi) in fixed point, 32 bits; see `rass_mav.policy`."""
    statements_hash: int
    """Hash of what the sender knows from receipts, 32 bits; if two are equal, there is nothing to send. 0: do not
    compare."""
    turn: int = 0
    """The time between the sender's beacons in tenths of a second, 16 bits, if its link cannot carry one a step; 0: one
    a step, as usual."""
    answers: tuple[Committed, ...] = ()
    """Answers of the last turn once more, for neighbours that have not heard them; only to data that are on disk."""
    moves: int = 0
    """Where the sender is and how it moves, 64 bits (`rass_mav.core.routes.contacts`); 0: not told."""
    proof: bytes = b""
    """What shows that the sender has heard of its route, 8 bytes; the agent adds and checks it. Empty: none."""
    key: bytes = b""
    """What shows that the sender itself has made this beacon, 8 bytes; the agent adds and checks it. Empty: none."""
    updates: int = 0
    """Which key updates the sender has, 32 bits; the agent adds it. 0: not to be compared."""


BEACON_BASE = 1
BEACON_WANTED = 2


class Handover(NamedTuple):
    """One datum that is being handed over to one neighbour."""

    number: int
    """Drawn by the sender (32 bits, not 0); 0: no custody is offered and no answer wanted."""
    datum: Datum


class Distance(NamedTuple):
    """How a distant replica keeps away from the custodian of its datum."""

    near: int
    """The sender keeps its replica for this node. A receiver that hears it refuses."""
    custodian: int
    """The same for this one, which has custody."""
    further: int
    """How many nodes still farther away should have a copy, 0..255."""


@_kind(Target.NAMED, Urgency.DATA, lambda data: [handover.datum.id for handover in data.handovers])
class Data(NamedTuple):
    """Small data, whole, with their hand-over numbers; several to a frame where they fit. Every node in range hears
    it."""

    sender: int
    target: int
    handovers: tuple[Handover, ...]
    replica: bool = False
    """True: custody stays with the sender. The receiver should keep replicas, and answers as to a hand-over."""
    distance: Distance | None = None
    """With `replica`: the sender has replicas itself, and these are distant ones. None: it has custody."""


@_kind(Target.NAMED, Urgency.DATA, lambda offer: (offer.id,))
class Offer(NamedTuple):
    """A datum too large for one frame is offered before its chunks are sent."""

    sender: int
    target: int
    number: int
    id: DatumId
    kind: int
    created: float
    hops: int
    crc: int
    size: int
    """Bytes of payload, 1..1 MiB."""
    chunk_size: int
    """Bytes of payload in each chunk but the last, 1..123."""
    at_least: bool = False
    """As for a datum: it is at least as old as `created` says."""


@_kind(Target.NAMED, Urgency.ANSWER, _on_nothing)
class Accept(NamedTuple):
    """The receiver of an offer opens a transfer and names it."""

    sender: int
    target: int
    number: int
    """The hand-over number of the offer."""
    handle: int
    """Chosen by the receiver, 16 bits: the name of the transfer in its chunks."""
    next_index: int
    """First chunk still missing (a transfer is resumed after an interruption)."""
    bitmap: int = 0
    """Bit i: chunk next_index + 1 + i has been received. 256 bits."""


@_kind(Target.HANDLE, Urgency.BULK, _on_nothing)
class Chunk(NamedTuple):
    """A piece of a datum."""

    target: int
    """To whom, for links that send to one neighbour; not on the wire (BROADCAST when received)."""
    handle: int
    position: int
    """0..16383. Without data: the number of a question, 1..16383; the answer names it."""
    poll: bool
    """The sender wants a `Sack` now."""
    data: bytes
    """Empty: a question, by which the sender learns what has arrived of all that it sent before."""


class Report(NamedTuple):
    """Which chunks of a transfer have been received."""

    handle: int
    next_index: int
    """All chunks below this one."""
    bitmap: int
    """Bit i: chunk next_index + 1 + i."""

    @property
    def chunks(self) -> int:
        """Bit i: chunk i."""
        return (1 << self.next_index) - 1 | self.bitmap << self.next_index + 1


@_kind(Target.NAMED, Urgency.ANSWER, _on_nothing)
class Sack(NamedTuple):
    """Selective acknowledgement of chunks."""

    sender: int
    target: int
    handle: int
    next_index: int
    """All chunks below this one have been received."""
    bitmap: int
    """Bit i: chunk next_index + 1 + i has been received. 256 bits."""
    question: int = 0
    """The number of the question that this answers; 0: it answers none."""
    others: tuple[Report, ...] = ()
    """The same of at most three other transfers between the two nodes, with 128 bits each."""


class ReceiptEntry(NamedTuple):
    """Numbers of one origin and epoch that have arrived at a base, or that were reported lost to it."""

    origin: int
    epoch: int
    """Of the data."""
    first: int
    """The entry covers this number and all up to, but not including, `first + run`."""
    run: int
    """At least 1."""
    bitmap: int
    """Bit i: the entry also covers number `first + run + i`. 128 bits; bit 0 is never set, because the run would be
    longer."""
    lost: bool
    """True: these were reported lost to the base, though some may have arrived since. False: the base has them."""


@_kind(Target.EVERYBODY, Urgency.DATA, _on_all_changes)
class Receipt(NamedTuple):
    """One statement by one base about the data it has. Every node that hears it relays it unchanged."""

    base: int
    base_life: int
    """The base's life (32 bits): a wiped base is another base."""
    serial: int
    """Raised by the base with each statement, 32 bits."""
    crc: int
    """CRC-32 of the rest (`receipt_crc`)."""
    entries: tuple[ReceiptEntry, ...]
    senders: tuple[Hashable, ...] = ()
    """Its senders so far, each once, as far as they are known; not on the wire."""


@_kind(Target.EVERYBODY, Urgency.DATA, _on_all_changes)
class SequenceMark(NamedTuple):
    """An origin's answer to receipts that name numbers of its present epoch which it has not assigned."""

    origin: int
    epoch: int
    assigned: int
    """How many numbers of this epoch it has assigned: all below this one."""
    crc: int
    """CRC-32 of the rest (`sequence_mark_crc`)."""


#: Bytes of the proof of a deletion report.
NOTE_PROOF_BYTES = 10


class DeletionEntry(NamedTuple):
    """A datum that is beyond repair."""

    number: int
    """Hand-over number of the note, as for data."""
    id: DatumId
    reason: int
    """1 corrupted, 2 expired, 3 overflow, 4 died, 5 or any other: vanished. 6: numbers of the id's origin and epoch
    from its sequence on may have been assigned, but no node knows. 7: the store of the id's origin, whose life is the
    id's epoch, was damaged; up to as many data as the id's sequence says may be lost."""
    crc: int
    """CRC-32 over id and reason (`note_crc`), computed by the node that created the note."""
    proof: bytes = b""
    """Where there are keys: the node that created it (16 bits), and its tag for the ground. Empty: none."""


@_kind(Target.NAMED, Urgency.DATA, _on_all_changes)
class DeletionReport(NamedTuple):
    """A report that data are lost. It percolates to the base like a datum."""

    sender: int
    target: int
    entries: tuple[DeletionEntry, ...]


@_kind(Target.EVERYBODY, Urgency.DATA, _on_all_changes)
class Put(NamedTuple):
    """A virtual-stigmergy entry (Buzz): broadcast to all neighbours, kept by every node with space, never answered."""

    sender: int
    lamport: int
    """Lamport timestamp of the entry, 16 bits, from 1."""
    writer: int
    """Robot id (node id) of the last writer; breaks ties between equal timestamps."""
    datum: Datum
    """The entry: key = `datum.id`, value = its payload."""


#: Keys in one query (as many as fit a frame).
QUERY_IDS = 12


@_kind(Target.NAMED, Urgency.DATA, _on_nothing)
class Query(NamedTuple):
    """Under virtual stigmergy: the sender knows these entries but has lost their values, and asks for them."""

    sender: int
    target: int
    ids: tuple[DatumId, ...]
    """At most `QUERY_IDS`."""


class CopyStatus(enum.IntEnum):
    """What custodians and holders report to each other about a datum."""

    AGAIN = 0
    """The sender has no good copy: the receiver should take custody of its replica. Answered by TAKEN or NONE."""
    NONE = 1
    """The sender has no copy that can be counted on."""
    TAKEN = 2
    """Answer to AGAIN: this node has custody, or answers for the datum. Answer to WANTED: custody is not lost."""
    STILL = 3
    """A holder asks whether the receiver still has custody. If not, the answer is PASSED_ON or AGAIN."""
    WANTED = 4
    """To all neighbours: the sender lost a datum in its custody, and no holder has it. A node with a good replica
    answers HERE, one with custody TAKEN. Others are silent."""
    HERE = 5
    """Answer to WANTED: a replica is here. The node that answers first is sent AGAIN."""
    ENCLOSED = 6
    """From a holder: every neighbour of the sender hears the receiver, so another node would be a better holder."""
    PASSED_ON = 7
    """From a custodian to its holder: the sender has passed the datum on, or is a base that has it, and does not count
    on a replica any more."""


class CopyStatusEntry(NamedTuple):
    """One report about one datum."""

    id: DatumId
    status: int
    """A `CopyStatus`; unknown values are ignored."""


def _on_what_is_taken(corrupt: CopyStatuses) -> Iterable[DatumId] | None:
    # A node that receives TAKEN has no copy, and forgets its deletion report; one that receives PASSED_ON may delete
    # its copy. Whatever makes this true must therefore be on disk.
    ends = (CopyStatus.TAKEN, CopyStatus.PASSED_ON)
    return None if any(entry.status in ends for entry in corrupt.entries) else ()


@_kind(Target.NAMED, Urgency.ANSWER, _on_what_is_taken)
class CopyStatuses(NamedTuple):
    """From custodian to holder or back, about copies that are gone: "mine is corrupt, send yours again", and the
    like."""

    sender: int
    target: int
    entries: tuple[CopyStatusEntry, ...]


Message: TypeAlias = (
    Beacon | Data | Committed | Offer | Accept | Chunk | Sack | Receipt | DeletionReport | Put | Query | CopyStatuses
    | SequenceMark
)  # fmt: skip


def destination(message: Message) -> tuple[int, Urgency]:
    """To which neighbour a message goes, or BROADCAST, and how urgent it is."""
    _, urgency, _ = KINDS[type(message)]
    return getattr(message, "target", BROADCAST), urgency


def stated(message: Message) -> tuple[int, int, int] | None:
    """Base, base life and serial of what a base states, and others relay unchanged; None: it is no such message."""
    return message[:3] if type(message) is Receipt else None


def sent_by(message: Message, senders: tuple[Hashable, ...]) -> Message:
    """The same; if it is what a base states, with those who have sent it so far."""
    return message._replace(senders=senders) if type(message) is Receipt else message


def sender_of(message: Message) -> int | None:
    """The node that sent a message; None: the message does not name it."""
    return getattr(message, "sender", None)


def custodian_of(message: Message | None) -> int | None:
    """The node in whose name a message hands something over, or offers to; None: it does not."""
    return message.sender if type(message) in (Data, Offer, DeletionReport) else None  # type: ignore[union-attr]


def is_of_transfer(message: Message) -> bool:
    """Whether a message is part of a transfer, in which each waits for the one before."""
    return type(message) in (Offer, Accept, Chunk, Sack)


def is_vital(message: Message) -> bool:
    """Whether no datum arrives without messages of this kind."""
    return type(message) in (Beacon, Data, Committed)


def joined(messages: Iterable[Message]) -> list[Message]:
    """The same with all data for a node in one message, and all answers to it."""
    joined: dict[Hashable, Message] = {}
    for index, message in enumerate(messages):
        key: Hashable = index
        if type(message) is Data:
            key = Data, message.target, message.replica, message.distance
            if isinstance(first := joined.get(key), Data):
                message = first._replace(handovers=first.handovers + message.handovers)
        elif type(message) is Committed:
            key = Committed, message.target
            if isinstance(first := joined.get(key), Committed):
                message = first._replace(
                    committed=first.committed + message.committed, refused=first.refused + message.refused
                )
        joined[key] = message
    return list(joined.values())

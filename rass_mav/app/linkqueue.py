"""One link as the node sees it: turns bytes into frames, removes copies, and paces sending. No input and output."""

from __future__ import annotations

import random
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import TYPE_CHECKING, Any

from rass_mav.agent.agent import Agent
from rass_mav.agent.floods import Flood
from rass_mav.agent.outgoing import Outgoing
from rass_mav.app.duplicates import Duplicates
from rass_mav.link.backlog import Backlog
from rass_mav.link.budget import Budget, Queued
from rass_mav.link.radios import RADIO_COMPONENT, Radio
from rass_mav.mavlink.frames import Frame, FrameReader
from rass_mav.mavlink.messages import RADIO_STATUS, TUNNEL, WARNING, RadioStatus, radio_status

if TYPE_CHECKING:
    from rass_mav.link.airtime import Pacer

#: An unknown radio sends RADIO_STATUS about once a second. More than three times what it sends in this many seconds are
#: forged.
MOST_RADIO_STATUS, WATCH_S = 3, 10.0
#: The pacer hears a known radio this often, seconds, with the fullest buffer since: its steps are for reports that come
#: once a second.
REPORT_S = 0.9
# Their names in `status`, in the order of `Urgency`.
_KINDS = ("vehicle", "beacons", "answers", "data", "chunks")


class LinkQueue:
    """The node's side of one link to the neighbours. The driver provides bytes and the time, and sends the frames."""

    def __init__(
        self,
        agent: Agent,
        duplicates: Duplicates,
        *,
        budget: Budget | None = None,
        radio: Radio | None = None,
        interface: Callable[[], int] = lambda: 0,
        stream: bool = False,
        only: frozenset[int] | None = None,
        rng: random.Random,
        now: float,
        name: str = "the neighbours",
    ) -> None:
        """`budget`: None: frames leave as fast as the interface takes them. `radio`: what is known of the radio; None:
        its RADIO_STATUS comes from the ids in the settings. `interface`: how much waits in it, bytes,
        for a link without a budget. `stream`: bytes come in pieces that end anywhere; otherwise in datagrams of whole
        frames. `only`: node ids accepted as neighbours on this link; None: all. `name`: of the link."""
        self.agent = agent
        self._name = name
        self.duplicates = duplicates
        self.check = agent.trust.check()
        """Counts the frames that are not signed rightly; None: signatures are not checked."""
        self.reader = FrameReader(self.check)
        self.pacer: Pacer | None = None
        if budget is not None:
            from rass_mav.link.airtime import Pacer  # for slow radios, which most nodes do not have

            measures = radio is not None and radio.measures
            self.pacer = Pacer(budget, rng, now=now, step_s=agent.settings.step_s, measures=measures)
        self._queue = self.pacer or Backlog(interface, now)
        self.not_neighbours = 0
        """Beacons of nodes that are not on the list `only`."""
        self.copies = 0
        """Frames that had been heard or sent before."""
        self.not_the_radio = 0
        """RADIO_STATUS that were ignored as not genuine."""
        self.radio_status: RadioStatus | None = None
        """The last RADIO_STATUS that came, from whichever radio."""
        self.hear_frame: Callable[[Frame], None] = lambda frame: None
        """Called with what is not from a node, for who wants to know it."""
        self._radio = radio
        self._radio_flood = Flood(
            round(MOST_RADIO_STATUS * WATCH_S * (1.0 if radio is None else radio.status_hz)), WATCH_S
        )
        self._fullest = 100
        self._report_at = now
        self._stream = stream
        self._only = only
        self._generation = 0
        self._newest = -1
        """The highest timestamp that has left."""

    # -- what comes in -------------------------------------------------------------------------------------------------

    def take(self, data: bytes, now: float, on_beacon: Callable[[int], None]) -> Iterator[Sequence[Outgoing]]:
        """Bytes from the link. Yields the answers to each frame. They go to the gate before the next frame is handled,
        so that a fault can still drop them. `on_beacon` is called with the node id of each neighbour heard."""
        for frame in self.reader.feed(data) if self._stream else self.reader.datagram(data):
            if frame.message_id == RADIO_STATUS and not self._stream:
                # Datagrams come from neighbours. No radio is attached to this link.
                self.not_the_radio += 1
            else:
                yield self.frame(frame, now, on_beacon)

    def opened(self, generation: int) -> None:
        """The port has been opened this many times. Drop half a frame from before it was lost: its end cannot come."""
        if generation != self._generation:
            self._generation = generation
            self.reader.flush()

    def frame(self, frame: Frame, now: float, on_beacon: Callable[[int], None]) -> Sequence[Outgoing]:
        """Any frame from the link."""
        pacer = self.pacer
        if frame.message_id == RADIO_STATUS:
            self._hear_radio(radio_status(frame), now)
            return ()
        if pacer is not None:
            pacer.heard(now, frame.size if frame.message_id == TUNNEL else 0)
        if frame.message_id != TUNNEL:
            self.hear_frame(frame)
            return ()
        if not self.duplicates.is_new(frame, now):
            self.copies += 1
            return ()

        def may_be_neighbour(sender: int) -> bool:
            if self._only is not None and sender not in self._only:
                self.not_neighbours += 1
                return False
            on_beacon(sender)
            return True

        return self.agent.peer_frame(frame, now, may_be_neighbour, self._name)

    def _hear_radio(self, status: RadioStatus, now: float) -> None:
        """A RADIO_STATUS: from our radio, forwarded from another radio, or forged."""
        self.radio_status = status
        radio, flood = self._radio, self._radio_flood
        if radio is not None and not radio.measures:
            return
        ours = self._is_ours(status)
        if ours and flood.hear(now):
            self.agent.tell_ground(WARNING, "RASS: forged RADIO_STATUS on the radio, ignored")
        if not ours or flood.active:
            self.not_the_radio += 1
        elif self.pacer is not None:
            self._fullest = min(self._fullest, status.txbuf)
            if radio is None or now >= self._report_at:
                self.pacer.radio_status(self._fullest, now)
                self._fullest, self._report_at = 100, now + REPORT_S

    def _is_ours(self, status: RadioStatus) -> bool:
        if self._radio is None:
            mavlink = self.agent.settings.mavlink
            return (status.system_id, status.component_id) == (mavlink.radio_system_id, mavlink.radio_component_id)
        return status.component_id == RADIO_COMPONENT and self._radio.system_id in (None, status.system_id)

    # -- what goes out -------------------------------------------------------------------------------------------------

    def meet(self, neighbours: Collection[int]) -> None:
        """These nodes are heard on this link now."""
        if self.pacer is not None:
            # The ground may have changed the length of a step.
            self.pacer.step_s = self.agent.settings.step_s
        self._queue.meet(neighbours)

    def push(self, outgoing: Outgoing, now: float, *, first: bool = False) -> None:
        """Queue a frame; `first`: before all others of the same urgency."""
        self._queue.push(outgoing.frame, outgoing.target, outgoing.urgency, now, first=first)

    def pop(self, now: float) -> Queued | None:
        """The frame that leaves now, or None. Ask again until None."""
        queued = self._queue.pop(now)
        if queued is None:
            return None
        frame, self._newest = self.agent.trust.refresh(queued.frame, self._newest)
        if frame is queued.frame:
            return queued
        self.duplicates.sent(frame, now)
        return queued._replace(frame=frame)

    def next_at(self, now: float) -> float | None:
        """When to `pop` next; None: nothing waits."""
        return self._queue.next_at(now)

    def report(self) -> dict[str, Any]:
        """For `status`."""
        figures: dict[str, Any] = {"copies": self.copies, "not_the_radio": self.not_the_radio}
        figures["radio_status"] = None if self.radio_status is None else self.radio_status._asdict()
        if self._only is not None:
            figures["not_neighbours"] = self.not_neighbours
        if self.check is not None:
            figures.update(self.check.report())
        pacer = self.pacer
        if isinstance(self._queue, Backlog):
            figures["dropped_chunks"] = self._queue.dropped
        if pacer is not None:
            turn_s, items = pacer.pace()
            figures["airtime"] = {
                "bytes_s": round(pacer.rate, 1),
                "own_data_bytes_s": round(pacer.data_rate, 1),
                "turn_s": turn_s,
                "items": items,
                "throttle": round(pacer.throttle, 3),
                "waiting": pacer.waiting,
                "sent": dict(zip(_KINDS, pacer.sent, strict=True)),
                "dropped": dict(zip(_KINDS, pacer.dropped, strict=True)),
            }
        return figures


def set_pace(agent: Agent, link_queues: Sequence[LinkQueue], now: float, waiting: int = 0) -> None:
    """Let a node send as many beacons and data as its links can carry with the present neighbours. `waiting`: how much
    waits behind links that have no pacer."""
    node, step_s = agent.node, agent.settings.step_s
    turn_s, items = common_pace(link_queues, step_s, node.settings.store.bandwidth_items)
    node.keep_pace(turn_s, items, now, slowest_turn(link_queues, step_s))
    node.pace.queue = waiting + sum(
        link_queue.pacer.pressing for link_queue in link_queues if link_queue.pacer is not None
    )


def common_pace(link_queues: Sequence[LinkQueue], step_s: float, bandwidth_items: int) -> tuple[float, int]:
    """Turn (seconds) and data per turn for a node with these links: those of the fastest link.

    A slower link sends fewer beacons, and drops the frames that it cannot carry. Beacons announce a different turn:
    `slowest_turn`.
    """
    paces = [link_queue.pacer.pace() for link_queue in link_queues if link_queue.pacer is not None]
    if len(paces) < len(link_queues) or not paces:
        return step_s, bandwidth_items
    fastest = min(paces, key=lambda pace: pace.turn_s)
    return fastest.turn_s, max(pace.items for pace in paces)


def slowest_turn(link_queues: Sequence[LinkQueue], step_s: float) -> float:
    """Seconds between two beacons on the slowest link, as announced to the neighbours, which wait that long."""
    return max(
        [step_s, *(link_queue.pacer.pace().turn_s for link_queue in link_queues if link_queue.pacer is not None)]
    )

"""What all participants have in common, whatever their policy does with data: beacons, routes, risk, pace."""

from __future__ import annotations

import random
from abc import ABC, abstractmethod

from rass_mav.core.alarms import Alarms
from rass_mav.core.custody.handovers import HandoverNumbers
from rass_mav.core.custody.holdings import Holdings
from rass_mav.core.datum import TERMS, USUAL, Datum, DatumId, Terms, make_datum
from rass_mav.core.exchange import Exchange
from rass_mav.core.messages import BEACON_BASE, BEACON_WANTED, INLINE_BYTES, NO_ROUTE, Beacon, Committed, Message
from rass_mav.core.news.receipts import NoReceipts
from rass_mav.core.observer import Observer
from rass_mav.core.pace import Pace
from rass_mav.core.policy import POTENTIAL_BASE, Policy
from rass_mav.core.risk import RiskEstimator
from rass_mav.core.routes.announcements import Announcements, following
from rass_mav.core.routes.costs import NO_COST, Toll
from rass_mav.core.routes.ranks import ByCost, ByHops
from rass_mav.core.routes.table import HOLD_LIFETIMES, RoutingTable
from rass_mav.core.seals import NO_SEALS, ContentHashes, NoSeals
from rass_mav.core.settings import NodeSettings
from rass_mav.core.store import Store
from rass_mav.errors import DatumError, StoreFullError

#: Bound: What waits here makes a hop from here dearer by this at most, wire units: a route over a dozen nodes that have
#: been filled for days has a cost.
MOST_QUEUE = NO_COST // 16


class Participant(ABC):
    """One RASS participant. `Node` hands over custody, `StigmergyNode` copies everything to all nodes."""

    __slots__ = (
        "_announcements",
        "_beacon_number",
        "_slow_until",
        "_steps",
        "_tolls",
        "alarms",
        "base",
        "exchange",
        "holdings",
        "id",
        "numbers",
        "observer",
        "pace",
        "policy",
        "potential",
        "receipts",
        "risk",
        "rng",
        "routing",
        "seals",
        "settings",
        "store",
    )  # fmt: skip

    def __init__(
        self, settings: NodeSettings, store: Store, policy: Policy, risk: RiskEstimator, rng: random.Random, *,
        now: float, observer: Observer | None = None, newborn: bool = False, seals: NoSeals | None = None,
        content_hashes: ContentHashes | None = None, before: Participant | None = None,
    ) -> None:  # fmt: skip
        """`now` in seconds, on the timeline of all later calls.

        `newborn`: no node can remember this one from an earlier life, so it need not wait before it uses a route.
        `seals`: what the node's keys do to data; `content_hashes`: what answers to hand-overs confirm. None: it has no
        keys. `before`: its neighbours and routes become those of this one; it has the same settings. None: there are
        none.
        """
        self.id = settings.node_id
        self.base = settings.base
        self.settings = settings
        self.store = store
        self.policy = policy
        self.risk = risk
        self.rng = rng
        self.observer = observer or Observer()
        self.seals = seals or NO_SEALS
        slow = store.get_meta("turn") or 0
        if before is None:
            self.routing = RoutingTable(
                settings,
                store.life,
                ByHops() if policy.costs is None else ByCost(policy.costs),
                turn_s=slow / 10,
                restarted=None if newborn else now,
            )
            self._announcements = None
            if self.base:
                period = settings.routing.seq_period
                self._announcements = Announcements(store, policy.seq_period if period is None else period)
        else:
            self.routing, self._announcements = before.routing, before._announcements
            if self._announcements is not None:
                self._announcements.claim()
        self.pace = Pace(
            settings.step_s, settings.store.bandwidth_items, keeps=settings.replicas and settings.immediate,
            phase=self.id,
        )  # fmt: skip
        """How often this node has its turn, and how much it may send in one."""
        self.potential = 0
        """Own potential as last announced, wire units."""
        self.alarms = Alarms()
        self._slow_until = now + HOLD_LIFETIMES * self.routing.longest_s
        # Random starts: no message of an earlier life is mistaken for one of this life.
        self._beacon_number, first = divmod(rng.getrandbits(48), 1 << 32)
        self.exchange = Exchange(first)
        """What this node has asked its neighbours."""
        self.numbers = HandoverNumbers(content_hashes or ContentHashes())
        self._steps = 0
        self._tolls = settings.has("queue-toll")
        """Whether what waits here makes routes by this node dearer, where costs add up."""
        if before is not None:
            self._beacon_number, self._steps = before._beacon_number, before._steps
        self.receipts = NoReceipts()
        """What bases report as arrived."""
        self.holdings = self._take_up(now)
        """What is held here."""

    def number_beacons(self, last: int) -> None:
        """The next beacon has the number after `last` (16 bits)."""
        self._beacon_number = last & 0xFFFF

    @abstractmethod
    def _take_up(self, now: float) -> Holdings:
        """Load what the store holds, and create what this kind of participant does with it."""

    def tend(self, now: float) -> list[Message]:
        """Between two turns: look after what is not answered, if `exchange.due` has come. Returns what to send."""
        return []

    @property
    def sink(self) -> bool:
        """Whether data that reach this node have arrived for good. Under a replicating policy a base is an ordinary
        peer."""
        return self.base and not self.policy.replicates

    def needed(self, answers: list[Message], moves: list[Message]) -> list[Message]:
        """Those of the answers that are still needed where all neighbours hear `moves`, which leave with them."""
        return answers

    @property
    def overhears(self) -> bool:
        """Whether this node handles the data that neighbours send to others (`Data` with another target)."""
        return False

    @property
    def overheard(self) -> dict[DatumId, Datum]:
        """Data that others handed over to each other, and that are kept here in memory only."""
        return {}

    # -- incoming messages ---------------------------------------------------------------------------------------------

    @abstractmethod
    def receive(self, message: Message, now: float) -> list[Message]:
        """A message from a neighbour. Returns the answers; they may be sent once the store has committed."""

    @abstractmethod
    def step(self, now: float) -> list[Message]:
        """One turn of Alg. 1 except `store_measurements`, which is `put`. Returns what to send, the beacon first."""

    @abstractmethod
    def forward(self, now: float) -> list[Message]:
        """Move on at once what came in since the last turn, within the bandwidth of this step.

        With `NodeSettings.immediate`, after `receive` and `put`; empty if nothing came in.
        """

    @abstractmethod
    def figures(self) -> dict[str, int]:
        """Counters of this life, by name, for `status`."""

    def put(self, payload: bytes, now: float, kind: int = 0, terms: Terms = USUAL) -> DatumId:
        """Create a datum here, sealed where there are keys. `kind`: 0..63. Raises `StoreFullError` (counted as
        overflow) or `DatumError` (too large or empty, or another kind, or terms out of range)."""
        head = terms.pack()
        most = self.most_put - len(head)
        if not 0 < len(payload) <= most:
            raise DatumError(f"a datum holds 1 to {most} bytes, got {len(payload)}")
        if not 0 <= kind < TERMS:
            raise DatumError(f"a kind is 0 to {TERMS - 1}, got {kind}")
        if not self._has_room_for_own(len(head) + len(payload) + self.seals.added):
            self.store.count("overflow")
            self.observer.overflow()
            raise StoreFullError("no space for a new datum")
        id = DatumId(self.id, self.store.epoch, self.store.next_sequence())
        stored_kind, stored = self.seals.seal(id, kind | TERMS if head else kind, payload, head)
        datum = make_datum(id, stored_kind, now, stored)
        self.observer.created(datum)
        self._keep_own(datum)
        return id

    @property
    def most_put(self) -> int:
        """Largest payload that `put` takes without terms."""
        return self.most_bytes - self.seals.added

    @property
    @abstractmethod
    def most_bytes(self) -> int:
        """Largest payload of a datum that may be created here, as it is stored."""

    @abstractmethod
    def _has_room_for_own(self, size: int) -> bool:
        """Whether there is space for a new datum, or space can be made."""

    @abstractmethod
    def _keep_own(self, datum: Datum) -> None:
        """Keep a new datum."""

    def _on_beacon(self, beacon: Beacon, now: float) -> list[Message]:
        if beacon.sender != self.id:
            self.routing.hear(beacon, now)
            return []
        if beacon.life != self.store.life:
            self.alarms.rival(beacon.life, now)
        elif (self._beacon_number - beacon.number & 0xFFFF) < self._steps:
            self.alarms.echoes += 1
        else:
            # Numbers start anywhere, so it was not sent in this run.
            self.alarms.clones += 1
        return []

    def _ignore(self, message: Message, now: float) -> list[Message]:
        """This message is not for participants of this kind."""
        return []

    # -- first part of Alg. 1 ------------------------------------------------------------------------------------------

    def update_routing_table(self, now: float) -> None:
        """Alg. 2, from the neighbours' beacons."""
        routing = self.routing
        if self._announcements is not None and (number := self._announcements.turn(routing.requested)) is not None:
            routing.announce(number)
        if self.policy.costs is not None:
            hop = self.policy.potential(routing.distance, self.risk.risk(now), 1)
            # A datum that comes here is exposed for one more turn for each turn's worth of data before it.
            queue = hop * len(self.holdings.custody) // self.pace.items if self._tolls else 0
            toll = (hop, min(queue, MOST_QUEUE))
            if routing.toll != toll:
                routing.toll = Toll(*toll)
        routing.update(now)

    def update_fitness(self, now: float) -> Beacon:
        """Eq. 3, or the policy's replacement for it. Returns the beacon that announces it, and the route."""
        routing, holdings = self.routing, self.holdings
        risk = self.risk.risk(now)
        free = holdings.free()
        store = self.store
        if free and not (store.accepting and store.room_for(INLINE_BYTES - holdings.replica_bytes)):
            free = 0
        if self.base:
            self.potential = POTENTIAL_BASE if free else 0
        elif self.policy.costs is not None:
            self.potential = routing.metric
        else:
            self.potential = self.policy.potential(routing.distance, risk, free)
        routing.announced(now)
        contacts = routing.neighbours.contacts
        wanted = routing.wanted
        flags = (BEACON_BASE if self.base else 0) | (BEACON_WANTED if wanted else 0)
        base, base_life, number, hops = routing.route or (0, 0, 0, NO_ROUTE)
        wanted_base, wanted_number = wanted or (0, 0)
        self._beacon_number = following(self._beacon_number)
        return Beacon(
            self.id, store.life, self._beacon_number, flags, base, base_life, number, hops, wanted_base,
            wanted_number, int(risk * 65535.0 + 0.5), free, self.policy.tag, self.potential,
            self.receipts.statements_hash, self._turn(), self._answers_again(),
            0 if contacts is None else contacts.announced(now),
        )  # fmt: skip

    def _answers_again(self) -> tuple[Committed, ...]:
        """The answers of the last turn."""
        return ()

    # -- changing settings ---------------------------------------------------------------------------------------------

    def adopt(self, settings: NodeSettings, policy: Policy) -> None:
        """Continue with other weights and another bandwidth. The policy's costs add up as before."""
        self.settings = settings
        self.policy = policy
        # Until the link's pace is checked again, in the next step.
        self.pace.items = settings.store.bandwidth_items

    def keep_pace(self, turn_s: float, items: int, now: float, told_s: float | None = None) -> None:
        """From now on `step` is called every `turn_s` seconds, because the link carries no more; each sends at most
        `items` data (and no more than the settings allow). Neighbours learn this from the beacon, and wait accordingly.

        `told_s`: the turn that they are told, where not every beacon leaves on every link; None: `turn_s`.
        """
        step_s, routing = self.settings.step_s, self.routing
        self.pace.turn_s = max(step_s, turn_s)
        self.pace.items = min(self.settings.store.bandwidth_items, items)
        routing.turn_s = max(step_s, turn_s if told_s is None else told_s)
        # After a restart this node has to wait until no node counts on its old routes: the time that takes is
        # stored.
        kept = self.store.get_meta("turn") or 0
        turn = self._turn()
        if turn >= kept:
            self._slow_until = now + HOLD_LIFETIMES * routing.longest_s
        if turn > kept or (turn < kept and now >= self._slow_until):
            self.store.set_meta("turn", turn)

    def _turn(self) -> int:
        """The turn as sent in the beacon."""
        turn_s = self.routing.turn_s
        return min(0xFFFF, int(turn_s * 10 + 0.5)) if turn_s > self.settings.step_s else 0

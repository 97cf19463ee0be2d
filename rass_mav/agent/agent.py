"""One complete node, without input and output. A drone, a base and the mock swarm run the same code."""

from __future__ import annotations

import logging
import math
import random
from collections.abc import Callable, Sequence
from typing import Any, Protocol

from rass_mav.agent.guard import Guard, Unguarded
from rass_mav.agent.outgoing import Answers, Outgoing, Way, aside
from rass_mav.agent.peers import Peers, head_of
from rass_mav.agent.seam import KEYLESS, Keys
from rass_mav.agent.settings import AgentSettings
from rass_mav.agent.turns import Heartbeats, Turns
from rass_mav.core.datum import DatumId, Kind
from rass_mav.core.messages import Beacon, Message
from rass_mav.core.node import Node
from rass_mav.core.observer import Observer
from rass_mav.core.participant import Participant
from rass_mav.core.routes.contacts import STALE_S
from rass_mav.core.store import Store
from rass_mav.errors import StoreFullError
from rass_mav.mavlink.dialect import payload_of
from rass_mav.mavlink.frames import Frame, FrameReader, FrameWriter
from rass_mav.mavlink.messages import CRITICAL, HEARTBEAT, TUNNEL, companion_heartbeat, statustext
from rass_mav.mavlink.telemetry import Accuracy, LocalPosition, Position, Reading, Telemetry
from rass_mav.wire.measurement import Measurement, encode_measurement

log = logging.getLogger(__name__)

# Tuned: python -m tools.sensitivity agent.agent
#: A position older than this is not used, seconds: the vehicle has moved on. A motion says less for long.
POSITION_STALE_S = 2.0 * STALE_S
# For `data.due`: how many times the node id is subtracted from the step before the interval must divide it.
_PHASES = {"step-id": 1, "step+id": -1, "together": 0}
# The store keeps the autopilot's system id under this name.
_SYSTEM_ID = "system_id"
# Always the same bytes, so they are packed once.
_HEARTBEAT = payload_of(companion_heartbeat())
# Where the autopilot's radio is slow: the share of what we send to the autopilot that heartbeats may take.
_HEARTBEAT_PART = 0.7


def _of_vehicle(frame: Frame) -> str:
    return f"message {frame.message_id} from the autopilot's port"


class VehicleListener(Protocol):
    """Hears the autopilot or the ground station, over the autopilot's port."""

    def hear(self, frame: Frame, now: float) -> None:
        """A frame from there, before telemetry handles it."""


class VehicleService(Protocol):
    """Works with the autopilot or the ground station. It sends its frames with the agent's `tell_vehicle`."""

    def step(self, now: float) -> None:
        """Called once a step."""


class GroundConversation(VehicleListener, Protocol):
    """What an agent and its driver need of the conversation with ground stations (`station.ground`)."""

    def receive(self, data: bytes, now: float, *, stream: bool = False) -> None:
        """Bytes directly from a ground station."""

    def tell(self, severity: int, text: str) -> None:
        """Send a text for people; `severity` as MAV_SEVERITY."""

    def heartbeat(self) -> Outgoing:
        """One for the stations that are connected directly."""

    def tend(self, now: float, out: list[Outgoing]) -> float:
        """Add the frames that are due to `out`. Returns when to call again."""

    def pace(self, rate: float) -> None:
        """Limit what goes to the ground through the autopilot to `rate` bytes/s."""

    def keep_again(self) -> None:
        """Store what the ground has set again, after the store rolled back its uncommitted changes."""

    def report(self) -> dict[str, Any]:
        """For `status`."""


class Agent:
    """Bytes in, frames out. The driver provides time, links and commits (docs/contribute/architecture.md).

    `station.node.build_node` makes one together with what it tells the autopilot and the ground.

    The methods return every frame that leaves: `step` and `tend` what is due, `peer_bytes` and `peer_frame` the
    answers, `forward` what follows a new datum, and `greet_vehicle` a heartbeat.
    """

    # In the mock swarm a thousand agents share a processor's cache.
    __slots__ = (
        "_beats",
        "_heard_reading",
        "_immediate",
        "_outbox",
        "_participant",
        "_recorded",
        "_rng",
        "_text_id",
        "_turns",
        "answers",
        "ground",
        "guard",
        "last_reading",
        "listeners",
        "node",
        "peers",
        "refused",
        "services",
        "settings",
        "steps",
        "store",
        "telemetry",
        "trust",
        "vehicle_reader",
        "vehicle_writer",
    )

    def __init__(
        self,
        settings: AgentSettings,
        store: Store,
        rng: random.Random,
        *,
        now: float,
        observer: Observer | None = None,
        newborn: bool = False,
        forgiving: bool = False,
        participant: type[Participant] | None = None,
        keys: Keys | None = None,
    ) -> None:
        """`now`: seconds on the timeline of all later calls. `rng` makes all random choices.

        `newborn`: no other node can remember this one from an earlier life (as when a mock swarm starts). `forgiving`:
        a frame that hits a fault in this program is dropped, and the node continues (`agent.guard`). Otherwise the
        fault raises. `participant`: what handles the messages; None: what the policy asks for. Experiments compare
        others with it. `keys`: the node's; None: it has none.
        """
        self.settings = settings
        self._rng = rng
        self.store = store
        self.trust = KEYLESS if keys is None else keys.life(settings.node_id, store, rng, settings.step_s)
        """What the node's keys do for it."""
        self._participant = participant
        self.answers = Answers(rng)
        """Those to neighbours. The driver knows whether they have to wait."""
        self.guard = Guard(self) if forgiving else Unguarded()
        """Handles every incoming frame."""
        self.node = self._make_node(now, observer, newborn)
        mavlink = settings.mavlink
        self.telemetry = Telemetry(
            mavlink.autopilot_id,
            reading_name=mavlink.reading_name,
            reading_component=mavlink.reading_component if settings.sensor_unit is None else None,
        )
        system_id = mavlink.system_id or mavlink.autopilot_id or (settings.node_id - 1) % 255 + 1
        if settings.ground is not None and mavlink.system_id is None and not mavlink.autopilot_id:
            # Autopilots never forget a sender, so use the right id from the first frame on, if it is known.
            system_id = store.get_meta(_SYSTEM_ID) or system_id
        writer = FrameWriter(system_id, mavlink.component_id)
        self.trust.connect(writer, mavlink.payload_type)
        self.peers = Peers(settings.node_id, writer, mavlink.payload_type, self.trust)
        self._fit_peers()
        self.vehicle_writer = FrameWriter(system_id, mavlink.component_id)
        self.vehicle_reader = FrameReader()
        self._outbox: list[Outgoing] = []
        """Frames for the autopilot and the ground that wait for the next `step` or `tend`."""
        self.steps = 0
        """Steps done."""
        self.last_reading: Reading | None = None
        """The last reading, from the autopilot, from the node's own sensor or from a program."""
        self._recorded: Reading | None = None
        """The last one that became a datum of its own."""
        self._heard_reading: Reading | None = None
        """The last one from the autopilot."""
        self._beats = Heartbeats(now)
        self._text_id = 0
        self._turns = Turns(settings.step_s, now)
        self.listeners: list[VehicleListener] = []
        """All that hear the autopilot's port, in this order."""
        self.services: list[VehicleService] = []
        """All that are called once a step, in this order."""
        self.ground: GroundConversation | None = None
        """None: there is no ground station. Otherwise it is one of the listeners too."""
        self.refused = 0
        """Measurements refused because the store was full."""
        self.trust.begin(self.tell_ground)

    def _make_node(
        self, now: float, observer: Observer | None, newborn: bool, before: Participant | None = None
    ) -> Participant:
        settings = self.settings
        self._immediate = settings.forward == "immediate"
        policy = settings.policy.make()
        kind = self._participant or Node
        if self._participant is None and policy.replicates:
            from rass_mav.core.stigmergy import StigmergyNode  # for one policy

            kind = StigmergyNode
        return kind(
            self.settings, self.store, policy, settings.risk.estimator(policy), self._rng,
            now=now, observer=observer, newborn=newborn, seals=self.trust.seals(self.store),
            content_hashes=self.trust.content_hashes, before=before,
        )  # fmt: skip

    def take_over(self, settings: AgentSettings, now: float, *, rebirth: bool) -> None:
        """Continue with other settings, between two steps.

        :param settings: may differ in weights, risk, data and bandwidth; with `rebirth` also in policy and step.
        :param rebirth: start a new node over the store, as after a restart. It keeps its data and forgets neighbours
            and pending hand-overs. A change in how costs add up does the same, because the routing table consists of
            costs.
        """
        before, self.settings = self.settings, settings
        node = self.node
        policy = settings.policy.make()
        if rebirth or policy.costs != node.policy.costs:
            self._renew(now)
            return
        node.adopt(self.settings, policy)
        risk, old = settings.risk, before.risk
        # The average was on another scale.
        rescaled = (risk.low, risk.high) != (old.low, old.high)
        node.risk.adopt(risk.estimator(policy), forget=rescaled)
        if rescaled:
            self._observe_again()

    def begin_again(self, settings: AgentSettings, now: float, *, keep_routes: bool = False) -> None:
        """Start a new node after a frame hit a fault and the store rolled back its uncommitted changes.

        Telemetry, readings and the parameters set from the ground stay.

        :param settings: those in use before the frame came.
        :param keep_routes: the fault did not strike where neighbours and routes are changed, so they stay too.
        """
        keep_routes = keep_routes and self.settings is settings
        self.settings = settings
        self._renew(now, keep_routes=keep_routes)
        self._keep_system_id()
        if self.ground is not None:
            self.ground.keep_again()

    def _renew(self, now: float, *, keep_routes: bool = False) -> None:
        """A new node takes over the store, as after a restart."""
        self.node = self._make_node(now, self.node.observer, False, self.node if keep_routes else None)
        self.answers.forget()
        self._fit_peers()
        self._observe_again()

    def _fit_peers(self) -> None:
        """There is another node."""
        self.peers.overhears = self.node.overhears
        self.trust.serve(self.node)

    def _observe_again(self) -> None:
        if self.last_reading is not None:
            self._observe(self.last_reading)

    def share_port(self) -> None:
        """Neighbours are reached through the autopilot's port, where listeners expect one sequence of frames."""
        self.vehicle_writer = self.peers.writer
        self.vehicle_reader.check = self.trust.check(lambda message_id: message_id == TUNNEL)

    # -- what comes in -------------------------------------------------------------------------------------------------

    def vehicle_bytes(self, data: bytes, now: float) -> None:
        """A datagram from the autopilot's port: one or more whole frames."""
        for frame in self.vehicle_reader.datagram(data):
            self.guard.take(frame, now, self._hear_vehicle, _of_vehicle)

    def vehicle_frame(self, frame: Frame, now: float) -> None:
        """A frame from the autopilot's port, whoever sent it."""
        self.guard.take(frame, now, self._hear_vehicle, _of_vehicle)

    def _hear_vehicle(self, frame: Frame, now: float) -> None:
        telemetry = self.telemetry
        for listener in self.listeners:
            listener.hear(frame, now)
        latched, place = telemetry.system_id, telemetry.position
        if not telemetry.handle(frame, now):
            return
        if telemetry.system_id != latched:
            self._keep_system_id()
        if telemetry.position is not place:
            self._move(telemetry.position)
        reading = telemetry.reading
        if reading is not None and reading is not self._heard_reading:
            self._heard_reading = reading
            self._observe(reading)

    def _move(self, position: Position | None) -> None:
        """The vehicle is there now."""
        contacts = self.node.routing.neighbours.contacts
        if contacts is not None and position is not None:
            contacts.observe(position)

    def _keep_system_id(self) -> None:
        """Send under the autopilot's system id, if it is known, now and after the next start."""
        system_id, mavlink = self.telemetry.system_id, self.settings.mavlink
        if not system_id or mavlink.system_id is not None or mavlink.autopilot_id:
            return
        self.peers.writer.system_id = self.vehicle_writer.system_id = system_id
        if self.settings.ground is not None and self.store.get_meta(_SYSTEM_ID) != system_id:
            self.store.set_meta(_SYSTEM_ID, system_id)

    def reading(self, value: float, at: float, unit: str | None = None) -> Reading:
        """A reading of the node's own sensor (`AgentSettings.sensor_unit`) or of a program, at `at` on the timeline.
        `unit`: None: `AgentSettings.unit`."""
        reading = Reading(value, at, unit)
        self._observe(reading)
        return reading

    def _observe(self, reading: Reading) -> None:
        self.last_reading = reading
        self.node.risk.observe(self.settings.risk.normalised(reading.value), reading.at)

    def peer_bytes(self, data: bytes, now: float) -> Sequence[Outgoing]:
        """A datagram from the neighbours' radio: one or more whole frames. Returns the answers."""
        out: list[Outgoing] = []
        for frame in self.peers.tunnels(data):
            faults, answers = self.guard.faults, self.peer_frame(frame, now)
            if self.guard.faults != faults:
                # The answers to earlier frames depend on the changes that were rolled back.
                out.clear()
            out += answers
        return out

    def peer_frame(
        self,
        frame: Frame,
        now: float,
        may_be_neighbour: Callable[[int], bool] | None = None,
        link: str = "the neighbours",
    ) -> Sequence[Outgoing]:
        """A frame with a TUNNEL message from the neighbours' radio. Returns the answers.

        `may_be_neighbour` is called with the node id of each beacon's sender. If it returns False, the beacon is
        ignored. `link`: its name, if there are several.
        """

        def hear(frame: Frame, now: float) -> Sequence[Outgoing]:
            message = self.peers.understood(frame, now)
            if message is None:
                return ()
            if self.guard.shuts_out(message, link, now, proven=self.trust.proves(message)):
                return ()
            if type(message) is Beacon and message.sender != self.settings.node_id:
                if may_be_neighbour is not None and not may_be_neighbour(message.sender):
                    return ()
                self.peers.beacon_from(message.sender, frame.system_id)
            return self.receive(message, now)

        return self.guard.take(frame, now, hear, lambda frame: f"payloads {head_of(frame).hex()} from {link}") or ()

    def receive(self, message: Message, now: float) -> Sequence[Outgoing]:
        """A message that the neighbours' radio has brought, and that is for this node. Returns the answers."""
        node = self.node
        answers = node.receive(message, now)
        moves = node.forward(now) if self._immediate else ()
        if not answers and not moves:
            return ()
        return () if self.answers.wait(message, answers, moves, now) else self._leave(now)

    def _leave(self, now: float) -> Sequence[Outgoing]:
        """What the node has to say about the messages that it has heard."""
        return self.peers.frames(self.answers.take(self.node), self.store, now)

    # -- what goes out -------------------------------------------------------------------------------------------------

    def step(self, now: float) -> Sequence[Outgoing]:
        """Do what is due every `step_s` seconds: a turn of Alg. 1 (rarer on a slow link), then a measurement.

        Returns the frames that leave.
        """
        if now >= self._beats.next_at:
            self._beat(now)
        for service in self.services:
            service.step(now)
        node = self.node
        out: list[Outgoing] = []
        if self.trust is not KEYLESS:
            # Before the beacon, which counts where the answer has been heard.
            out = self.peers.about_links(now, node.pace)
            self._hear_released(now)
            # A frame that hits a fault replaces it.
            node = self.node
        if self._turns.due(node.pace.turn_s, self.settings.step_s, now, self._rng):
            out += self.peers.frames_of_turn(node.step(now), self.store, now)
        if self.steps_to_measurement() == 0:
            *places, reading = self.circumstances(now)
            # A reading that is a datum already may be from elsewhere. Without it, the sensor would seem to have failed.
            if any(places) if reading is None else reading is not self._recorded:
                self.measure(now)
                out += self.forward(now)
        self.steps += 1
        return out + self._take_out() if self._outbox else out

    def _hear_released(self, now: float) -> None:
        """Let core hear the statements for which the ground has vouched meanwhile. It answers none."""
        for message, frame in self.trust.released():
            if frame is None:
                self.node.receive(message, now)
                continue

            def hear(frame: Frame, now: float, message: Message = message) -> None:
                self.node.receive(message, now)

            self.guard.take(frame, now, hear, lambda _: "Receipt of the ground")

    def steps_to_measurement(self) -> int | None:
        """Steps until a measurement is due, 0: in the next one; None: none ever is."""
        data = self.settings.data
        if not data.interval_steps or self.node.base:
            return None
        steps = (_PHASES[data.due] * self.settings.node_id - self.steps) % data.interval_steps
        return None if data.until_step is not None and self.steps + steps >= data.until_step else steps

    def forward(self, now: float) -> Sequence[Outgoing]:
        """With `node.forward: immediate`, forward the data that have come in or been created since the last turn."""
        return self.peers.frames(self.node.forward(now), self.store, now) if self._immediate else ()

    def greet_vehicle(self) -> Outgoing:
        """The heartbeat to the autopilot. It must be the first frame on a port that has just been opened: an autopilot
        sends nothing to a port on which it has heard no heartbeat."""
        self._beats.greeted()
        return aside(self.vehicle_writer.frame(HEARTBEAT, _HEARTBEAT), Way.VEHICLE)

    def tell_vehicle(self, frame: bytes) -> None:
        """Send a frame of `vehicle_writer` to the autopilot, with the next `step` or `tend`."""
        self._outbox.append(aside(frame, Way.VEHICLE))

    def _beat(self, now: float) -> None:
        """Send the heartbeats that are due, from the loop that does the work: if the work stops, they stop."""
        if not self._beats.due(now):
            return
        if self._beats.due_to_vehicle():
            self._outbox.append(self.greet_vehicle())
        if self.ground is not None:
            self._outbox.append(self.ground.heartbeat())

    def _take_out(self) -> list[Outgoing]:
        said, self._outbox = self._outbox, []
        return said

    def beat_next(self, now: float) -> None:
        """Send a heartbeat as the next frame."""
        self._beats.soon(now)

    def pace_vehicle(self, rate: float) -> None:
        """Limit what is sent to the autopilot to `rate` bytes/s: it forwards all of it over a shared radio."""
        self._beats.pace(_HEARTBEAT_PART * rate)
        if self.ground is not None:
            self.ground.pace((1.0 - _HEARTBEAT_PART) * rate)

    def due(self) -> float:
        """When answers that wait leave, or questions want to be tended, seconds; infinity: never."""
        answers, questions = self.answers.due, self.node.exchange.due
        return answers if answers < questions else questions

    def tend(self, now: float) -> tuple[Sequence[Outgoing], float]:
        """Between steps: send what is due to the autopilot, the ground and the neighbours, and answers that have
        waited.

        Returns the frames that leave, and when to call again.
        """
        answers = [*self._leave(now)] if self.answers.due <= now else []
        if self.node.exchange.due <= now:
            answers += self.peers.frames(self.node.tend(now), self.store, now)
        due = self.due()
        if self.ground is not None:
            self._beat(now)
            due = min(due, self._beats.next_at, self.ground.tend(now, self._outbox))
        return [*answers, *self._take_out()], due

    def measure(self, now: float) -> DatumId | None:
        """Create a datum from the vehicle's position and the sensor's reading. None: the store is full (overflow)."""
        position, local, reading = self.circumstances(now)
        try:
            payload = self._measurement(position, local, reading, self.node.risk.risk(now), now)
            return self._put(payload, now, own=True)
        except StoreFullError:
            self.refused += 1
            return None

    def record(self, reading: Reading, position: Position | None, now: float, *, own: bool) -> DatumId:
        """Create a datum of one reading, as old as that.

        :param position: where it was measured; None: unknown, and where the vehicle is if it is the last reading.
        :param own: whether it may use the space that others' data leave free for the node's measurements.
        :raises StoreFullError: there is no space.
        """
        risk, local = self.node.risk.risk(now), None
        if reading is not self.last_reading:
            risk = min(max(self.settings.risk.normalised(reading.value), 0.0), 1.0)
        elif position is None:
            position, local, _ = self.circumstances(now)
        id = self._put(self._measurement(position, local, reading, risk, now), reading.at, own=own)
        self._recorded = reading
        return id

    def _measurement(
        self, position: Position | None, local: LocalPosition | None, reading: Reading | None, risk: float, now: float
    ) -> bytes:
        # A place that was stated has no time of ours, and nobody knows its error.
        measured = position is self.telemetry.position
        payload = encode_measurement(
            Measurement(
                position.latitude if position else None,
                position.longitude if position else None,
                position.altitude if position else None,
                reading.value if reading else None,
                risk,
                local[:3] if local else None,
                self.unit_of(reading),
                _error_m(position, self.telemetry.accuracy, now) if position and measured else None,
            )
        )
        size = min(self.settings.data.bytes, self.node.most_put)
        return payload + self._rng.randbytes(size - len(payload)) if size > len(payload) else payload

    def _put(self, payload: bytes, created: float, *, own: bool) -> DatumId:
        """As for `record`."""
        if not own and not self.node.holdings.room_for(len(payload), own=False):
            raise StoreFullError("the store is full, except for the space reserved for this node's measurements")
        return self.node.put(payload, created, Kind.MEASUREMENT)

    def unit_of(self, reading: Reading | None) -> str | None:
        """Its unit, a key of `wire.measurement.UNITS`; None: unknown."""
        return self.settings.unit if reading is None or reading.unit is None else reading.unit

    def circumstances(self, now: float) -> tuple[Position | None, LocalPosition | None, Reading | None]:
        """What a measurement would contain: position, local position and reading, as far as they are not stale."""
        position, local, reading = self.telemetry.position, self.telemetry.local, self.last_reading
        return (
            position if position is not None and now - position.at <= POSITION_STALE_S else None,
            local if local is not None and now - local.at <= POSITION_STALE_S else None,
            reading if reading is not None and now - reading.at <= self.settings.risk.stale_s else None,
        )

    def tell_ground(self, severity: int, text: str) -> None:
        """Send a STATUSTEXT to the people at the ground station; `severity` as MAV_SEVERITY."""
        log.log(logging.ERROR if severity <= CRITICAL else logging.WARNING, "%s", text)
        if self.ground is not None:
            self.ground.tell(severity, text)
            return
        self._text_id = self._text_id % 0xFFFF + 1
        for message in statustext(severity, text, text_id=self._text_id):
            self.tell_vehicle(self.vehicle_writer.message(message))


def _error_m(position: Position, accuracy: Accuracy | None, now: float) -> float | None:
    """Bound of the error of a position, metres: two standard deviations, and the way flown since. None: unknown."""
    if accuracy is None or now - accuracy.at > POSITION_STALE_S:
        return None
    return 2.0 * accuracy.horizontal_m + math.hypot(position.north, position.east) * (now - position.at)

"""One node, whole, without input and output: the same code on a drone, at a base and in the mock swarm."""

from __future__ import annotations

import logging
import math
import random
from collections.abc import Sequence
from typing import Protocol

from rass_mav.agent.ground import Ground, Way
from rass_mav.agent.heartbeats import Heartbeats
from rass_mav.agent.outgoing import Outgoing, frames_of
from rass_mav.agent.parameters import recall
from rass_mav.agent.settings import AgentSettings
from rass_mav.core.datum import DatumId, Kind
from rass_mav.core.messages import Beacon, Message
from rass_mav.core.node import Node
from rass_mav.core.observer import Observer
from rass_mav.core.participant import Participant
from rass_mav.core.replica import Replica
from rass_mav.core.store import Store
from rass_mav.errors import MalformedError, StoreFullError
from rass_mav.mavlink.dialect import payload_of
from rass_mav.mavlink.frames import Frame, FrameWriter
from rass_mav.mavlink.identity import addressed_to
from rass_mav.mavlink.messages import HEARTBEAT, TUNNEL, companion_heartbeat, statustext
from rass_mav.mavlink.reader import FrameReader
from rass_mav.mavlink.telemetry import Reading, Telemetry
from rass_mav.mavlink.tunnel import decode_tunnel, tunnel_from_datagram
from rass_mav.wire import decode
from rass_mav.wire.codec import ForeignError
from rass_mav.wire.measurement import MEASUREMENT_BYTES, Measurement, encode_measurement

log = logging.getLogger(__name__)

#: A rival under the same node id is told to the ground at most this often, seconds.
RIVAL_REPORT_S = 30.0
#: Refused measurements likewise.
FULL_REPORT_S = 30.0
#: A position older than this is not where the vehicle is, seconds.
POSITION_STALE_S = 10.0
# Under this name the store keeps the system id of the autopilot.
_SYSTEM_ID = "system_id"
_CRITICAL = 2
_WARNING = 4
# Always the same bytes, so they are packed once.
_HEARTBEAT = payload_of(companion_heartbeat())
# The part that heartbeats have of what the autopilot is told, where its radio is slow.
_HEARTBEAT_PART = 0.7


class VehicleService(Protocol):
    """Does something with the autopilot or the ground station, over the autopilot's port.

    What it has to say it appends to the agent's `to_vehicle`.
    """

    def hear(self, frame: Frame, now: float) -> None:
        """A frame from the autopilot's port, before telemetry takes it."""

    def step(self, now: float) -> None:
        """Called once a step."""


class Agent:
    """Bytes in, frames out. The driver brings time, links and commits (docs/architecture.md)."""

    # A thousand of them share a processor's cache in the mock swarm.
    __slots__ = (
        "_beats",
        "_component_id",
        "_fixed_system_id",
        "_immediate",
        "_next_full_report",
        "_next_rival_report",
        "_next_turn",
        "_node_id",
        "_payload_type",
        "_phase",
        "_refused",
        "_rng",
        "_text_id",
        "_turn_s",
        "beacon_from",
        "foreign",
        "frames_received",
        "ground",
        "last_reading",
        "malformed",
        "node",
        "peer_reader",
        "peer_writer",
        "services",
        "settings",
        "steps",
        "store",
        "telemetry",
        "to_vehicle",
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
    ) -> None:
        """`now` in seconds on the timeline of all later calls; `rng` decides all that is left to chance.

        `newborn`: nobody can remember this node from an earlier life (as when a mock swarm begins).
        """
        configured = settings
        unfit: list[str] = []
        if settings.ground is not None:
            settings, unfit = recall(store, configured)
        self.settings = settings
        self._rng = rng
        self.store = store
        self.node = self._make_node(now, observer, newborn)
        mavlink = settings.mavlink
        self.telemetry = Telemetry(mavlink.autopilot_id, reading_name=mavlink.reading_name)
        system_id = mavlink.system_id or mavlink.autopilot_id or (settings.node_id - 1) % 255 + 1
        if settings.ground is not None and mavlink.system_id is None and not mavlink.autopilot_id:
            # Autopilots never forget a sender, so the right id from the first frame on, if it is known.
            system_id = store.get_meta(_SYSTEM_ID) or system_id
        self.peer_writer = FrameWriter(system_id, mavlink.component_id)
        self.vehicle_writer = FrameWriter(system_id, mavlink.component_id)
        self.vehicle_reader = FrameReader()
        self.peer_reader = FrameReader()
        self.to_vehicle: list[bytes] = []
        """Frames for the autopilot (and through it the ground station); the driver takes them away."""
        self.frames_received = 0
        """TUNNEL frames of ours heard from the radio, whoever they were for."""
        self.malformed = 0
        """TUNNEL payloads that do not parse."""
        self.foreign = 0
        """TUNNEL payloads of another version, type or purpose."""
        self.steps = 0
        """Steps done."""
        self.last_reading: Reading | None = None
        """The last reading, of the autopilot or of the node's own sensor."""
        self.beacon_from: int | None = None
        """Node id of the sender of the last beacon. A driver whose links learn addresses sets it to None before
        `peer_bytes` and looks at it after."""
        self._node_id = settings.node_id
        self._immediate = settings.forward == "immediate"
        self._phase = {"step-id": 1, "step+id": -1, "together": 0}[settings.data.due] * settings.node_id
        self._payload_type = mavlink.payload_type
        self._component_id = mavlink.component_id
        self._fixed_system_id = mavlink.system_id is not None
        self._beats = Heartbeats(now)
        self._text_id = 0
        self._next_rival_report = now
        self._refused = 0
        self._next_full_report = now
        self._next_turn = now
        self._turn_s = settings.step_s
        self.services: list[VehicleService] = []
        """Who else listens to the autopilot's port."""
        self.ground = None if settings.ground is None else Ground(self, settings.ground, configured, now)
        """None: there is no ground station."""
        for error in unfit:
            self.tell_ground(_WARNING, f"RASS: not taken over: {error}")

    def _make_node(self, now: float, observer: Observer | None, newborn: bool) -> Participant:
        settings = self.settings
        policy = settings.policy.make()
        kind = Replica if policy.replicates else Node
        return kind(
            settings.node_settings(), self.store, policy, settings.risk.estimator(policy), self._rng,
            now=now, observer=observer, newborn=newborn,
        )  # fmt: skip

    def take_over(self, settings: AgentSettings, now: float, *, rebirth: bool) -> None:
        """Go on with other settings, between two steps.

        :param settings: differ in weights, risk, data and bandwidth; with `rebirth` in the policy or the step too.
        :param rebirth: the node begins anew over its store, as after a restart: what it holds stays, neighbours and
            pending hand-overs are forgotten. It does so in any case if costs add up in another way now: the routing
            table is made of them.
        """
        before, self.settings = self.settings, settings
        node = self.node
        policy = settings.policy.make()
        if rebirth or policy.costs != node.policy.costs:
            self.node = self._make_node(now, node.observer, False)
            self._observe_again()
            return
        node.adopt(settings.node_settings(), policy)
        risk, old = settings.risk, before.risk
        # What was averaged was on another scale.
        rescaled = (risk.low, risk.high) != (old.low, old.high)
        node.risk.adopt(risk.estimator(policy), forget=rescaled)
        if rescaled:
            self._observe_again()

    def _observe_again(self) -> None:
        if self.last_reading is not None:
            self._observe(self.last_reading)

    def share_port(self) -> None:
        """The neighbours are reached through the autopilot's port: who listens there expects one sequence."""
        self.vehicle_writer = self.peer_writer
        if self.ground is not None:
            self.ground.outboxes[Way.VEHICLE].writer = self.peer_writer

    # -- what comes in -------------------------------------------------------------------------------------------------

    def vehicle_bytes(self, data: bytes, now: float) -> None:
        """A datagram from the autopilot's port: whole frames, one or several."""
        reader = self.vehicle_reader
        for frame in reader.feed(data):
            self.vehicle_frame(frame, now)
        if reader.pending:
            for frame in reader.flush():
                self.vehicle_frame(frame, now)

    def vehicle_frame(self, frame: Frame, now: float) -> None:
        """A frame from the autopilot's port, whoever said it."""
        if self.ground is not None:
            self.ground.handle(frame, Way.VEHICLE, now)
        telemetry = self.telemetry
        for service in self.services:
            service.hear(frame, now)
        latched = telemetry.system_id
        if not telemetry.handle(frame, now):
            return
        if telemetry.system_id != latched and not self._fixed_system_id:
            self.peer_writer.system_id = self.vehicle_writer.system_id = telemetry.system_id
            if self.ground is not None:
                self.ground.writer.system_id = telemetry.system_id
                if self.store.get_meta(_SYSTEM_ID) != telemetry.system_id:
                    self.store.set_meta(_SYSTEM_ID, telemetry.system_id)
        reading = telemetry.reading
        if reading is not None and reading is not self.last_reading and not self.settings.own_sensor:
            self._observe(reading)

    def reading(self, value: float, at: float) -> None:
        """What the node's own sensor said (`AgentSettings.own_sensor`): in its unit, at `at` on the timeline."""
        self._observe(Reading(value, at))

    def _observe(self, reading: Reading) -> None:
        self.last_reading = reading
        self.node.risk.observe(self.settings.risk.normalised(reading.value), reading.at)

    def peer_bytes(self, data: bytes, now: float) -> Sequence[Outgoing]:
        """A datagram from the neighbours' radio: whole frames, one or several. Returns the answers."""
        fields = tunnel_from_datagram(data)
        if fields is not None:
            _, _, system, component, payload_type, payload = fields
            return self._tunnel(system, component, payload_type, payload, now)
        out: list[Outgoing] = []
        # No frame spans two datagrams: what is cut off is garbage, and must not wait for the next one.
        for frame in [*self.peer_reader.feed(data), *self.peer_reader.flush()]:
            if frame.message_id == TUNNEL:
                out += self.peer_frame(frame, now)
        return out

    def peer_frame(self, frame: Frame, now: float, only: frozenset[int] | None = None) -> Sequence[Outgoing]:
        """A frame with a TUNNEL message from the neighbours' radio. Returns the answers.

        `only`: node ids that may be neighbours; beacons of others go unheard. None: all.
        """
        try:
            tunnel = decode_tunnel(frame.payload)
        except MalformedError as error:
            self._count_malformed(error)
            return ()
        return self._tunnel(
            tunnel.target_system, tunnel.target_component, tunnel.payload_type, tunnel.payload, now, only
        )

    def _tunnel(
        self,
        system: int,
        component: int,
        payload_type: int,
        payload: bytes,
        now: float,
        only: frozenset[int] | None = None,
    ) -> Sequence[Outgoing]:
        if payload_type != self._payload_type:
            self.foreign += 1
            return ()
        self.frames_received += 1
        if (system or component) and not addressed_to(
            system, component, self.peer_writer.system_id, self._component_id
        ):
            return ()
        try:
            message = decode(payload, now, self._node_id)
        except MalformedError as error:
            self._count_malformed(error)
            return ()
        if message is None:
            return ()
        if type(message) is Beacon:
            self.beacon_from = message.sender
            if only is not None and message.sender not in only and message.sender != self._node_id:
                return ()
        answers = self.node.receive(message, now)
        if self._immediate:
            answers += self.node.forward(now)
        return self._encoded(answers, now) if answers else ()

    def _count_malformed(self, error: MalformedError) -> None:
        if isinstance(error, ForeignError):
            self.foreign += 1
        else:
            self.malformed += 1
        log.debug("frame not understood: %s", error)

    # -- what goes out -------------------------------------------------------------------------------------------------

    def step(self, now: float) -> Sequence[Outgoing]:
        """What is due every `step_s` seconds: a turn of Alg. 1, unless the link bears fewer; then a measurement.

        Returns what the node sends.
        """
        self._beat(now)
        for service in self.services:
            service.step(now)
        out: list[Outgoing] = []
        node = self.node
        step_s = self.settings.step_s
        if node.pace.turn_s <= step_s or now >= self._next_turn - 0.5 * step_s:
            self._next_turn = now + self._until_next_turn(node.pace.turn_s, step_s)
            out = self._encoded(node.step(now), now)
        if self.node.rivals and now >= self._next_rival_report:
            self._report_rivals(now)
        data = self.settings.data
        if (
            data.interval_steps
            and not self.node.base
            and (self.steps - self._phase) % data.interval_steps == 0
            and (data.until_step is None or self.steps < data.until_step)
        ):
            self.measure(now)
            out += self.forward(now)
        self.steps += 1
        return out

    def forward(self, now: float) -> Sequence[Outgoing]:
        """With `node.forward: immediate`: what came in or was put since the last turn moves on; else nothing."""
        return self._encoded(self.node.forward(now), now) if self._immediate else ()

    def greet_vehicle(self, now: float) -> None:
        """Say the heartbeat to the autopilot. On a port that has just been opened it must be the first frame: an
        autopilot sends nothing to where it has heard nobody."""
        self.to_vehicle.insert(0, self.vehicle_writer.frame(HEARTBEAT, _HEARTBEAT))
        self._beats.greeted()

    def _beat(self, now: float) -> None:
        """Say the heartbeats that are due. By the loop that does the work, so that they stop when the work stops."""
        if not self._beats.due(now):
            return
        if self._beats.due_to_vehicle():
            self.greet_vehicle(now)
        if self.ground is not None:
            self.ground.to_ground.append(self.ground.writer.frame(HEARTBEAT, _HEARTBEAT))

    def beat_next(self, now: float) -> None:
        """Let a heartbeat be the next frame that leaves."""
        self._beats.soon(now)

    def pace_vehicle(self, rate: float) -> None:
        """The autopilot passes on what it is told over a radio that others need too: no more than `rate`, bytes/s."""
        self._beats.pace(_HEARTBEAT_PART * rate)
        if self.ground is not None:
            self.ground.outboxes[Way.VEHICLE].rate = (1.0 - _HEARTBEAT_PART) * rate

    def tend(self, now: float) -> float:
        """Between steps: say to the autopilot and the ground what is due. Returns when to come again."""
        if self.ground is None:
            return math.inf
        self._beat(now)
        return min(self._beats.next_at, self.ground.tend(now))

    def _until_next_turn(self, turn_s: float, step_s: float) -> float:
        """Whole steps, seconds. A new length begins at a random place: nodes that were switched on together, or have
        met, must not all speak in the same second."""
        changed, self._turn_s = turn_s != self._turn_s, turn_s
        if turn_s > step_s and changed:
            return step_s * self._rng.randint(1, round(turn_s / step_s))
        return turn_s

    def _encoded(self, messages: Sequence[Message], now: float) -> list[Outgoing]:
        return frames_of(messages, self.peer_writer, self._payload_type, self.store, now)

    def measure(self, now: float) -> DatumId | None:
        """Make a datum of where the vehicle is and what the sensor says. None: there was no room (overflow)."""
        node = self.node
        telemetry = self.telemetry
        position = telemetry.position
        if position is not None and now - position.at > POSITION_STALE_S:
            position = None
        local = telemetry.local
        reading = self.last_reading
        fresh = reading is not None and now - reading.at <= self.settings.risk.stale_s
        payload = encode_measurement(
            Measurement(
                position.latitude if position else None,
                position.longitude if position else None,
                position.altitude if position else None,
                reading.value if reading is not None and fresh else None,
                node.risk.risk(now),
                local[:3] if local is not None and now - local.at <= POSITION_STALE_S else None,
            )
        )
        if self.settings.data.bytes > MEASUREMENT_BYTES:
            payload += self._rng.randbytes(self.settings.data.bytes - MEASUREMENT_BYTES)
        try:
            return node.put(payload, now, Kind.MEASUREMENT)
        except StoreFullError:
            self._refused += 1
            if now >= self._next_full_report:
                self._next_full_report = now + FULL_REPORT_S
                self.tell_ground(_WARNING, f"RASS: store full, {self._refused} measurements refused so far")
            return None

    def tell_ground(self, severity: int, text: str) -> None:
        """A STATUSTEXT for the people at the ground station; `severity` as MAV_SEVERITY."""
        log.log(logging.ERROR if severity <= _CRITICAL else logging.WARNING, "%s", text)
        if self.ground is not None:
            self.ground.tell(severity, text)
            return
        self._text_id = self._text_id % 0xFFFF + 1
        for message in statustext(severity, text, text_id=self._text_id):
            self.to_vehicle.append(self.vehicle_writer.message(message))

    def _report_rivals(self, now: float) -> None:
        recent = [epoch for epoch, at in self.node.rivals.items() if now - at <= RIVAL_REPORT_S]
        self._next_rival_report = now + RIVAL_REPORT_S
        if recent:
            self.tell_ground(
                _CRITICAL,
                f"RASS: another node with node id {self.node.id} on the air (epoch {recent[0]:08x}), change one",
            )

"""Runs conversations with an autopilot over its port, on an event loop."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Iterable, Sequence

from rass_mav.link.vehicle import VehiclePort
from rass_mav.mavlink.dialect import payload_of
from rass_mav.mavlink.frames import FLAG_SIGNED, FrameReader, FrameWriter
from rass_mav.mavlink.messages import HEARTBEAT, companion_heartbeat
from rass_mav.mavlink.signedport import SignedPort
from rass_mav.mavlink.vehicle_parameters import ParameterValue

from .exchange import NO_VERSION, Autopilot, Exchange, Introduction, Patience, Talk, VehicleError, reading, setting
from .names import SYSTEM_ID_NAMES

_HEARTBEAT_S = 1.0
_HEARTBEAT = payload_of(companion_heartbeat())


class Session:
    """Talks to the autopilot with the node's system id and component id. The node itself must not be running."""

    def __init__(
        self,
        port: VehiclePort,
        clock: Callable[[], float],
        *,
        system_id: int,
        component_id: int,
        patience: Patience,
        signing: SignedPort | None = None,
    ) -> None:
        """:param clock: returns seconds on any timeline that does not jump.
        :param system_id: the own system id to use until the autopilot is known.
        :param signing: of an autopilot with MAVLink signing; None: nothing is signed, or checked.
        """
        self.port = port
        port.sign = None if signing is None else signing.sign
        self._clock = clock
        self.patience = patience
        self._writer = FrameWriter(system_id, component_id)
        self._writer.flags = 0 if signing is None else FLAG_SIGNED
        self._signing = signing
        self._reader = FrameReader(signing)
        self._wake = asyncio.Event()
        self._generation = 0
        self._beat_at = -math.inf

    async def find(self, system_id: int) -> Autopilot:
        """The autopilot with this system id; 0: the first one heard. Raises `VehicleError` with what was heard."""
        self.port.start(self._wake.set)
        talk = Introduction(system_id, self.patience)
        await self.hold(talk, lambda: talk.autopilot is not None, self.patience.heartbeat_s)
        if talk.autopilot is None:
            raise VehicleError(f"{self.port.name}: {self._why_nobody(talk, system_id)}")
        self._writer.system_id = talk.autopilot.system_id
        await self.hold(talk, lambda: talk.done, math.inf)
        return talk.autopilot

    def _why_nobody(self, talk: Introduction, system_id: int) -> str:
        if self.port.trouble:
            return self.port.trouble.lower()
        if talk.others:
            heard = ", ".join(map(str, sorted(talk.others)))
            return f"no autopilot with system id {system_id} heard, but {heard} (mavlink.autopilot_id)"
        if self._signing is not None and self._signing.unsigned + self._signing.forged > 0:
            how, remedy = "not signed", "rass-mav params signing"
            if self._signing.forged:
                how = "signed with another key"
            elif self._signing.mavlink_1:
                how, remedy = "MAVLink 1, which has no signatures", "set SERIALn_PROTOCOL 2 for this port"
            return f"the autopilot's frames are {how}, and autopilot.signing is true ({remedy})"
        if self._reader.frames:
            return "MAVLink is heard, but no autopilot's heartbeat"
        if self._reader.malformed or self._reader.garbage_bytes:
            return "the input is not MAVLink (wrong speed, or another device)"
        return "nothing heard"

    async def read(self, autopilot: Autopilot, names: Iterable[str], *, guesses: bool = False) -> Exchange:
        """Ask for parameters by name. Raises `VehicleError` if no question is answered, unless these are guesses."""
        talk = Exchange(autopilot, {name: reading(autopilot, name) for name in names}, self.patience)
        await self.hold(talk, lambda: talk.done, math.inf)
        if not guesses and talk.silent and not talk.values and not talk.refused:
            raise VehicleError(f"{self.port.name}: system {autopilot.system_id} does not answer parameter requests")
        return talk

    async def write(self, autopilot: Autopilot, wanted: Sequence[ParameterValue]) -> tuple[Exchange, Exchange]:
        """Set parameters one after another, in this order, and read them back.

        :returns: the answers to setting, and to reading back; the latter are the values in use.
        :raises VehicleError: no answer when they were read back.
        """
        before = autopilot.system_id
        new = next((int(value.value) for value in wanted if value.name in SYSTEM_ID_NAMES), 0)
        talk = Exchange(
            autopilot,
            {value.name: setting(autopilot, value) for value in wanted},
            self.patience._replace(window=1),
            new_system_id=new,
        )
        await self.hold(talk, lambda: talk.done, math.inf)
        names = [value.name for value in wanted]
        if new and new != before:
            # It may answer under the old id for a while, and then change to the new one.
            for system_id in (autopilot.system_id, new if autopilot.system_id == before else before):
                autopilot.system_id = system_id
                try:
                    return talk, await self.read(autopilot, names)
                except VehicleError:
                    continue
        return talk, await self.read(autopilot, names)

    async def answers(self, autopilot: Autopilot) -> bool:
        """Whether it answers the question for its version once more."""
        talk = Introduction(autopilot.system_id, self.patience)
        await self.hold(talk, lambda: talk.done, 2 * self.patience.heartbeat_s)
        return talk.autopilot is not None and talk.autopilot.version != NO_VERSION

    async def hold(self, talk: Talk, until: Callable[[], bool], timeout_s: float) -> None:
        """Hear and say until the talk is over, or for so many seconds."""
        give_up = self._clock() + timeout_s
        while True:
            self._take_in(talk)
            now = self._clock()
            if until() or now >= give_up:
                return
            self._beat(now)
            for message_id, payload in talk.say(now):
                self.port.send(self._writer.frame(message_id, payload))
            if until():
                return
            pause = min(give_up, talk.next_at, self._beat_at) - self._clock()
            if pause > 0:
                try:
                    await asyncio.wait_for(self._wake.wait(), pause)
                except asyncio.TimeoutError:
                    continue
                self._wake.clear()

    def _take_in(self, talk: Talk) -> None:
        arrived = self.port.receive()
        if self.port.generation != self._generation:
            # An autopilot sends nothing to a port on which it has heard nothing, so send the heartbeat first.
            self._generation = self.port.generation
            self._reader.flush()
            self._beat_at = -math.inf
        for data in arrived:
            frames = self._reader.feed(data) if self.port.stream else self._reader.datagram(data)
            for frame in frames:
                talk.hear(frame, self._clock())

    def _beat(self, now: float) -> None:
        if now >= self._beat_at:
            self._beat_at = now + _HEARTBEAT_S
            self.port.send(self._writer.frame(HEARTBEAT, _HEARTBEAT))

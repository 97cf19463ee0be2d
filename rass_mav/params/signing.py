"""Turns MAVLink signing on or off at an autopilot (SETUP_SIGNING), and checks that it works then."""

from __future__ import annotations

import math
from enum import Enum

from rass_mav.mavlink.firmware import PX4
from rass_mav.mavlink.frames import MAGIC_V2, Frame
from rass_mav.mavlink.identity import AUTOPILOT_COMPONENT
from rass_mav.mavlink.messages import RADIO_STATUS
from rass_mav.mavlink.signedport import MOST, PER_SECOND, SignedPort
from rass_mav.mavlink.signing import SETUP_SIGNING, SigningKey, setup_signing

from .exchange import Asking, Autopilot, Patience, Question, VehicleError
from .names import second_protocol
from .session import Session

#: Signing timestamps count from the first day of 2015, seconds since 1970.
_EPOCH = 1_420_070_400.0
#: The first PX4 with signing.
_PX4_SIGNS = (1, 18)


class Signature(Enum):
    """How an autopilot signs its frames."""

    NONE = "off"
    OURS = "on, with this drone's key"
    OTHER = "on, with another key"
    HIDDEN = "not visible: its frames are MAVLink 1"


class Watch(SignedPort):
    """Lets in everything at first, and notes how autopilots sign."""

    __slots__ = ("found", "open", "radio")

    def __init__(self, key: SigningKey, start: int) -> None:
        """As a `SignedPort`."""
        super().__init__(key, start)
        self.open = True
        """Whether frames without the right signature are let in, too."""
        self.found: dict[int, Signature] = {}
        """By system id, how the autopilot has signed its last frame."""
        self.radio = False
        """Whether a telemetry radio was heard, which is then between this computer and the autopilot: autopilots do
        not forward what radios say about themselves."""

    def passes(self, frame: bytes, message_id: int, *, signed: bool) -> bool:
        """As in `SignedPort`, once `open` is false."""
        before = self.forged
        right = super().passes(frame, message_id, signed=signed)
        system_id, component_id = frame[5:7] if frame[0] == MAGIC_V2 else frame[3:5]
        if message_id == RADIO_STATUS:
            self.radio = True
        elif component_id == AUTOPILOT_COMPONENT:
            if frame[0] != MAGIC_V2:
                # It may have a key, use it on its other ports, and refuse here what is not signed.
                signature = Signature.HIDDEN
            elif not signed:
                signature = Signature.NONE
            else:
                signature = Signature.OTHER if self.forged > before else Signature.OURS
            self.found[system_id] = signature
        return right or self.open


class _Setup(Asking):
    """Sends SETUP_SIGNING until the autopilot signs as it should."""

    def __init__(self, question: Question, autopilot: Autopilot, watch: Watch, wanted: Signature, patience: Patience):
        super().__init__(patience)
        self._question = question
        self._autopilot = autopilot
        self._watch = watch
        self._wanted = wanted
        self.reached = False

    def hear(self, frame: Frame, now: float) -> None:
        """The watch has seen the signature."""
        self.reached = self._tries > 0 and self._watch.found.get(self._autopilot.system_id) is self._wanted
        self.done = self.done or self.reached

    def say(self, now: float) -> list[Question]:
        """The message is due, for the first time or again."""
        return self._again(self._question, now)


def refusal(autopilot: Autopilot, watch: Watch) -> str:
    """Why signing must not be changed on this vehicle now; empty: it may be."""
    firmware = autopilot.firmware
    if autopilot.armed:
        return f"vehicle {autopilot.system_id} is armed"
    if firmware.autopilot == PX4 and any(firmware.version) and firmware.version[:2] < _PX4_SIGNS:
        return f"{firmware} has no signing, which came with {'.'.join(map(str, _PX4_SIGNS))}"
    if watch.found.get(autopilot.system_id) is Signature.HIDDEN:
        return f"this port sends MAVLink 1, which has no signatures: {second_protocol(firmware)}"
    if watch.radio:
        return "a telemetry radio is on this port, and others could read the key: connect the autopilot by wire or USB"
    return ""


async def turn_on(session: Session, system_id: int, watch: Watch, key: SigningKey, date: float) -> float:
    """Give an autopilot the key, and ask it a signed question.

    :param date: seconds since 1970, right or wrong.
    :returns: by how much its timestamps are then above the one that it was given, seconds.
    :raises VehicleError: it does not sign with the key then, or does not answer, or must be left alone.
    """
    autopilot = await _found(session, system_id, watch)
    clock = int((date - _EPOCH) * PER_SECOND)
    timestamp = max(clock if 0 < clock < MOST else 0, watch.next)
    await _change(session, autopilot, watch, Signature.OURS, (key, timestamp))
    ahead_s = (watch.newest - timestamp) / PER_SECOND
    await _check(session, autopilot, watch)
    return ahead_s


async def check(session: Session, system_id: int, watch: Watch) -> None:
    """Ask a signed question, and take a signed answer. Raises `VehicleError` if there is none."""
    await _check(session, await session.find(system_id), watch)


async def turn_off(session: Session, system_id: int, watch: Watch) -> None:
    """Take the key from an autopilot. Raises `VehicleError` if it still signs then, or must be left alone."""
    autopilot = await _found(session, system_id, watch)
    await _change(session, autopilot, watch, Signature.NONE, (None, 0))


async def _found(session: Session, system_id: int, watch: Watch) -> Autopilot:
    autopilot = await session.find(system_id)
    if why := refusal(autopilot, watch):
        raise VehicleError(f"{session.port.name}: {why}")
    return autopilot


async def _check(session: Session, autopilot: Autopilot, watch: Watch) -> None:
    watch.open = False
    if not await session.answers(autopilot):
        raise VehicleError(
            f"{session.port.name}: the autopilot signs with this drone's key, but does not answer signed requests: it "
            "remembers at most 16 signed senders; restart it and try again"
        )


async def _change(
    session: Session, autopilot: Autopilot, watch: Watch, wanted: Signature, setup: tuple[SigningKey | None, int]
) -> None:
    payload = setup_signing(*setup, target_system=autopilot.system_id, target_component=AUTOPILOT_COMPONENT)
    question = Question(SETUP_SIGNING, payload)
    talk = _Setup(question, autopilot, watch, wanted, session.patience)
    await session.hold(talk, lambda: talk.done, math.inf)
    if talk.reached:
        return
    found = watch.found.get(autopilot.system_id, Signature.NONE)
    why = {
        Signature.NONE: "it did not accept the key: it may not support signing, or it refused (see its messages at the "
        "ground station)",
        Signature.OURS: "it still signs; try again, or turn signing off at its USB port (ArduPilot: SERIAL0)",
        Signature.OTHER: "it has another key; connect to its USB port (ArduPilot: SERIAL0), which needs no signature, "
        "or first turn signing off with the ground station that holds the key",
        Signature.HIDDEN: "it sends MAVLink 1 now, which has no signatures",
    }[found]
    raise VehicleError(f"{session.port.name}: {why}")

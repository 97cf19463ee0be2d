"""The radio of a link: is it the one that the configuration names, and how is it set up?

DroneBridge for ESP32 answers questions at its serial port (DroneBridge/ESP32 v2.3.0, main/db_mavlink_msgs.c): the
parameter SYS_ESP32_MODE, and AUTOPILOT_VERSION. It sends neither unasked.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from rass_mav.app.config import RunConfig
from rass_mav.errors import MalformedError
from rass_mav.link.radios import RADIO_COMPONENT
from rass_mav.mavlink.component import AUTOPILOT_VERSION, PARAM_REQUEST_READ, PARAM_VALUE
from rass_mav.mavlink.firmware import read_version, request_message
from rass_mav.mavlink.frames import Frame
from rass_mav.mavlink.messages import COMMAND_LONG
from rass_mav.mavlink.vehicle_parameters import param_request_read, read_value
from rass_mav.params.streams import stream_load

from . import vehicle
from .finding import Finding, failed, passed, skipped, warned
from .watch import Evidence, RadioAnswers

#: The radio with which doctor talks.
DRONEBRIDGE = "dronebridge"
#: The mode of a DroneBridge is this parameter; these are its values (main/db_parameters.h).
MODE = "SYS_ESP32_MODE"
_MODES = {
    1: "Wi-Fi access point",
    2: "Wi-Fi client",
    3: "Wi-Fi access point, long range",
    4: "ESP-NOW, air",
    5: "ESP-NOW, ground",
    6: "Bluetooth",
}
_AIR, _GROUND = 4, 5
#: Since this version it sends RADIO_STATUS and heartbeats by its own clock, and says its version in full.
_OLDEST = (2, 2, 0)
#: Questions are asked so often, with so many seconds between.
_TRIES, _AGAIN_S = 3, 1.0


class RadioQuestions:
    """A service of a trial's agent, which asks the DroneBridge at a serial link. The first answer is that of the own
    one: the others hear the question too, over the air, and answer later."""

    def __init__(
        self, send: Callable[[bytes], None], frame: Callable[[int, bytes], bytes], is_open: Callable[[], bool]
    ) -> None:
        """`send`: to the radio. `frame`: makes a frame of a message's id and payload. `is_open`: is its port open?"""
        self.answers = RadioAnswers()
        self._send = send
        self._frame = frame
        self._is_open = is_open
        self._tries = 0
        self._ask_at = -math.inf

    @property
    def busy(self) -> bool:
        """Whether an answer may still come."""
        return None in self.answers and self._tries < _TRIES

    def step(self, now: float) -> None:
        """Once a step: ask what is not known."""
        if not self.busy or now < self._ask_at or not self._is_open():
            return
        self._tries += 1
        self._ask_at = now + _AGAIN_S
        if self.answers.mode is None:
            payload = param_request_read(MODE, target_system=0, target_component=RADIO_COMPONENT)
            self._send(self._frame(PARAM_REQUEST_READ, payload))
        if self.answers.version is None:
            payload = request_message(AUTOPILOT_VERSION, target_system=0, target_component=RADIO_COMPONENT)
            self._send(self._frame(COMMAND_LONG, payload))

    def hear(self, frame: Frame) -> None:
        """A frame from the radio's port."""
        if frame.component_id != RADIO_COMPONENT:
            return
        try:
            if frame.message_id == PARAM_VALUE and self.answers.mode is None:
                value = read_value(frame, bytewise=True)
                if value.name == MODE:
                    self.answers = self.answers._replace(mode=int(value.value))
            elif frame.message_id == AUTOPILOT_VERSION and self.answers.version is None:
                self.answers = self.answers._replace(version=read_version(frame).version)
        except (MalformedError, ValueError):
            pass  # noise, or another program's


def radio(config: RunConfig, index: int, evidence: Evidence) -> Finding | None:
    """Is it the radio that the configuration names, and set up as it should be? None: nothing can be said."""
    section = config.links[index]
    name = f"links[{index}] radio"
    state = evidence.link(index)
    if state is None or state["trouble"] or section.kind.ip:
        return None
    if not section.kind.radio:
        return _carries(config, index)
    heard = state.get("radio_status")
    if section.radio == DRONEBRIDGE:
        return None if section.kind.through else _dronebridge(config, index, evidence)
    if heard is None:
        return None
    who = f"RADIO_STATUS comes from system {heard['system_id']}, component {heard['component_id']}"
    known = section.known_radio
    if known is None:
        believed = (config.mavlink.radio_system_id, config.mavlink.radio_component_id)
    else:
        believed = (known.system_id or heard["system_id"], RADIO_COMPONENT)
    if (heard["system_id"], heard["component_id"]) != believed:
        like = ", as from a DroneBridge for ESP32" if heard["txbuf"] == 0 else ""
        return warned(
            name, f"{who}, with txbuf {heard['txbuf']}{like}; it is ignored",
            f"name the radio in links[{index}].radio (documentation: how-to/links)",
        )  # fmt: skip
    if heard["txbuf"] == 0 and known is not None:
        return warned(
            name, f"{who}: its buffer is full (txbuf 0), so the node sends at its lowest rate",
            f"lower links[{index}].airtime, or reduce the other traffic on this radio",
        )  # fmt: skip
    return passed(name, f"{who}, {heard['txbuf']} % of its buffer is free")


def _carries(config: RunConfig, index: int) -> Finding | None:
    """What a radio carries whose link works it out from its settings."""
    section, name = config.links[index], f"links[{index}] radio"
    budget = section.budget
    if budget is None:
        return None
    for remark in section.remarks(f"links[{index}]"):
        return warned(name, remark.text, remark.remedy)
    return passed(name, f"{budget.bytes_s:.0f} bytes/s on the air, {budget.bytes_s * budget.duty:.1f} for the swarm")


def _dronebridge(config: RunConfig, index: int, evidence: Evidence) -> Finding:
    name = f"links[{index}] radio"
    wanted = _GROUND if config.is_base else _AIR
    heard = (evidence.link(index) or {}).get("radio_status")
    answers = evidence.ear.radios.get(index) if evidence.ear is not None else None
    mode = None if answers is None else answers.mode
    if mode is None and heard is not None:
        # Only a ground unit lets RADIO_STATUS through to its port: an air unit drops what another air unit sends.
        mode = _GROUND
    remedy = f"set {MODE} {wanted} on its web page or with a ground station, then restart it"
    if mode is not None and mode != wanted:
        return failed(
            name, f"DroneBridge is in mode {mode} ({_MODES.get(mode, 'unknown')}), and a"
            f" {'base' if config.is_base else 'drone'} needs {wanted} ({_MODES[wanted]})", remedy,
        )  # fmt: skip
    if answers is None and mode is None:
        return skipped(name, "stop the node to check it" if evidence.running else "not possible with keys")
    if answers is not None and answers.version is None and mode is None:
        return warned(
            name, "DroneBridge does not answer",
            "check SERIAL_TEL_PROTO (4: MAVLink) and SERIAL_BAUD; firmware older than 2.0 does not answer",
        )  # fmt: skip
    if answers is not None and answers.version is not None and answers.version < _OLDEST:
        said = ".".join(map(str, answers.version)) if any(answers.version) else "2.0 or 2.1"
        oldest = ".".join(map(str, _OLDEST))
        return warned(
            name, f"DroneBridge runs firmware {said}", f"update it to {oldest} or newer (documentation: how-to/links)"
        )
    version = "" if answers is None or answers.version is None else f" {'.'.join(map(str, answers.version))}"
    listens = "hears the drones" if config.is_base else "hears the base but no other drone"
    return passed(
        name, f"DroneBridge{version} in mode {wanted} ({_MODES[wanted]}), which {listens}; its txbuf is always 0, so"
        " airtime alone limits the rate",
    )  # fmt: skip


def streams(config: RunConfig, evidence: Evidence) -> Finding | None:
    """Does the radio behind the autopilot carry its telemetry beside the swarm? None: there is none, or nothing is
    known."""
    name = "stream rates"
    through = next((index for index, link in enumerate(config.links) if link.kind.through), None)
    firmware = evidence.firmware
    if through is None or not vehicle.is_heard(evidence) or firmware is None or vehicle.refuses(evidence):
        return None
    if evidence.parameters is None:
        return skipped(name, "stop the node to check them" if evidence.running else "no answer")
    load = stream_load(firmware, evidence.parameters)
    budget = config.links[through].budget
    if load is None or budget is None:
        return None
    vehicles = 1 + sum(not neighbour["base"] for neighbour in evidence.last["neighbours"])
    total, room = vehicles * load.bytes_s, budget.bytes_s * (1.0 - budget.duty)
    each = f"{load.bytes_s:.0f} bytes/s by {load.names}"
    text = each if vehicles == 1 else f"{vehicles} vehicles with {each}, together {total:.0f}"
    text += f"; the radio has {room:.0f} beside the swarm's {budget.bytes_s * budget.duty:.0f}"
    if total > room:
        return warned(name, text, f"lower {load.largest} or links[{through}].airtime.duty, or use a faster radio")
    return passed(name, f"{text}; a ground station may request more")

"""What doctor says of the radio behind a serial port, and of the telemetry behind the autopilot's."""

from __future__ import annotations

import os
import select
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rass_mav.app.config import RunConfig, load_config
from rass_mav.doctor.finding import Finding
from rass_mav.doctor.radio import RadioQuestions, radio, streams
from rass_mav.doctor.watch import Ear, Evidence, RadioAnswers
from rass_mav.mavlink.frames import Frame, FrameReader, FrameWriter
from tests.app.app_nodes import RunningNode
from tests.ptys import SerialDevice
from tests.some import some

from .dronebridge import ACCESS_POINT, AIR, GROUND, DroneBridge
from .test_doctor_command import Capture, examined
from .test_verdicts import AUTOPILOT, NEIGHBOUR

# -- the talk ----------------------------------------------------------------------------------------------------------


class Talk:
    """Questions, and DroneBridges that hear them."""

    def __init__(self, *radios: DroneBridge) -> None:
        self._radios = radios
        self._reader = FrameReader()
        self.is_open = True
        self.asked = 0
        self.questions = RadioQuestions(self._send, FrameWriter(9, 191).frame, lambda: self.is_open)

    def _send(self, frame: bytes) -> None:
        self.asked += 1
        self.heard: list[Frame] = []
        for bridge in self._radios:
            self.heard += self._reader.feed(bridge.hear(frame))
        for answer in self.heard:
            self.questions.hear(answer)


def test_the_own_radio_is_asked_for_mode_and_version_until_it_answers() -> None:
    talk = Talk(DroneBridge(AIR), DroneBridge(GROUND, (2, 0, 0), system_id=3))
    talk.is_open = False
    talk.questions.step(0.0)
    assert (talk.asked, talk.questions.busy) == (0, True)
    talk.is_open = True
    talk.questions.step(0.1)
    # The other one's answers come over the air, later.
    assert talk.questions.answers == RadioAnswers(4, (2, 3, 0))
    talk.questions.step(9.0)
    assert (talk.asked, talk.questions.busy) == (2, False)
    old = Talk(DroneBridge(AIR, (2, 1, 0)))
    old.questions.step(0.0)
    assert old.questions.answers == RadioAnswers(4, (0, 0, 0)), "it does not say which in full"


def test_a_silent_radio_is_left_alone_after_three_times() -> None:
    talk = Talk()
    for now in range(20):
        talk.questions.step(now / 2)
    assert (talk.asked, talk.questions.busy, talk.questions.answers) == (6, False, RadioAnswers())


def test_nobody_else_answers_for_it() -> None:
    talk = Talk()
    strangers = FrameReader().feed(
        DroneBridge(GROUND).hear(FrameWriter(9, 191).frame(20, b"\xff\xff\0\0SYS_ESP32_MODE"))
    )
    assert strangers
    for frame in strangers:
        talk.questions.hear(frame._replace(component_id=1))
        talk.questions.hear(frame._replace(payload=b"\xff" * 25))
    assert talk.questions.answers == RadioAnswers()


# -- verdicts ----------------------------------------------------------------------------------------------------------


def configured(folder: Path, link: str, *, role: str = "drone", more: str = "") -> RunConfig:
    path = folder / "n7.yaml"
    path.write_text(f"node: {{id: 7, role: {role}}}\nlinks: [{link}]\n{more}")
    return load_config(path)


def seen(radio_status: Any = None, answers: RadioAnswers | None = None, *, running: bool = False) -> Evidence:
    state = {"name": "serial", "trouble": None, "radio_status": radio_status}
    ear = None if running else Ear(radios={} if answers is None else {0: answers})
    return Evidence(running, [{"links": [state]}], opened=[0], ear=ear)


def status(system_id: int, txbuf: int) -> dict[str, int]:
    return {"system_id": system_id, "component_id": 68, "txbuf": txbuf}


def said(found: Finding | None) -> tuple[str, str]:
    found = some(found)
    assert bool(found.remedy) == (found.level not in ("pass", "skip"))
    return found.level, f"{found.text}; {found.remedy}"


SERIAL = "{type: serial, device: '/dev/ttyUSB0,57600', radio: %s}"


@pytest.mark.parametrize(
    ("role", "answers", "level", "text"),
    [
        ("drone", RadioAnswers(4, (2, 3, 0)), "pass", "mode 4 (ESP-NOW, air), which hears the base but no other"),
        ("base", RadioAnswers(5, (2, 3, 0)), "pass", "mode 5 (ESP-NOW, ground), which hears the drones"),
        ("drone", RadioAnswers(5, (2, 3, 0)), "fail", "is in mode 5 (ESP-NOW, ground), and a drone needs 4"),
        ("base", RadioAnswers(4, (2, 3, 0)), "fail", "set SYS_ESP32_MODE 5"),
        ("drone", RadioAnswers(1, (2, 3, 0)), "fail", "is in mode 1 (Wi-Fi access point)"),
        ("drone", RadioAnswers(4, (0, 0, 0)), "warn", "runs firmware 2.0 or 2.1; update it to 2.2.0 or newer"),
        ("drone", RadioAnswers(4, None), "pass", "its txbuf is always 0, so airtime alone limits the rate"),
        ("drone", RadioAnswers(), "warn", "does not answer; check SERIAL_TEL_PROTO (4: MAVLink)"),
    ],
)  # fmt: skip
def test_a_dronebridge_that_was_asked(role: str, answers: RadioAnswers, level: str, text: str, tmp_path: Path) -> None:
    config = configured(tmp_path, SERIAL % "dronebridge", role=role)
    found = said(radio(config, 0, seen(answers=answers)))
    assert (found[0], text in found[1]) == (level, True), found


def test_a_dronebridge_that_cannot_be_asked_shows_its_mode_by_what_it_lets_through(tmp_path: Path) -> None:
    drone = configured(tmp_path, SERIAL % "dronebridge")
    assert said(radio(drone, 0, seen(running=True)))[0] == "skip"
    found = said(radio(drone, 0, seen(status(3, 0), running=True)))
    assert (found[0], "mode 5 (ESP-NOW, ground), and a drone needs 4" in found[1]) == ("fail", True)
    base = configured(tmp_path, SERIAL % "dronebridge", role="base")
    assert said(radio(base, 0, seen(status(3, 0), running=True)))[0] == "pass"


@pytest.mark.parametrize(
    ("name", "heard", "level", "text"),
    [
        ("null", status(51, 80), "pass", "80 % of its buffer is free"),
        ("null", status(1, 0), "warn", "with txbuf 0, as from a DroneBridge for ESP32; it is ignored; name the radio"),
        ("null", status(255, 90), "warn", "system 255, component 68, with txbuf 90; it is ignored"),
        ("sik", status(1, 0), "warn", "as from a DroneBridge"),
        ("sik", status(51, 0), "warn", "its buffer is full (txbuf 0)"),
        ("mlrs", status(53, 50), "pass", "50 % of its buffer is free"),
    ],
)
def test_a_radio_that_reports(name: str, heard: dict[str, int], level: str, text: str, tmp_path: Path) -> None:
    found = said(radio(configured(tmp_path, SERIAL % name), 0, seen(heard)))
    assert (found[0], text in found[1]) == (level, True), found


@pytest.mark.parametrize(
    "link",
    ["{broadcast: '10.0.0.255:1'}", SERIAL % "sik"],
)
def test_of_a_radio_that_reports_nothing_nothing_is_said(link: str, tmp_path: Path) -> None:
    assert radio(configured(tmp_path, link), 0, seen()) is None


@pytest.mark.parametrize(
    ("frequency", "level", "text"),
    [
        (869.525, "pass", "580 bytes/s on the air, 58.0 for the swarm"),
        (868.85, "warn", "0.6 bytes/s for the whole swarm"),
    ],
)
def test_how_much_a_lora_modem_carries(frequency: float, level: str, text: str, tmp_path: Path) -> None:
    rnode = f"{{frequency_mhz: {frequency}, region: eu868}}"
    config = configured(tmp_path, f"{{type: rnode, device: '/dev/ttyUSB0,115200', rnode: {rnode}}}")
    found = said(radio(config, 0, seen()))
    assert (found[0], text in found[1]) == (level, True), found


# -- the autopilot's telemetry -----------------------------------------------------------------------------------------

BEHIND = "autopilot: {url: 'udpin:127.0.0.1:14555'}\nmavlink: {autopilot_id: 3}\n"


def flying(parameters: dict[str, float] | None, drones: int = 0, **autopilot: Any) -> Evidence:
    around = [{**NEIGHBOUR, "node_id": 1, "base": True}, *({**NEIGHBOUR, "node_id": 10 + n} for n in range(drones))]
    sample = {"autopilot": {**AUTOPILOT, **autopilot}, "vehicle": {}, "neighbours": around}
    return Evidence(False, [sample], ear=Ear(parameters=parameters))


@pytest.mark.parametrize(
    ("autopilot", "parameters", "drones", "level", "text"),
    [
        # Heartbeat 21, attitude and the like 4 times a second.
        ({}, {"SR1_EXTRA1": 4, "SR1_POSITION": 2}, 0, "pass", "485 bytes/s by SR1_*; the radio has 4032 beside"),
        ({}, {"SR1_EXTRA1": 4, "SR1_POSITION": 2}, 9, "warn", "10 vehicles with 485 bytes/s by SR1_*, together 4850"),
        ({}, {"SR1_EXT_STAT": 10, "SR1_EXTRA1": 20}, 0, "warn", "lower SR1_EXT_STAT 10"),
        ({}, {"SR1_EXTRA1": 0}, 0, "pass", "21 bytes/s by SR1_*"),
        ({"version": [4, 7, 0]}, {"MAV2_RAW_SENS": 50}, 0, "warn", "8471 bytes/s by MAV2_*"),
        ({"type": 12, "version": [1, 15, 0]}, {"MAV_0_RATE": 1200}, 1, "pass", "1200 bytes/s by MAV_0_RATE"),
        ({"type": 12, "version": [1, 15, 0]}, {"MAV_0_RATE": 0, "SER_TEL1_BAUD": 57600}, 1, "warn", "together 5760"),
    ],
)
def test_the_telemetry_of_all_against_the_radio(
    autopilot: dict[str, Any], parameters: dict[str, float], drones: int, level: str, text: str, tmp_path: Path
) -> None:
    config = configured(tmp_path, "{type: autopilot, radio: sik}", more=BEHIND)
    found = said(streams(config, flying(parameters, drones, **autopilot)))
    assert (found[0], text in found[1]) == (level, True), found


def test_where_the_telemetry_is_nobodys_business(tmp_path: Path) -> None:
    own = configured(tmp_path, SERIAL % "sik", more=BEHIND)
    assert streams(own, flying({"SR1_EXTRA1": 50})) is None
    behind = configured(tmp_path, "{type: autopilot}", more=BEHIND)
    assert streams(behind, flying({})) is None
    assert said(streams(behind, replace(flying(None), running=True))) == (
        "skip", "not checked: stop the node to check them; ",
    )  # fmt: skip
    assert streams(behind, flying({"SR1_EXTRA1": 50}, heartbeat_age_s=60.0)) is None


# -- the command -------------------------------------------------------------------------------------------------------


@contextmanager
def answering(device: SerialDevice, bridge: DroneBridge) -> Iterator[None]:
    stop = threading.Event()

    def talk() -> None:
        while not stop.is_set():
            ready, _, _ = select.select([device.far], [], [], 0.05)
            try:
                if ready and (answer := bridge.hear(os.read(device.far, 4096))):
                    os.write(device.far, answer)
            except OSError:
                continue  # nobody has the port open

    thread = threading.Thread(target=talk)
    thread.start()
    yield
    stop.set()
    thread.join()


def test_doctor_asks_the_dronebridge_at_the_port(tmp_path: Path, capsys: Capture, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    device = SerialDevice(tmp_path / "ttyUSB0").plug()
    node = RunningNode(
        tmp_path, 7, node={"role": "base"},
        links=[{"type": "serial", "device": f"{device.path},115200", "radio": "dronebridge"}],
    )  # fmt: skip
    try:
        with answering(device, DroneBridge(ACCESS_POINT)):
            found = examined(Path(node.config), capsys, 1)
    finally:
        device.unplug()
    assert "mode 1 (Wi-Fi access point), and a base needs 5 (ESP-NOW, ground)" in found["links[0] radio"]["text"]
    assert found["links[0]"]["level"] == "pass"

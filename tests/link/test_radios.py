"""What a link takes from the table of known radios."""

from __future__ import annotations

import random

import pytest

from rass_mav.config.loading import convert
from rass_mav.errors import ConfigError
from rass_mav.link.airtime import Pacer
from rass_mav.link.budget import FRAME_BYTES
from rass_mav.link.radios import RADIOS
from rass_mav.link.settings import LinkSection
from tests.some import some

UDP = {"type": "udp", "broadcast": "10.0.0.255:14600"}


def link(**keys: object) -> LinkSection:
    section = convert(keys, LinkSection, "link")
    section.check("link")
    return section


@pytest.mark.parametrize(
    ("radio", "device", "bytes_s"),
    [
        (None, "/dev/ttyUSB0,115200", 5760.0),
        ("sik", "/dev/ttyUSB0,57600", 5760.0),
        ("sik", "/dev/ttyUSB0,115200", 5760.0),
        ("sik", "/dev/ttyUSB0,19200", 1920.0),
        ("mlrs", "/dev/ttyUSB0,57600", 2000.0),
        ("dronebridge", "/dev/ttyUSB0,115200", 11520.0),
        ("dronebridge", "/dev/ttyUSB0,921600", 25000.0),
    ],
)
def test_a_radio_carries_what_its_air_does_or_its_port_if_that_is_slower(
    radio: str | None, device: str, bytes_s: float
) -> None:
    budget = some(link(type="serial", device=device, radio=radio).budget)
    assert (budget.bytes_s, budget.duty, budget.burst_frames) == (bytes_s, 0.3, 2)
    assert budget.listen_s == pytest.approx(4 * FRAME_BYTES / bytes_s)


def test_the_configuration_goes_before_the_table() -> None:
    airtime = {"duty": 0.1, "burst_frames": 5}
    budget = some(link(type="serial", device="/dev/ttyUSB0,57600", radio="mlrs", airtime=airtime).budget)
    assert (budget.bytes_s, budget.duty, budget.burst_frames) == (2000.0, 0.1, 5)
    own = some(link(type="serial", device="/dev/ttyUSB0,57600", radio="mlrs", airtime={"bytes_s": 900}).budget)
    assert own.bytes_s == 900.0


def test_halow_is_the_one_network_that_is_paced() -> None:
    assert link(**UDP).budget is None
    budget = some(link(**UDP, radio="halow").budget)
    assert (budget.bytes_s, budget.listen_s) == (37500.0, 0.0)


def test_a_known_radio_is_one_hop_even_through_the_autopilot() -> None:
    assert not link(type="autopilot").direct
    assert link(type="autopilot", radio="sik").direct
    assert not link(type="autopilot", radio="sik", one_hop=False).direct


@pytest.mark.parametrize("name", sorted(RADIOS))
def test_each_radio_leaves_a_swarm_of_20_a_turn_that_a_drone_can_use(name: str) -> None:
    usual = RADIOS[name].usual
    pacer = Pacer(usual, random.Random(1), now=0.0, step_s=1.0)
    pacer.meet(range(19))
    assert pacer.pace().turn_s <= 35.0


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({**UDP, "radio": "sik"}, r"link\.radio: sik needs type autopilot or serial, this link is udp"),
        (
            {"type": "serial", "device": "/dev/ttyUSB0,57600", "radio": "halow"},
            r"link\.radio: halow needs type udp, this link is serial",
        ),
        (
            {"type": "serial", "device": "/dev/ttyUSB0,57600", "radio": "xbee"},
            r"link: radio: expected one of dronebridge, elrs, halow, mlrs, rfd900, sik, got 'xbee'",
        ),
    ],
)
def test_a_radio_that_does_not_fit(keys: dict[str, object], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        link(**keys)

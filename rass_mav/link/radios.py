"""Radios that people have, one row each: what a radio reports, and what it carries.

All of it was read in the radios' published sources and documents, which the rows name. docs/how-to/links.md says the
same for
people. None of these radios was at hand.
"""

from __future__ import annotations

from typing import NamedTuple

from .budget import USUAL, Budget

#: MAV_COMP_ID_TELEMETRY_RADIO: the component under which radios send RADIO_STATUS.
RADIO_COMPONENT = 68


class Radio(NamedTuple):
    """What is known of a kind of radio."""

    usual: Budget
    """What `airtime` is where the configuration leaves it open. A serial port that is slower bounds it."""
    over_ip: bool = False
    """It carries IP, for links of type udp; False: MAVLink on a serial port."""
    system_id: int | None = None
    """The system id of its RADIO_STATUS, component 68; None: any, or none comes."""
    measures: bool = False
    """Whether `txbuf` in its RADIO_STATUS shows how much of its buffer is free. False: the rate is `airtime` alone."""
    status_hz: float = 1.0
    """The most RADIO_STATUS in a second."""


def _usual(bytes_s: float) -> Budget:
    return USUAL._replace(bytes_s=bytes_s)


RADIOS: dict[str, Radio] = {
    # ArduPilot/SiK, Firmware/radio/mavlink.c: 51 and 68 ('3', 'D'); parameters.c: 64 kbit/s on the air by default.
    "sik": Radio(_usual(5760.0), system_id=51, measures=True),
    # RFDesign's firmware for the RFD900x is closed; it is set up as SiK, and reports under the same ids.
    "rfd900": Radio(_usual(5760.0), system_id=51, measures=True),
    # olliw42/mLRS, CommonRx/mavlink_interface_rx.h: system 51 plus a parameter, up to ten a second while its buffer
    # fills; README.md: 2,000 bytes/s up and 2,562 down at 31 Hz. One transmitter, one receiver.
    "mlrs": Radio(_usual(2000.0), measures=True, status_hz=10.0),
    # ExpressLRS, rx-serial/SerialMavlink.cpp: system id by a setting (255), every 10 ms, txbuf of a buffer of 1,024
    # bytes; telemetry_protocol.h: 5 bytes a packet, and every second one of 200/s carries telemetry. One pair.
    "elrs": Radio(_usual(500.0), measures=True, status_hz=100.0),
    # DroneBridge/ESP32 v2.3.0, main/db_timers.c: RADIO_STATUS goes over the air only, with txbuf 0, under the system
    # id of the autopilot at the sender's serial port (1 without one); db_esp_now.h: 215 bytes; 250 kbit/s with LR.
    "dronebridge": Radio(_usual(25_000.0)),
    # IEEE 802.11-2020, 23.5: MCS 0 on a channel of 1 MHz, 300 kbit/s: broadcasts go out at the lowest rate.
    "halow": Radio(_usual(37_500.0), over_ip=True),
}

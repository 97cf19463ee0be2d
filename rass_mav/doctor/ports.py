"""Serial ports: do they exist, and can this user open them?"""

from __future__ import annotations

import getpass
import grp
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from rass_mav.app.config import RunConfig
from rass_mav.errors import why
from rass_mav.link.address import parse_serial, parse_vehicle_url

from .finding import Finding, failed, passed, warned

#: The mini UART of a Raspberry Pi loses bytes above this, bit/s.
MINI_UART_BAUD = 230_400


class SerialPort(NamedTuple):
    """A serial port of a configuration."""

    key: str
    """Its key in the configuration."""
    device: str
    baud: int


def serial_ports(config: RunConfig) -> Iterator[SerialPort]:
    """All serial ports of a configuration."""
    for key, url in (("autopilot.url", config.autopilot.url), ("ground.url", config.ground.url)):
        if url is not None and (parsed := parse_vehicle_url(url)).mode == "serial":
            yield SerialPort(key, *parsed.address)
    for index, link in enumerate(config.links):
        if link.device is not None:
            yield SerialPort(f"links[{index}].device", *parse_serial(link.device))
    sensor = config.sensor
    if sensor.port is not None and sensor.kind.baud:
        yield SerialPort("sensor.port", sensor.port, sensor.baud or sensor.kind.baud)


def serial_port(port: SerialPort, root: Path = Path("/")) -> Finding:
    """Check a serial port. `root`: the folder with `proc`."""
    name = f"serial port {port.device}"
    path = Path(port.device)
    try:
        about = path.stat()
    except FileNotFoundError:
        return failed(name, f"no such device ({port.key})", _how_to_get(port.device))
    except OSError as error:
        return failed(name, f"{why(error)} ({port.key})", "see documentation: how-to/install")
    if not stat.S_ISCHR(about.st_mode):
        return failed(name, f"not a device ({port.key})", "use a serial device; to list them: ls -l /dev/serial/by-id/")
    real = path.resolve().name
    if (real in _consoles(root)) or path.name in _consoles(root):
        return failed(
            name, "the system console uses it and would write to the device",
            "sudo raspi-config, Interface Options, Serial Port: login shell no, hardware yes; then reboot",
        )  # fmt: skip
    if not os.access(path, os.R_OK | os.W_OK, effective_ids=os.access in os.supports_effective_ids):
        return failed(name, f"user {_user()} cannot open it", _how_to_join(about.st_gid))
    where = "" if real == path.name else f"{real}, "
    if path.name == "serial0" and real.startswith("ttyS") and port.baud > MINI_UART_BAUD:
        return warned(
            name, f"is the mini UART ({real}), which loses bytes at {port.baud} bit/s",
            "add dtoverlay=disable-bt to /boot/firmware/config.txt, then reboot (documentation: how-to/install)",
        )  # fmt: skip
    return passed(name, f"{where}{port.baud} bit/s, can be opened")


def _how_to_get(device: str) -> str:
    if "USB" in device or "ACM" in device or "by-id" in device:
        return "plug it in; to list devices: ls -l /dev/serial/by-id/"
    return "enable the port (sudo raspi-config, Interface Options, Serial Port); Pi 5: documentation, how-to/install"


def _how_to_join(gid: int) -> str:
    try:
        group = grp.getgrgid(gid)
    except KeyError:
        return "assign the device to one of your groups with a udev rule"
    if _user() in group.gr_mem:
        return f"log out and in again: this session is older than your membership of the group {group.gr_name}"
    return f"sudo usermod -aG {group.gr_name} {_user()}, then log out and in again"


def _user() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError):
        return str(os.geteuid())


def _consoles(root: Path) -> set[str]:
    """Names of devices that the kernel uses as consoles, or is configured to use."""
    found: set[str] = set()
    for file, sign in (("consoles", ""), ("cmdline", "console=")):
        try:
            text = (root / "proc" / file).read_text(encoding="ascii", errors="replace")
        except OSError:
            continue
        if sign:
            found |= {word[len(sign) :].split(",")[0] for word in text.split() if word.startswith(sign)}
        else:
            found |= {line.split()[0] for line in text.splitlines() if line.split()}
    return found

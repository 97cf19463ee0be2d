"""Each check of the computer alone, seen passing and failing, with real files, devices and networks."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from typing import Any

import pytest

from rass_mav.app.config import RunConfig, load_config
from rass_mav.config.loading import convert
from rass_mav.core.datum import DatumId, make_datum
from rass_mav.doctor import computer, network, ports, service, storage
from rass_mav.doctor.finding import Finding
from rass_mav.errors import ServiceError
from rass_mav.link import interface
from rass_mav.link.settings import LinkSection, PeerSection
from rass_mav.store.disk import Space
from rass_mav.store.sqlite import SqliteStore
from tests.namespaces import DOWN, JOINED, NOT_JOINED, in_namespace
from tests.ptys import SerialDevice
from tests.users import ordinary_user

NOW = 1_790_000_000.0


def sound(finding: Finding) -> Finding:
    """What holds for all of them: one line, and a remedy where there is something to do."""
    assert "\n" not in finding.line()
    assert finding.line().startswith(f"{finding.level}  {finding.name}: ")
    assert bool(finding.remedy) == (finding.level != "pass")
    return finding


def test_python() -> None:
    assert sound(computer.python(sys.version_info[:3], sys.executable)).level == "pass"
    old = sound(computer.python((3, 9, 2), "/usr/bin/python3"))
    assert (old.level, "3.10 or newer" in old.remedy) == ("fail", True)


def test_packages() -> None:
    here = sound(computer.packages(["pymavlink", "msgspec", "pyyaml", "pyserial"]))
    assert here.level == "pass"
    assert "pyserial" in here.text

    def installed(name: str) -> str:
        if name == "pyserial":
            raise PackageNotFoundError(name)
        return {"pymavlink": "2.4.9"}[name]

    lacking = sound(computer.packages(["pymavlink", "pyserial"], installed, {"pymavlink": "2.4.48"}))
    assert (lacking.level, lacking.text) == (
        "fail",
        "pymavlink is 2.4.9, expected 2.4.48 or newer, pyserial is missing",
    )
    assert "'.[drone]' in the checkout" in lacking.remedy


@pytest.mark.parametrize(
    ("yaml", "serial"),
    [
        ("node: {id: 1, role: base}\n", False),
        ("node: {id: 1, role: base}\nautopilot: {url: '/dev/ttyAMA0,57600'}\n", True),
        ("node: {id: 1, role: base}\nsensor: {type: gmc, port: /dev/ttyUSB0}\n", True),
        ("node: {id: 1}\nlinks: [{type: serial, device: '/dev/ttyUSB0,57600'}]\n", True),
        ("node: {id: 1}\nlinks: [{broadcast: '192.168.4.255:1'}]\n", False),
    ],
)
def test_pyserial_is_needed_where_a_serial_port_is(yaml: str, serial: bool, tmp_path: Path) -> None:
    (tmp_path / "n.yaml").write_text(yaml)
    config = load_config(tmp_path / "n.yaml")
    assert ("pyserial" in computer.needed_packages(config)) is serial
    assert bool(list(ports.serial_ports(config))) is serial


def test_clock(tmp_path: Path) -> None:
    store = tmp_path / "n.db"
    chip = tmp_path / "chip"
    (chip / "sys/class/rtc/rtc0").mkdir(parents=True)
    assert sound(computer.clock(NOW, store, chip)).level == "pass"
    net = tmp_path / "net"
    (net / "run/systemd/timesync").mkdir(parents=True)
    assert sound(computer.clock(NOW, store, net)).level == "warn"
    (net / "run/systemd/timesync/synchronized").touch()
    assert "time server" in sound(computer.clock(NOW, store, net)).text
    assert "impossible" in sound(computer.clock(12.0, store, chip)).text
    store.touch()
    os.utime(store, (NOW, NOW))
    behind = sound(computer.clock(NOW - 3600.0, store, chip))
    assert (behind.level, "was written at" in behind.text) == ("warn", True)
    assert computer.clock(NOW + 1.0, store, chip).level == "pass"


@pytest.fixture
def device(tmp_path: Path) -> Iterator[SerialDevice]:
    device = SerialDevice(tmp_path / "serial0").plug()
    yield device
    device.unplug()


def port(device: SerialDevice, baud: int = 57600) -> ports.SerialPort:
    return ports.SerialPort("autopilot.url", str(device.path), baud)


def test_a_serial_port_that_is_there_and_one_that_is_not(device: SerialDevice, tmp_path: Path) -> None:
    assert sound(ports.serial_port(port(device), tmp_path)).level == "pass"
    gone = sound(ports.serial_port(port(device)._replace(device=f"{tmp_path}/ttyUSB7"), tmp_path))
    assert (gone.level, gone.text) == ("fail", "no such device (autopilot.url)")
    assert "by-id" in gone.remedy
    uart = sound(ports.serial_port(port(device)._replace(device=f"{tmp_path}/ttyAMA9"), tmp_path))
    assert "raspi-config" in uart.remedy
    (tmp_path / "file").touch()
    assert (
        sound(ports.serial_port(port(device)._replace(device=f"{tmp_path}/file"))).text
        == "not a device (autopilot.url)"
    )


@pytest.mark.parametrize("file", ["consoles", "cmdline"])
def test_a_console_on_the_port(file: str, device: SerialDevice, tmp_path: Path) -> None:
    (tmp_path / "proc").mkdir()
    real = device.path.resolve().name
    text = (
        f"tty0 -WU (EC p) 4:7\n{real} -W- (E) 4:64\n" if file == "consoles" else "quiet console=serial0,115200 root=x"
    )
    (tmp_path / "proc" / file).write_text(text)
    taken = sound(ports.serial_port(port(device), tmp_path))
    assert (taken.level, "console" in taken.text) == ("fail", True)
    (tmp_path / "proc" / file).write_text("tty0 console=tty1")
    assert ports.serial_port(port(device), tmp_path).level == "pass"


def test_a_port_of_another_group(device: SerialDevice, tmp_path: Path) -> None:
    device.path.resolve().chmod(0)
    with ordinary_user(tmp_path):
        closed = sound(ports.serial_port(port(device), tmp_path))
    assert closed.level == "fail"
    assert "cannot open it" in closed.text
    assert "sudo usermod -aG" in closed.remedy


def test_the_mini_uart_is_too_slow(tmp_path: Path) -> None:
    shared = Path("/dev/ttyS0")
    if not os.access(shared, os.R_OK | os.W_OK):
        # A device under that name, on a disk of its own: any character device will do.
        shared = tmp_path / "ttyS0"
        shared.symlink_to("/dev/null")
    link = tmp_path / "serial0"
    link.symlink_to(shared)
    found = ports.serial_port(ports.SerialPort("autopilot.url", str(link), 921600), tmp_path)
    if link.resolve().name.startswith("ttyS"):
        assert (found.level, "mini UART" in found.text) == ("warn", True)
    slow = ports.serial_port(ports.SerialPort("autopilot.url", str(link), 57600), tmp_path)
    assert slow.level == "pass"


WLAN = "wlan0 192.168.4.7 with broadcast 192.168.4.255"
DEFAULT = "route add default via 192.168.4.1"
TWO_NETWORKS = (
    DEFAULT, "link add eth0 type veth peer name wall", "link set eth0 up", "link set wall up",
    "addr add 10.0.0.7/24 dev eth0",
)  # fmt: skip


@pytest.mark.parametrize(
    ("link", "setup", "level", "said"),
    [
        ({"broadcast": "192.168.4.255:1"}, JOINED, "pass", "broadcast to 192.168.4.255 on wlan0"),
        ({"broadcast": "192.168.4.255:1"}, NOT_JOINED, "fail", "wlan0 has no carrier"),
        ({"broadcast": "192.168.4.255:1"}, DOWN, "fail", "wlan0 is down"),
        ({"broadcast": "192.168.5.255:1"}, JOINED, "fail", "of no interface (there is lo 127.0.0.1 with broadcast"),
        ({"broadcast": "192.168.5.255:1"}, [*JOINED, DEFAULT], "fail", WLAN),
        ({"broadcast": "192.168.4.255:1"}, [], "fail", "there are none"),
        ({"broadcast": "localhost:1"}, JOINED, "fail", "127.0.0.1 is the broadcast address of no interface"),
        ({"broadcast": "255.255.255.255:1"}, [*JOINED, DEFAULT], "pass", "broadcast to 255.255.255.255 on wlan0"),
        ({"broadcast": "255.255.255.255:1"}, JOINED, "fail", "no interface leads to"),
        ({"broadcast": "255.255.255.255:1"}, [*JOINED, *TWO_NETWORKS], "warn", "on wlan0 only, one of 2 networks"),
        ({"broadcast": "255.255.255.255:1", "interface": "wlan0"}, JOINED, "pass", "on wlan0"),
        ({"broadcast": "255.255.255.255:1", "interface": "192.168.4.7"}, [*JOINED, *TWO_NETWORKS], "pass", "on wlan0"),
        ({"broadcast": "255.255.255.255:1", "interface": "wlan0"}, NOT_JOINED, "fail", "wlan0 has no carrier"),
        ({"broadcast": "255.255.255.255:1", "interface": "wlan0"}, DOWN, "fail", "wlan0 is down"),
        ({"broadcast": "255.255.255.255:1", "interface": "wlan1"}, JOINED, "fail", "there is no interface wlan1"),
        ({"broadcast": "255.255.255.255:1", "interface": "air"}, JOINED, "fail", "air has no IPv4 address yet"),
        ({"multicast": "239.255.82.83:1", "interface": "127.0.0.1"}, JOINED, "pass", "group 239.255.82.83:1 on lo"),
        ({"multicast": "239.255.82.83:1", "interface": "wlan0"}, JOINED, "pass", "group 239.255.82.83:1 on wlan0"),
        ({"multicast": "239.255.82.83:1", "interface": "wlan0"}, DOWN, "fail", "wlan0 is down"),
        ({"multicast": "239.255.82.83:1"}, JOINED, "fail", "no interface leads to"),
        ({"multicast": "239.255.82.83:1"}, [*JOINED, DEFAULT], "pass", "on wlan0"),
        ({"multicast": "239.255.82.83:1", "interface": "203.0.113.9"}, JOINED, "fail", "203.0.113.9 is not an address"),
        ({"broadcast": "192.168.4.255:1", "listen": "203.0.113.9:1"}, JOINED, "fail", "203.0.113.9 is not an address"),
        ({"peers": ["127.0.0.1:1"]}, JOINED, "pass", "1 peers on lo"),
        ({"peers": ["192.168.4.9:1", "192.168.4.8:1"]}, DOWN, "fail", "wlan0 is down"),
        ({"peers": ["127.0.0.1:1", "192.168.4.8:1"]}, DOWN, "warn", "wlan0 is down"),
        ({"peers": ["no-such-host.invalid:1"]}, JOINED, "fail", "unknown host name"),
    ],
)  # fmt: skip
def test_addresses_of_links(link: dict[str, Any], setup: list[str], level: str, said: str) -> None:
    peers = tuple(PeerSection(address=address) for address in link.pop("peers", ()))
    section = LinkSection(**link, peers=peers)
    found = sound(in_namespace(setup, lambda: network.link_address(0, section)))
    assert (found.level, said in found.text) == (level, True), found


def test_what_to_do_about_an_interface_that_carries_nothing() -> None:
    section = LinkSection(broadcast="192.168.4.255:1")
    down = in_namespace(DOWN, lambda: network.link_address(0, section))
    assert down.remedy == "sudo ip link set wlan0 up"
    # A veth is a cable; a Wi-Fi interface is told to join.
    assert "cable" in in_namespace(NOT_JOINED, lambda: network.link_address(0, section)).remedy


@pytest.mark.parametrize(
    ("link", "level", "said"),
    [
        ({"broadcast": "192.168.4.255:1"}, "pass", "unicast over wlan0 (driver ath9k_htc), which acknowledges"),
        ({"broadcast": "255.255.255.255:1", "interface": "wlan0"}, "pass", "unicast over wlan0"),
        ({"broadcast": "192.168.4.255:1", "data": "broadcast"}, "pass", "broadcast over wlan0 (driver ath9k_htc)"),
        ({"multicast": "239.1.1.1:1", "interface": "wlan0", "data": "broadcast"}, "pass", "at its mcast-rate"),
        ({"peers": ["192.168.4.2:1", "192.168.4.3:1"], "data": "broadcast"}, "warn", "sends each frame 2 times"),
        ({"peers": ["192.168.4.2:1", "192.168.4.3:1"]}, "pass", "do not overhear them"),
    ],
)  # fmt: skip
def test_how_data_leave_over_wifi(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, link: dict[str, Any], level: str, said: str
) -> None:
    (tmp_path / "drivers" / "ath9k_htc").mkdir(parents=True)
    (tmp_path / "wlan0" / "device").mkdir(parents=True)
    (tmp_path / "wlan0" / "device" / "driver").symlink_to(tmp_path / "drivers" / "ath9k_htc")
    (tmp_path / "wlan0" / "phy80211").mkdir()
    monkeypatch.setattr(interface, "NETWORKS", tmp_path)
    peers = tuple(PeerSection(address=address) for address in link.pop("peers", ()))
    section = LinkSection(**link, peers=peers)
    found = in_namespace(JOINED, lambda: network.sending(0, section))
    assert found is not None
    assert (found.level, said in found.text) == (level, True), found


def test_of_a_cable_there_is_nothing_to_say() -> None:
    section = LinkSection(broadcast="192.168.4.255:1", data="broadcast")
    assert in_namespace(JOINED, lambda: network.sending(0, section)) is None


def test_a_name_service_that_hangs_does_not_hold_us_up() -> None:
    began = time.monotonic()
    assert not network.is_known("another-host.invalid")
    assert time.monotonic() - began < 2 * network.LOOKUP_S


def build(raw: dict[str, Any]) -> RunConfig:
    return convert(raw, RunConfig, "test")


def drone(path: Path, **sections: Any) -> RunConfig:
    """A drone whose store is at `path`."""
    store = {**sections.pop("store", {}), "path": str(path)}
    node = {**sections.pop("node", {}), "id": 7}
    return build({"node": node, "store": store, "links": [{"type": "udp", "listen": "127.0.0.1:0"}], **sections})


def said(config: RunConfig) -> str:
    return sound(storage.store(config)).text


def test_a_store(tmp_path: Path) -> None:
    path = tmp_path / "n.db"
    fresh = sound(storage.store(drone(path)))
    assert (fresh.level, "not created yet" in fresh.text) == ("pass", True)
    assert sound(storage.store(drone(tmp_path / "nowhere/n.db"))).level == "fail"
    store = SqliteStore.open(path, node_id=7, draw_epoch=lambda: 1)
    # A node may be using it.
    assert "0 data" in sound(storage.store(drone(path))).text
    store.close()
    assert sound(storage.store(drone(path), Space(free=60_000_000, reserve=64_000_000))).level == "fail"
    assert sound(storage.store(drone(path), Space(free=100_000_000, reserve=64_000_000))).level == "warn"
    path.with_name("n.db.damaged-1").touch()
    aside = sound(storage.store(drone(path)))
    assert (aside.level, "n.db.damaged-1" in aside.text) == ("warn", True)
    path.write_bytes(b"no database, for sure" * 100)
    damaged = sound(storage.store(drone(path)))
    assert (damaged.level, "set it aside" in damaged.remedy) == ("warn", True)
    path.chmod(0o400)
    with ordinary_user(tmp_path):
        assert "no write permission" in sound(storage.store(drone(path))).text


def test_it_says_how_long_the_store_lasts_without_contact(tmp_path: Path) -> None:
    path = tmp_path / "n.db"
    assert "lasts 5.4 days without contact (a measurement every 10 s, a status every 60 s)" in said(drone(path))
    assert "lasts 15 hours" in said(drone(path, node={"step_s": 0.1}))
    small = sound(storage.store(drone(path, store={"capacity_items": 50})))
    assert (small.level, "lasts 7.1 minutes" in small.text) == ("warn", True)
    assert "store.capacity_items" in small.remedy
    # 1 MiB of quota: 119 bytes a measurement, 193 a status.
    assert "lasts 19 hours" in said(drone(path, store={"quota_bytes": 1 << 20}))
    assert "never fills up" in said(drone(path, data={"lifetime_s": 3600}))
    assert "creates no data" in said(drone(path, data={"interval_steps": 0, "status_s": 0}))
    assert "without contact" not in said(build({"node": {"id": 7, "role": "base"}, "store": {"path": str(path)}}))
    with SqliteStore.open(path, node_id=7, draw_epoch=lambda: 1) as store:
        for number in range(25):
            store.put(make_datum(DatumId(7, 1, number), 0, 0.0, b"reading"))
    assert "25 data" in said(drone(path, store={"capacity_items": 50}))
    assert "lasts 3.6 minutes" in said(drone(path, store={"capacity_items": 50}))


def test_the_services_configuration_has_its_store_in_the_services_folder(tmp_path: Path) -> None:
    file = tmp_path / "etc/second/node.yaml"
    file.parent.mkdir(parents=True)
    file.write_text("node: {id: 7, role: base}\n")
    assert load_config(file, root=tmp_path).store_path == file.parent / "rass-7.db"
    home = tmp_path / "var/lib/second"
    home.mkdir(parents=True)
    found = load_config(file, root=tmp_path)
    assert (found.store_path, found.socket_path) == (home / "rass-7.db", home / "rass-7.sock")


def test_which_service_reads_a_configuration() -> None:
    assert service.name_of("/etc/second/node.yaml") == "second"
    assert service.name_of("drone.yaml") == service.name_of("/etc/second/other.yaml") == "rass-mav"


@pytest.mark.parametrize(
    ("known", "level", "said"),
    [
        ({"ActiveState": "active", "UnitFileState": "enabled", "NRestarts": "0"}, "pass", "starts at boot"),
        ({"ActiveState": "active", "UnitFileState": "enabled", "NRestarts": "3"}, "warn", "restarted 3 times"),
        ({"ActiveState": "active", "UnitFileState": "disabled"}, "warn", "does not start at boot"),
        ({"ActiveState": "failed", "UnitFileState": "enabled"}, "fail", "is failed"),
    ],
)
def test_a_service_that_is_installed(known: dict[str, str], level: str, said: str, tmp_path: Path) -> None:
    assert (
        sound(service.service("rass-mav", lambda name, timeout_s: known, tmp_path)).text == "rass-mav is not installed"
    )
    unit = tmp_path / "etc/systemd/system/rass-mav.service"
    unit.parent.mkdir(parents=True)
    unit.touch()
    found = sound(service.service("rass-mav", lambda name, timeout_s: known, tmp_path))
    assert (found.level, said in found.text) == (level, True)

    def silent(name: str, timeout_s: float) -> dict[str, str]:
        raise ServiceError("systemctl: no answer in 2 s")

    assert sound(service.service("rass-mav", silent, tmp_path)).level == "warn"

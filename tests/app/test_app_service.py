"""`rass-mav service`: what it writes below another root, what it would do, and what it refuses."""

from __future__ import annotations

import configparser
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

import rass_mav
from rass_mav.app.config import load_config
from rass_mav.app.service import check_reachable, plan_install, plan_remove, run
from rass_mav.cli import main
from rass_mav.errors import ConfigError, ServiceError
from rass_mav.trust.keys.folder import create, issue

CONFIG = "node: {id: 7}\nlinks: [{broadcast: '192.168.4.255:14600'}]\n"
UNIT = "etc/systemd/system/rass-mav.service"
LINK = "etc/systemd/system/multi-user.target.wants/rass-mav.service"
USERS = "etc/sysusers.d/rass-mav.conf"
HERE = sys.executable
PROGRAM = "/opt/rass-mav"


@pytest.fixture(autouse=True)
def program(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """The program is where the documents have it, or moves to another folder; that of the tests may be anywhere."""

    def move(folder: str) -> None:
        monkeypatch.setattr(sys, "executable", f"{folder}/bin/python")
        monkeypatch.setattr(sys, "prefix", folder)
        monkeypatch.setattr(rass_mav, "__file__", f"{folder}/lib/python3.11/site-packages/rass_mav/__init__.py")

    move(PROGRAM)
    return move


@pytest.fixture
def drone(tmp_path: Path) -> str:
    file = tmp_path / "drone.yaml"
    file.write_text(CONFIG)
    return str(file)


@pytest.fixture
def card(tmp_path: Path) -> Path:
    """The root of a system that does not run."""
    root = tmp_path / "card"
    root.mkdir()
    return root


def below(root: Path) -> set[str]:
    return {str(path.relative_to(root)) for path in root.rglob("*") if path.is_symlink() or path.is_file()}


def unit(text: str) -> configparser.ConfigParser:
    parser = configparser.ConfigParser(interpolation=None, strict=False, comment_prefixes=("#",), delimiters=("=",))
    parser.optionxform = str  # type: ignore[assignment, method-assign]
    parser.read_string(text)
    return parser


def test_install_below_another_root(drone: str, card: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["service", "install", drone, "--root", str(card)]) == 0
    assert capsys.readouterr().out.startswith("rass-mav: installed")
    assert below(card) == {UNIT, LINK, USERS, "etc/rass-mav/node.yaml"}
    assert os.readlink(card / LINK) == f"/{UNIT}"
    assert (card / "etc/rass-mav/node.yaml").read_text() == CONFIG
    service = unit((card / UNIT).read_text())["Service"]
    assert service["ExecStart"] == f"{PROGRAM}/bin/python -I -m rass_mav run /etc/rass-mav/node.yaml"
    assert (service["User"], service["Type"], service["Restart"]) == ("rass", "notify", "always")
    assert service["WorkingDirectory"] == "/var/lib/rass-mav"
    assert int(service["WatchdogSec"]) > 0
    # Both would close the serial ports.
    assert not {"ProtectClock", "PrivateDevices"} & set(service)
    lines = (card / USERS).read_text().splitlines()
    assert 'u rass - "rass_mav node" /var/lib/rass-mav' in lines
    assert "m rass dialout" in lines


SERIAL = {f"DeviceAllow=char-{name} rw" for name in ("ttyAMA", "ttyS", "ttyUSB", "ttyACM")}


@pytest.mark.parametrize(
    ("sections", "devices"),
    [
        ("", set()),
        ("autopilot: {url: 'udpin:0.0.0.0:14550'}\nground: {url: 'tcp:10.0.0.1:5760'}\n", set()),
        ("autopilot: {url: 'serial:/dev/serial0:921600'}\n", SERIAL),
        ("ground: {url: '/dev/ttyUSB1,57600'}\n", SERIAL),
        ("sensor: {type: gmc, port: /dev/serial/by-id/usb-1a86-if00-port0}\n", SERIAL),
        ("autopilot: {url: '/dev/ttyTHS1,57600'}\n", SERIAL | {"DeviceAllow=char-ttyTHS rw"}),
        ("autopilot: {url: '/dev/sda1,57600'}\n", SERIAL),
    ],
)
def test_the_service_gets_the_serial_ports_that_it_needs_and_no_other_device(
    tmp_path: Path, card: Path, sections: str, devices: set[str]
) -> None:
    file = tmp_path / "drone.yaml"
    file.write_text(CONFIG + sections)
    assert main(["service", "install", str(file), "--root", str(card)]) == 0
    text = (card / UNIT).read_text()
    assert {line for line in text.splitlines() if line.startswith("DeviceAllow")} == devices
    assert unit(text)["Service"]["DevicePolicy"] == "closed"
    # A kind of port that no module has made known yet could not be allowed.
    modules = "modprobe@usbserial.service modprobe@cdc_acm.service"
    assert (f"Wants={modules}\nAfter={modules}\n" in text) == bool(devices)


def test_a_radio_on_a_serial_port_is_let_in(tmp_path: Path) -> None:
    file = tmp_path / "drone.yaml"
    file.write_text("node: {id: 7}\nlinks: [{type: serial, device: '/dev/rfcomm0,57600'}]\n")
    plan = plan_install(load_config(file), "", name="second", user="pi", groups=(), python="/x", program=("/x",))
    assert "DeviceAllow=char-rfcomm rw\n" in dict(plan.files)["/etc/systemd/system/second.service"]


def test_the_service_is_shut_in(drone: str, card: Path) -> None:
    main(["service", "install", drone, "--root", str(card)])
    service = dict(unit((card / UNIT).read_text())["Service"])
    demanded = {
        "UMask": "0077", "NoNewPrivileges": "yes", "CapabilityBoundingSet": "", "ProtectSystem": "strict",
        "ProtectProc": "invisible", "PrivateTmp": "yes", "MemoryDenyWriteExecute": "yes", "LockPersonality": "yes",
        "SystemCallFilter": "@system-service", "SystemCallArchitectures": "native",
        "RestrictAddressFamilies": "AF_UNIX AF_INET AF_INET6 AF_NETLINK",
    }  # fmt: skip
    assert {key: service[key] for key in demanded} == demanded
    assert int(service["MemoryMax"].removesuffix("M")) <= 256
    assert int(service["TasksMax"]) <= 64
    # The node tells of processors, memory and lost datagrams.
    assert "ProcSubset" not in service


def test_no_placeholder_is_left(drone: str, card: Path) -> None:
    main(["service", "install", drone, "--root", str(card)])
    for file in (UNIT, USERS):
        assert "@" not in (card / file).read_text().replace("@system-service", "").replace("modprobe@", "")


def test_what_runs_at_home_can_read_it_and_a_store_elsewhere_can_be_written(tmp_path: Path) -> None:
    file = tmp_path / "drone.yaml"
    file.write_text(CONFIG + "store: {path: /mnt/fast disk/100%/n7.db}\n")

    def service(python: str, *more: str) -> configparser.SectionProxy:
        plan = plan_install(
            load_config(file), CONFIG, name="second", user="pi", groups=(), python=python, program=(python, *more)
        )
        return unit(dict(plan.files)["/etc/systemd/system/second.service"])["Service"]

    assert service("/opt/rass-mav/bin/python")["ProtectHome"] == "yes"
    assert service("/home/pi/rass/bin/python")["ProtectHome"] == "read-only"
    assert service("/opt/rass-mav/bin/python", "/home/pi/rass_mav/rass_mav")["ProtectHome"] == "read-only"
    assert service("/opt/my env/bin/python")["ExecStart"].startswith(
        '"/opt/my env/bin/python" -I -m rass_mav run /etc/second/'
    )
    # In a unit, % begins a specifier.
    assert service("/opt/x/bin/python")["ReadWritePaths"] == '"/mnt/fast disk/100%%"'
    # A store at home must be visible too, wherever the program is.
    file.write_text(CONFIG + "store: {path: /home/pi/n7.db}\n")
    assert service("/opt/rass-mav/bin/python")["ProtectHome"] == "read-only"
    assert service("/opt/rass-mav/bin/python")["ReadWritePaths"] == "/home/pi"


def test_print_shows_everything_and_does_nothing(drone: str, card: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["service", "install", drone, "--root", str(card), "--print"]) == 0
    assert below(card) == set()
    shown = capsys.readouterr().out
    for path in (UNIT, USERS, LINK, "etc/rass-mav/node.yaml"):
        assert f"== {card / path}" in shown
    assert "WantedBy=multi-user.target" in shown
    # On the running system it needs no root only to show it.
    assert main(["service", "install", drone, "--print", "--user", "pi", "--group", "uucp", "--group", "video"]) == 0
    shown = capsys.readouterr().out
    assert "m pi uucp\nm pi video\n" in shown
    assert shown.splitlines()[-4:] == [
        "$ systemd-sysusers rass-mav.conf",
        "$ systemctl daemon-reload",
        "$ systemctl enable rass-mav.service",
        "$ systemctl restart rass-mav.service",
    ]
    assert main(["service", "remove", "--print"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "$ systemctl disable --now rass-mav.service",
        f"$ rm -f /{LINK}",
        f"$ rm -f /{UNIT}",
        f"$ rm -f /{USERS}",
        "$ systemctl daemon-reload",
    ]


def test_install_again_and_remove(drone: str, card: Path, capsys: pytest.CaptureFixture[str]) -> None:
    here = ["--root", str(card)]
    assert main(["service", "status", *here]) == 1
    assert capsys.readouterr().out == "rass-mav: not installed\n"
    assert main(["service", "remove", *here]) == 1
    assert "nothing to remove" in capsys.readouterr().err
    main(["service", "install", drone, *here])
    before = below(card)
    assert main(["service", "install", drone, *here]) == 0
    assert below(card) == before
    capsys.readouterr()
    assert main(["service", "status", *here, "--json"]) == 0
    about = json.loads(capsys.readouterr().out)
    assert about == {"name": "rass-mav", "installed": True, "enabled": True, "unit": str(card / UNIT)}
    assert main(["service", "remove", *here]) == 0
    assert below(card) == {"etc/rass-mav/node.yaml"}


def test_a_configuration_edited_in_place_is_not_lost(
    drone: str, card: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    here = ["--root", str(card)]
    main(["service", "install", drone, *here])
    installed = card / "etc/rass-mav/node.yaml"
    installed.write_text(CONFIG + "# by hand\n")
    (card / UNIT).unlink()
    assert main(["service", "install", drone, *here]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line == f"{installed}: already exists with different contents: edit it, or use --replace"
    # Refused as a whole.
    assert not (card / UNIT).exists()
    assert main(["service", "install", str(installed), *here]) == 0
    assert installed.read_text().endswith("# by hand\n")
    assert main(["service", "install", drone, "--replace", *here]) == 0
    assert installed.read_text() == CONFIG


def test_a_wrong_configuration_is_not_installed(tmp_path: Path, card: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "bad.yaml"
    file.write_text("node: {id: 7}\npolicy: {alpha: ten}\nlinks: [{broadcast: '192.168.4.255:1'}]\n")
    assert main(["service", "install", str(file), "--root", str(card)]) == 2
    assert "policy.alpha" in capsys.readouterr().err
    assert below(card) == set()


@pytest.mark.parametrize("action", [["install", "drone.yaml"], ["remove"]], ids=lambda words: words[0])
def test_without_root_it_is_refused_in_one_line(
    action: list[str], drone: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(Path(drone).parent)
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    assert main(["service", *action]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "requires root (sudo)" in line


@pytest.mark.parametrize(
    "wrong", ["--name=Rass", "--name=../etc", "--user=a b", "--group=x;y", "--user=", "--root=gone"]
)
def test_names_that_are_none(wrong: str, drone: str, card: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = [] if wrong.startswith("--root") else ["--root", str(card)]
    assert main(["service", "install", drone, wrong, *root]) == 2
    assert wrong.split("=")[0] in capsys.readouterr().err
    assert below(card) == set()


def test_a_program_in_a_closed_home_is_refused() -> None:
    # pytest's own folders are closed to others.
    with tempfile.TemporaryDirectory() as name:
        Path(name).chmod(0o755)
        home = Path(name) / "home"
        program = home / "env" / "bin" / "python"
        program.parent.mkdir(parents=True)
        check_reachable("nobody-of-that-name", str(program))
        home.chmod(0o700)
        with pytest.raises(ServiceError, match=f"{home}: closed to other users"):
            check_reachable("nobody-of-that-name", str(program))
        check_reachable("root", str(program))


@pytest.mark.parametrize("folder", ["/tmp/rass", "/var/tmp/rass", "/opt/../tmp/rass"])
def test_a_program_that_the_service_could_not_see_is_refused(
    folder: str, program: Callable[[str], None], drone: str, card: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    program(folder)
    assert main(["service", "install", drone, "--root", str(card)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"{folder}/bin/python: the service has its own /tmp and /var/tmp")
    assert line.endswith("install rass-mav elsewhere, for example in /opt/rass-mav")
    assert below(card) == set()
    # A folder of that name elsewhere is no such folder.
    program("/opt/tmp/rass")
    assert main(["service", "install", drone, "--root", str(card)]) == 0


def test_a_program_that_a_link_leads_to_is_looked_at(
    tmp_path: Path, program: Callable[[str], None], drone: str, card: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with tempfile.TemporaryDirectory(dir="/var/tmp") as hidden:
        Path("link").symlink_to(hidden)
        program("link")
        assert main(["service", "install", drone, "--root", str(card)]) == 1
    assert below(card) == set()


@pytest.mark.parametrize(
    ("key", "section"),
    [
        ("store.path", "store: {path: /tmp/n7.db}"),
        ("control.socket", "control: {socket: /var/tmp/n7.sock}"),
        ("sensor.path", "sensor: {type: log, path: /tmp/flight.LOG}"),
    ],
)
def test_a_file_that_the_service_could_not_see_is_refused(
    key: str, section: str, tmp_path: Path, card: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "drone.yaml"
    file.write_text(CONFIG + section)
    assert main(["service", "install", str(file), "--root", str(card)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"{key}: the service has its own /tmp and /var/tmp, so it cannot find /")
    assert below(card) == set()
    # A relative path leads to the service's own folder.
    file.write_text(CONFIG + section.replace(": /", ": "))
    assert main(["service", "install", str(file), "--root", str(card)]) == 0


KEPT = "var/lib/rass-mav/drone-7.keys"


@pytest.fixture
def keyed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A drone's configuration beside its keys, in the current folder."""
    monkeypatch.chdir(tmp_path)
    create(tmp_path / "m")
    [issued] = issue(tmp_path / "m", [7])
    issued.path.rename(tmp_path / "drone-7.keys")
    (tmp_path / "drone.yaml").write_text(f"{CONFIG}keys: {{file: drone-7.keys}}\n")
    return "drone.yaml"


def test_the_keys_go_into_the_services_folder_for_its_owner_alone(
    keyed: str, card: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = Path("drone-7.keys").read_text()
    for _ in range(2):
        assert main(["service", "install", keyed, "--root", str(card), "--json"]) == 0
        said = capsys.readouterr()
        assert f"/{KEPT}" in json.loads(said.out)["files"]
    kept = card / KEPT
    assert kept.read_text() == own
    assert kept.stat().st_mode & 0o777 == 0o600
    assert (kept.stat().st_uid, kept.stat().st_gid) == (kept.parent.stat().st_uid, kept.parent.stat().st_gid)
    # From another folder, what is there stays.
    Path("drone-7.keys").unlink()
    assert main(["service", "install", keyed, "--root", str(card)]) == 0
    assert kept.read_text() == own


def test_what_would_be_done_with_keys_shows_none(keyed: str, card: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["service", "install", keyed, "--print"]) == 0
    said = capsys.readouterr().out
    assert f"== /{KEPT}: the keys in drone-7.keys, for the node's user alone\n" in said
    assert f"$ chown -h rass: /{KEPT}\n" in said
    assert yaml.safe_load(Path("drone-7.keys").read_text())["secret"] not in said


def test_other_keys_are_kept_unless_told(keyed: str, card: Path, capsys: pytest.CaptureFixture[str]) -> None:
    kept = card / KEPT
    kept.parent.mkdir(parents=True)
    kept.write_text("newer ones")
    assert main(["service", "install", keyed, "--root", str(card)]) == 1
    assert capsys.readouterr().err == (
        f"{kept}: already exists with different contents: delete one of them, or use --replace\n"
    )
    assert below(card) == {KEPT}
    assert main(["service", "install", keyed, "--root", str(card), "--replace"]) == 0
    assert kept.read_text() == Path("drone-7.keys").read_text()


def test_keys_that_the_node_would_not_find_or_not_use(
    keyed: str, card: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("drone-7.keys").chmod(0o644)
    assert main(["service", "install", keyed, "--root", str(card)]) == 2
    assert "accessible to other users" in capsys.readouterr().err
    Path("drone-7.keys").rename("elsewhere.keys")
    assert main(["service", "install", keyed, "--root", str(card)]) == 1
    assert capsys.readouterr().err.startswith("keys.file: there is no drone-7.keys beside the configuration or in ")
    Path(keyed).write_text(f"{CONFIG}keys: {{file: m/ground.keys}}\n")
    assert main(["service", "install", keyed, "--root", str(card)]) == 1
    assert capsys.readouterr().err.startswith("keys.file: there is no m/ground.keys beside the configuration or in ")
    assert below(card) == set()


def test_programs_that_fail_or_are_missing_are_told() -> None:
    assert run(HERE, "-c", "print('well')") == "well\n"
    with pytest.raises(ServiceError, match="it is broken"):
        run(HERE, "-c", "import sys; sys.exit('it is broken')")
    with pytest.raises(ServiceError, match="no-such-program: not found"):
        run("no-such-program", "restart")


@given(st.text(max_size=40))
def test_a_name_is_a_name_or_refused(name: str) -> None:
    try:
        plan = plan_remove(name)
    except ConfigError:
        return
    assert all(Path(path).name in (f"{name}.service", f"{name}.conf") for path in plan.removed)


def test_systemd_agrees(drone: str, card: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What systemd itself thinks of the unit and of the user."""
    analyze, sysusers = shutil.which("systemd-analyze"), shutil.which("systemd-sysusers")
    if analyze is None or sysusers is None:
        pytest.skip("systemd-analyze and systemd-sysusers are not installed")
    # It wants a program that is there.
    monkeypatch.setattr(sys, "executable", "/bin/sh")
    main(["service", "install", drone, "--root", str(card)])
    verified = subprocess.run(
        [analyze, "verify", str(card / UNIT)], capture_output=True, text=True, timeout=60, check=False
    )
    assert "rass-mav.service:" not in verified.stderr
    exposed = subprocess.run(
        [analyze, "security", "--offline=true", "--threshold=35", str(card / UNIT)],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    if "unrecognized option" not in exposed.stderr:  # systemd before 250 does not know it
        assert exposed.returncode == 0, exposed.stdout
    made = subprocess.run(
        [sysusers, f"--root={card}", "--dry-run"], capture_output=True, text=True, timeout=60, check=False
    )
    if "dry-run" not in made.stderr:  # systemd before 250 does not know the option
        assert (made.returncode, "rass_mav node" in made.stdout + made.stderr) == (0, True)

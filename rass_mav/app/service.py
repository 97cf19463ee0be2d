"""A node as a systemd service: plans which files to write and commands to run, and carries out the plan.

The plan is separate, so that it can be shown first. Its paths are those of the running system. With another root (for
example the mounted card of a Raspberry Pi) they are below that root, and no command is run: systemd does the rest when
that card boots.
"""

from __future__ import annotations

import os
import pwd
import re
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from rass_mav.errors import ConfigError, ServiceError, why
from rass_mav.link.address import parse_serial, parse_vehicle_url

from .config import RunConfig, settled

TEMPLATES = Path(__file__).parent / "systemd"
#: How long one of systemd's programs may take, seconds. A start waits until the node is ready.
COMMAND_S = 330.0
_DEVICE = re.compile(r"/dev/(tty[A-Za-z]+|rfcomm)\d+")
_NAME = re.compile(r"[a-z][a-z0-9_-]{0,30}")
# The kernel's names of serial ports, on the board and on USB. A port may have another name (a link in /dev), or be
# plugged in elsewhere.
_SERIAL = ("ttyAMA", "ttyS", "ttyUSB", "ttyACM")
# These load the drivers of the last two, which the kernel otherwise loads when the first such device is plugged in.
_MODULES = "modprobe@usbserial.service modprobe@cdc_acm.service"
_WANTS = "/etc/systemd/system/multi-user.target.wants"
# With PrivateTmp the service has its own empty ones.
_PRIVATE = ("/tmp", "/var/tmp")


class PlannedFile(NamedTuple):
    """A file to write."""

    path: str
    """Absolute, on the running system."""
    content: str


class PlannedKeys(NamedTuple):
    """A key file to copy, for the node's user alone."""

    source: Path
    path: str
    """Absolute, on the running system."""


class Plan(NamedTuple):
    """How to install the service, or remove it."""

    name: str
    files: tuple[PlannedFile, ...]
    """Files to write, all readable by everybody."""
    links: tuple[tuple[str, str], ...]
    """Symbolic links, (path, target): they replace the commands on a system that is not running."""
    removed: tuple[str, ...]
    """Files to remove, if they exist."""
    commands: tuple[tuple[str, ...], ...]
    """Commands to run in this order on the running system, after files are written and before others are removed."""
    after: tuple[tuple[str, ...], ...] = ()
    """Commands to run after files are removed."""
    keys: PlannedKeys | None = None
    """What nobody else may read, and nothing shows."""


def unit_path(name: str) -> str:
    """Path of the service's unit."""
    return f"/etc/systemd/system/{name}.service"


def config_path(name: str) -> str:
    """Path of the configuration that the service reads."""
    return f"/etc/{name}/node.yaml"


def check_name(what: str, name: str) -> str:
    """Return the name. Raises `ConfigError` if it is not valid for a service, user or group."""
    if not _NAME.fullmatch(name):
        raise ConfigError(f"{what}: expected a name of lower-case letters, digits, - and _, got {name!r}")
    return name


def plan_install(
    config: RunConfig,
    text: str,
    *,
    name: str,
    user: str,
    groups: Sequence[str],
    python: str,
    program: Sequence[str],
    folder: Path = Path(),
) -> Plan:
    """The plan to install a node as a service.

    :param config: the node's configuration, already checked. `text`: the contents of its file.
    :param name: name of the service. Its data are in /var/lib/NAME, its configuration is /etc/NAME/node.yaml.
    :param user: the user that runs the node; created if it does not exist. `groups`: the groups that it joins.
    :param folder: the folder of the configuration, where its key file is.
    :param python: the interpreter that has rass_mav. `program`: all paths of the program, including targets of links.
    """
    for what, each in (("--name", name), ("--user", user), *(("--group", group) for group in groups)):
        check_name(what, each)
    own = f"/var/lib/{name}"
    outside = {str(path.parent) for path in (config.store_path, config.socket_path) if path.is_absolute()}
    writable = sorted(path for path in outside if not Path(path).is_relative_to(own))
    at_home = any(_below(path, "/home", "/root") for path in (*program, *_files(config).values()))
    values = {
        "NAME": name,
        "USER": user,
        "PYTHON": _quoted(python),
        "CONFIG": config_path(name),
        "PROTECT_HOME": "read-only" if at_home else "yes",
        "WRITABLE": "".join(f"ReadWritePaths={_quoted(path)}\n" for path in writable),
        "DEVICES": "".join(f"DeviceAllow=char-{name} rw\n" for name in _serial_names(config)),
        "MODULES": f"Wants={_MODULES}\nAfter={_MODULES}\n" if _serial_names(config) else "",
    }
    members = "".join(f"m {user} {group}\n" for group in groups)
    files = (
        PlannedFile(config_path(name), text),
        PlannedFile(f"/etc/sysusers.d/{name}.conf", _filled("node.sysusers", values) + members),
        PlannedFile(unit_path(name), _filled("node.service", values)),
    )
    unit = f"{name}.service"
    keys = None
    if config.keys is not None and Path(config.keys.file).name == config.keys.file:
        # A path that is not absolute starts from the service's own folder.
        keys = PlannedKeys(folder / config.keys.file, f"{own}/{config.keys.file}")
    commands = (
        ("systemd-sysusers", f"{name}.conf"),
        *([] if keys is None else [("chown", "-h", f"{user}:", keys.path)]),
        ("systemctl", "daemon-reload"),
        ("systemctl", "enable", unit),
        ("systemctl", "restart", unit),
    )
    return Plan(name, files, ((f"{_WANTS}/{unit}", unit_path(name)),), (), commands, keys=keys)


def _serial_names(config: RunConfig) -> list[str]:
    """Names, without numbers, of the serial ports that the node may open; empty if it has none."""
    urls = [parse_vehicle_url(url) for url in (config.autopilot.url, config.ground.url) if url is not None]
    ports = [url.address[0] for url in urls if url.mode == "serial"]
    ports += [parse_serial(link.device)[0] for link in config.links if link.device is not None]
    ports += [config.sensor.port] if config.sensor.port is not None else []
    if not ports:
        return []
    named = {found[1] for port in ports if (found := _DEVICE.fullmatch(port))}
    return [*_SERIAL, *sorted(named - set(_SERIAL))]


def plan_remove(name: str) -> Plan:
    """The plan to remove the service. Its data, configuration and user remain."""
    check_name("--name", name)
    unit = f"{name}.service"
    removed = (f"{_WANTS}/{unit}", unit_path(name), f"/etc/sysusers.d/{name}.conf")
    return Plan(name, (), (), removed, (("systemctl", "disable", "--now", unit),), (("systemctl", "daemon-reload"),))


def check_reachable(user: str, *paths: str) -> None:
    """Raise `ServiceError` if the user cannot run the programs at these paths, because a folder is closed to others."""
    try:
        uid = pwd.getpwnam(user).pw_uid
    except KeyError:
        uid = -1  # the user does not exist yet, and owns nothing
    if uid == 0:
        return
    for path in paths:
        for folder in (Path(path), *Path(path).parents):
            if not folder.is_dir():
                continue
            about = folder.stat()
            if about.st_uid != uid and not about.st_mode & 0o001:
                raise ServiceError(
                    f"{folder}: closed to other users, so the user {user} cannot run {path}: install rass-mav "
                    f"outside home directories, for example in /opt/rass-mav, or use another --user"
                )


def check_visible(config: RunConfig, program: Sequence[str]) -> None:
    """Raise `ServiceError` if the service cannot see the program, or a file that its node uses."""
    own = "the service has its own /tmp and /var/tmp, so it cannot find"
    for path in program:
        if _below(path, *_PRIVATE):
            raise ServiceError(f"{path}: {own} its program: install rass-mav elsewhere, for example in /opt/rass-mav")
    for key, file in _files(config).items():
        if _below(file, *_PRIVATE):
            raise ServiceError(f"{key}: {own} {file}: choose another folder, or a relative path in the service's own")


def _files(config: RunConfig) -> dict[str, str]:
    """The absolute paths that the configuration names, by key."""
    named = {
        "store.path": config.store.path,
        "control.socket": config.control.socket,
        "sensor.path": config.sensor.path,
        "watch.folder": None if config.watch is None else config.watch.folder,
        "keys.file": None if config.keys is None else config.keys.file,
    }
    return {key: file for key, file in named.items() if file is not None and Path(file).is_absolute()}


def _below(path: str, *folders: str) -> bool:
    """Whether a path leads into one of these folders, directly or through links."""
    leads_to = (Path(os.path.normpath(path)), Path(os.path.realpath(path)))
    return any(each.is_relative_to(folder) for each in leads_to for folder in folders)


def keys_to_copy(config: RunConfig, plan: Plan, root: Path | None, *, replace: bool = False) -> str | None:
    """The contents of the key file that is copied; None: none is, because it is in its place, or not wanted.

    Raises `ServiceError` if the node would not find its keys, and `KeysError` if it must not use them.
    """
    if config.keys is None or Path(config.keys.file).is_absolute():
        return None
    own = place(root, f"/var/lib/{plan.name}")
    there = own / config.keys.file
    if plan.keys is None or not plan.keys.source.exists():
        if there.exists():
            return None
        raise ServiceError(
            f"keys.file: there is no {config.keys.file} beside the configuration or in {own}: put the drone's key "
            "file there, under its original name"
        )
    settled(config, plan.keys.source.parent).open_keys()
    content = plan.keys.source.read_text(encoding="utf-8")
    if not replace and there.exists() and there.read_text(encoding="utf-8", errors="replace") != content:
        raise ServiceError(f"{there}: already exists with different contents: delete one of them, or use --replace")
    return content


def carry_out(plan: Plan, root: Path | None, *, replace: bool = False, keys: str | None = None) -> None:
    """Carry out a plan. Raises `ServiceError`, and writes nothing, if there is a configuration with other contents.

    :param root: folder below which the files are written, without running commands; None: the running system.
    :param replace: replace a configuration that has other contents.
    :param keys: the contents of the key file (`keys_to_copy`).
    """
    try:
        for file in plan.files:
            if file.path == config_path(plan.name) and not replace:
                _check_same(place(root, file.path), file.content)
        for file in plan.files:
            _write(place(root, file.path), file.content)
        if keys is not None and plan.keys is not None:
            _write_keys(place(root, plan.keys.path), keys)
        if root is None:
            for command in plan.commands:
                run(*command)
        else:
            for link, target in plan.links:
                path = place(root, link)
                path.parent.mkdir(parents=True, exist_ok=True)
                path.unlink(missing_ok=True)
                path.symlink_to(target)
        for gone in plan.removed:
            place(root, gone).unlink(missing_ok=True)
    except OSError as error:
        raise ServiceError(f"{error.filename}: {why(error)}") from None
    if root is None:
        for command in plan.after:
            run(*command)


def place(root: Path | None, path: str) -> Path:
    """The location of a system path below another root."""
    return Path(path) if root is None else root / path.lstrip("/")


def run(*command: str, timeout_s: float = COMMAND_S) -> str:
    """Run one of systemd's programs and return its output. Raises `ServiceError` if it fails or does not exist."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=timeout_s, check=False)
    except (FileNotFoundError, PermissionError):
        # The second error occurs where a folder of PATH is closed to us.
        raise ServiceError(f"{command[0]}: not found; the service needs a system with systemd") from None
    except subprocess.TimeoutExpired:
        raise ServiceError(f"{' '.join(command)}: no answer in {timeout_s:g} s") from None
    if done.returncode:
        reason = (done.stderr.strip() or done.stdout.strip() or f"exit code {done.returncode}").splitlines()[0]
        raise ServiceError(f"{' '.join(command)}: {reason}")
    return done.stdout


def state(name: str, timeout_s: float = COMMAND_S) -> dict[str, str]:
    """The properties of the service as systemd reports them. Raises `ServiceError`."""
    wanted = "LoadState,UnitFileState,ActiveState,SubState,MainPID,NRestarts,StatusText"
    text = run("systemctl", "show", f"{name}.service", f"--property={wanted}", timeout_s=timeout_s)
    return dict(line.split("=", 1) for line in text.splitlines() if "=" in line)


def _check_same(path: Path, content: str) -> None:
    """Raise `ServiceError` if the file exists with other contents: somebody may have edited it."""
    if path.exists() and path.read_text(encoding="utf-8", errors="replace") != content:
        raise ServiceError(f"{path}: already exists with different contents: edit it, or use --replace")


def _filled(template: str, values: dict[str, str]) -> str:
    text = (TEMPLATES / template).read_text(encoding="utf-8")
    return re.sub(r"@([A-Z_]+)@", lambda match: values[match[1]], text)


def _quoted(path: str) -> str:
    """A path quoted for a systemd unit, where a % starts a specifier, and a blank ends a word."""
    escaped = path.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%").replace("$", "$$")
    return f'"{escaped}"' if re.search(r"[\s\"'\\;]", path) else escaped


def _write_keys(path: Path, content: str) -> None:
    """Like `_write`, for the owner of the folder alone. If that is root, systemd gives the folder and what is in it to
    the node's user (StateDirectory)."""
    from rass_mav.trust.keys.files import write_over  # with PyNaCl, which few nodes need

    path.parent.mkdir(mode=0o750, parents=True, exist_ok=True)
    write_over(path, content)
    about = path.parent.stat()
    os.chown(path, about.st_uid, about.st_gid, follow_symlinks=False)


def _write(path: Path, content: str) -> None:
    """Write the whole file or nothing: the power may fail at any moment."""
    path.parent.mkdir(parents=True, exist_ok=True)
    fresh = path.with_name(path.name + ".new")
    with fresh.open("w", encoding="utf-8") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
        os.fchmod(file.fileno(), 0o644)
    fresh.replace(path)

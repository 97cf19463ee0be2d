"""`service`: a node that systemd starts at boot."""

from __future__ import annotations

import argparse
import os
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import rass_mav
from rass_mav.errors import ConfigError, ServiceError, os_errors_as

from .common import Subparsers, add_command, add_group, answer, print_json, say, start_logging

if TYPE_CHECKING:
    from rass_mav.app.service import Plan

NAME = "rass-mav"
USER = "rass"
GROUP = "dialout"


def register(subparsers: Subparsers) -> None:
    """Add the command."""
    actions = add_group(
        subparsers, "service", "action",
        help="manage the systemd service that starts the node at boot: install, remove, status",
        description="Manage the systemd service that starts the node at boot and restarts it on failure.",
        example="sudo rass-mav service install drone.yaml",
    )  # fmt: skip
    install = add_command(
        actions, "install", _install, help="install or update the service, and start it",
        example="sudo rass-mav service install drone.yaml",
    )  # fmt: skip
    remove = add_command(
        actions, "remove", _remove, help="stop and remove the service; keep data, configuration and user",
        example="sudo rass-mav service remove",
    )  # fmt: skip
    status = add_command(
        actions, "status", _status, help="show whether the service is installed and running; exit code 1 if not",
        example="rass-mav service status",
    )  # fmt: skip
    install.add_argument("config", metavar="CONFIG.yaml", help=f"the configuration, copied to /etc/{NAME}/node.yaml")
    install.add_argument(
        "--user", default=USER, metavar="NAME", help=f"user to run the node as (default: {USER}); created if missing"
    )
    install.add_argument(
        "--group", action="append", metavar="NAME", help=f"group that the user joins (default: {GROUP}); repeatable"
    )
    install.add_argument("--replace", action="store_true", help="replace an existing configuration that differs")
    for parser in (install, remove):
        parser.add_argument("--print", action="store_true", dest="show", help="show what would be done, and do nothing")
    for parser in (install, remove, status):
        parser.add_argument(
            "--name", default=NAME, metavar="NAME", help=f"service name, for a second node (default: {NAME})"
        )
        parser.add_argument(
            "--root", metavar="DIR", help="root of a system that is not running, such as a mounted card"
        )


def _install(options: argparse.Namespace) -> int:
    from rass_mav.app.config import load_config
    from rass_mav.app.service import check_reachable, check_visible, keys_to_copy, plan_install

    start_logging(options.verbose)
    config = load_config(options.config, settle=False)  # in the service they start from its own folder
    with os_errors_as(ConfigError, options.config):
        text = Path(options.config).read_text(encoding="utf-8")
    groups = options.group if options.group is not None else [GROUP]
    program = (sys.executable, os.path.realpath(sys.executable), sys.prefix, str(Path(rass_mav.__file__).parent))
    plan = plan_install(
        config,
        text,
        name=options.name,
        user=options.user,
        groups=groups,
        python=sys.executable,
        program=program,
        folder=Path(options.config).parent,
    )
    if not options.show:
        check_visible(config, program)
    if options.root is None and not options.show:
        _need_root("install")
        check_reachable(options.user, *program)
    keys = None
    if not options.show:
        with os_errors_as(ServiceError, "keys.file"):
            keys = keys_to_copy(config, plan, _root(options), replace=options.replace)
    return _do(options, plan, f"{options.name}: installed; its log: journalctl -u {options.name}", keys)


def _remove(options: argparse.Namespace) -> int:
    from rass_mav.app.service import config_path, place, plan_remove, unit_path

    start_logging(options.verbose)
    plan = plan_remove(options.name)
    root = _root(options)
    if root is None and not options.show:
        _need_root("remove")
    if not options.show and not place(root, unit_path(options.name)).exists():
        raise ServiceError(f"{place(root, unit_path(options.name))}: does not exist, so there is nothing to remove")
    rest = f"/var/lib/{options.name}, {config_path(options.name)} and the user are kept"
    return _do(options, plan, f"{options.name}: removed; {rest}")


def _do(options: argparse.Namespace, plan: Plan, done: str, keys: str | None = None) -> int:
    from rass_mav.app.service import carry_out

    root = _root(options)
    if not options.show:
        carry_out(plan, root, replace=getattr(options, "replace", False), keys=keys)
    if options.json:
        print_json(
            {
                "name": plan.name,
                "done": not options.show,
                "files": [file.path for file in plan.files] + ([plan.keys.path] if plan.keys is not None else []),
                "removed": list(plan.removed),
                "commands": [shlex.join(command) for command in plan.commands + plan.after] if root is None else [],
            }
        )
    elif options.show:
        _show(plan, root)
    else:
        say(done)
    return 0


def _show(plan: Plan, root: Path | None) -> None:
    from rass_mav.app.service import place

    for file in plan.files:
        say(f"== {place(root, file.path)}")
        sys.stdout.write(file.content if file.content.endswith("\n") else file.content + "\n")
    if plan.keys is not None:
        say(f"== {place(root, plan.keys.path)}: the keys in {plan.keys.source}, for the node's user alone")
    if root is None:
        for command in plan.commands:
            say(f"$ {shlex.join(command)}")
    else:
        for link, target in plan.links:
            say(f"== {place(root, link)} -> {target}")
    for gone in plan.removed:
        say(f"$ rm -f {shlex.quote(str(place(root, gone)))}")
    if root is None:
        for command in plan.after:
            say(f"$ {shlex.join(command)}")


def _status(options: argparse.Namespace) -> int:
    from rass_mav.app.service import check_name, place, state, unit_path

    start_logging(options.verbose)
    check_name("--name", options.name)
    root = _root(options)
    unit = place(root, unit_path(options.name))
    about: dict[str, Any] = {"name": options.name, "installed": unit.exists(), "unit": str(unit)}
    if root is not None:
        link = place(root, f"/etc/systemd/system/multi-user.target.wants/{options.name}.service")
        about["enabled"] = link.is_symlink()
        well = bool(about["installed"])
    else:
        facts = state(options.name)
        about["installed"] = facts.get("LoadState") == "loaded"
        about["enabled"] = facts.get("UnitFileState") == "enabled"
        about["active"] = facts.get("ActiveState", "unknown")
        about["pid"] = int(facts.get("MainPID") or 0) or None
        about["restarts"] = int(facts.get("NRestarts") or 0)
        about["status"] = facts.get("StatusText") or None
        well = about["active"] == "active"
    answer(options, about, [_line(about)])
    return 0 if well else 1


def _line(about: dict[str, Any]) -> str:
    if not about["installed"]:
        return f"{about['name']}: not installed"
    words = ["starts at boot" if about["enabled"] else "does not start at boot"]
    if "active" in about:
        words.insert(0, str(about["active"]))
        if about["pid"]:
            words.append(f"process {about['pid']}")
        if about["restarts"]:
            words.append(f"restarted {about['restarts']} times")
        if about["status"]:
            words.append(str(about["status"]))
    return f"{about['name']}: {', '.join(words)}"


def _root(options: argparse.Namespace) -> Path | None:
    if options.root is None:
        return None
    root = Path(options.root)
    if not root.is_dir():
        raise ConfigError(f"--root: {root} is not a directory")
    return root


def _need_root(action: str) -> None:
    if os.geteuid() != 0:
        raise ServiceError(f"service {action}: requires root (sudo); or use --root DIR, or --print for a dry run")

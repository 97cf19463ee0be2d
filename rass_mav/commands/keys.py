"""`keys`: a mission's keys, and the files that its nodes get."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rass_mav.config.keys import check_package
from rass_mav.config.sections import MAX_NODE
from rass_mav.errors import ConfigError

from .common import Subparsers, add_command, add_group, answer, start_logging

if TYPE_CHECKING:
    from rass_mav.trust.keys.folder import Issued


def register(subparsers: Subparsers) -> None:
    """Add the command."""
    actions = add_group(
        subparsers, "keys", "action", help="manage a mission's keys: new, drone, rotate, revoke, show, autopilot",
        description="Manage the keys that authenticate a mission's nodes and let only the ground read its data.",
        example="rass-mav keys new mission",
    )  # fmt: skip
    new = add_command(
        actions, "new", _new, help="create a mission: a folder with the ground's keys, for bases",
        example="rass-mav keys new mission",
    )  # fmt: skip
    drone = add_command(
        actions, "drone", _drone, help="write the key file of each drone",
        example="rass-mav keys drone 7 8 9 -d mission",
    )  # fmt: skip
    rotate = add_command(
        actions, "rotate", _rotate, help="change the link key of all nodes in flight",
        example="rass-mav keys rotate -d mission",
    )  # fmt: skip
    revoke = add_command(
        actions, "revoke", _rotate, help="revoke drones: change the link key of all others in flight",
        example="rass-mav keys revoke 7 -d mission",
    )  # fmt: skip
    show = add_command(
        actions, "show", _show, help="show the public contents of a key file",
        example="rass-mav keys show drone-7.keys",
    )  # fmt: skip
    autopilot = add_command(
        actions, "autopilot", _autopilot,
        help="show the MAVLink signing passphrase of a drone's autopilot, for a ground station",
        example="rass-mav keys autopilot 7 -d mission",
    )  # fmt: skip
    new.add_argument("folder", metavar="DIR", type=Path, help="the mission's folder; created if it does not exist")
    drone.add_argument("ids", metavar="ID", type=_node_id, nargs="+", help=f"node ids, 0 to {MAX_NODE}")
    how = drone.add_mutually_exclusive_group()
    how.add_argument(
        "--replace", dest="how", action="store_const", const="replace",
        help="issue new keys, to a drone that replaces the one with this id",
    )  # fmt: skip
    how.add_argument(
        "--again", dest="how", action="store_const", const="again", help="write the same keys again, to the same drone"
    )  # fmt: skip
    drone.set_defaults(how="new")
    revoke.add_argument("ids", metavar="ID", type=_node_id, nargs="+", help="node ids of the drones")
    rotate.set_defaults(ids=[])
    autopilot.add_argument("drone", metavar="DRONE", help="the drone's node id, in a mission's folder, or its key file")
    autopilot.add_argument(
        "--serial", metavar="N", type=_serial,
        help="serial of a replaced drone whose autopilot still has the earlier key (default: the latest)",
    )  # fmt: skip
    for parser in (drone, rotate, revoke, autopilot):
        parser.add_argument(
            "-d", "--dir", metavar="DIR", type=Path, default=Path(), dest="folder",
            help="the mission's folder (default: the current one)",
        )  # fmt: skip
    show.add_argument("file", metavar="FILE", help="ground.keys, or a drone's key file")


def _node_id(text: str) -> int:
    if not (text.isascii() and text.isdecimal() and int(text) <= MAX_NODE):
        raise argparse.ArgumentTypeError(f"expected a node id, 0 to {MAX_NODE}, got {text!r}")
    return int(text)


def _serial(text: str) -> int:
    if not (text.isascii() and text.isdecimal() and int(text)):
        raise argparse.ArgumentTypeError(f"expected a serial, from 1, got {text!r}")
    return int(text)


def _new(options: argparse.Namespace) -> int:
    start_logging(options.verbose)
    check_package()
    from rass_mav.trust.keys.files import GROUND_FILE
    from rass_mav.trust.keys.folder import create

    mission = create(options.folder).public.mission
    path = options.folder / GROUND_FILE
    lines = [
        f"mission {mission}: {path} is for the bases; keep a copy in a safe place and never put it on a drone",
        f"next, the drones: rass-mav keys drone 7 8 9 -d {options.folder}",
    ]
    answer(options, {"mission": mission, "file": str(path)}, lines)
    return 0


def _drone(options: argparse.Namespace) -> int:
    start_logging(options.verbose)
    check_package()
    from rass_mav.trust.keys.folder import issue

    issued = issue(options.folder, options.ids, options.how)
    lines = [_line(each) for each in issued]
    if options.how == "replace":
        lines.append("copy ground.keys to the bases and the backup again: it contains the new serials")
    answer(options, {"mission": issued[0].keys.ground.mission, "drones": [_plain(each) for each in issued]}, lines)
    return 0


def _rotate(options: argparse.Namespace) -> int:
    start_logging(options.verbose)
    check_package()
    from rass_mav.trust.keys.files import GROUND_FILE
    from rass_mav.trust.keys.folder import change

    ground, issued = change(options.folder, options.ids)
    out = [{"id": id, "serial": ground.serials[id]} for id in dict.fromkeys(options.ids)]
    path = options.folder / GROUND_FILE
    lines = [f"drone {each['id']}, serial {each['serial']}: revoked" for each in out]
    lines += [
        f"link key {ground.number} from now on, for {len(issued)} drones; their files here were rewritten",
        f"a base that runs on {path} loads it within seconds and sends it to the drones over the air;",
        "copy it to the other bases and to the backup (no restart needed)",
        "rass-mav report shows the link key that each drone had in its last status",
    ]
    drones = [_plain(each) for each in issued]
    plain = {"mission": ground.public.mission, "link_key": ground.number, "revoked": out, "drones": drones}
    answer(options, plain, lines)
    return 0


def _plain(issued: Issued) -> dict[str, Any]:
    own = issued.keys.certificate
    return {"id": own.node_id, "serial": own.serial, "file": str(issued.path)}


def _line(issued: Issued) -> str:
    own = issued.keys.certificate
    return f"drone {own.node_id}, serial {own.serial}: {issued.path}, for this drone only"


def _show(options: argparse.Namespace) -> int:
    start_logging(options.verbose)
    check_package()
    from rass_mav.trust.keys.files import read_keys
    from rass_mav.trust.keys.identity import Ground

    keys = read_keys(options.file)
    plain: dict[str, Any]
    if isinstance(keys, Ground):
        drones = [
            {"id": id, "serial": serial, "revoked": id in keys.revoked} for id, serial in sorted(keys.serials.items())
        ]
        plain = {"holds": "ground", "mission": keys.public.mission, "link_key": keys.number, "drones": drones}
        said = ", ".join(
            f"{drone['id']} (serial {drone['serial']}{', revoked' if drone['revoked'] else ''})" for drone in drones
        )
        lines = [
            f"the ground's keys of mission {keys.public.mission}: never copy them to a drone",
            f"drones: {said or 'none'}",
        ]
    else:
        about = keys.about
        plain = {"holds": "drone", **about}
        lines = [f"the keys of drone {about['node_id']}, serial {about['serial']}, of mission {about['mission']}"]
    lines.append(f"link key {plain['link_key']}")
    answer(options, plain, lines)
    return 0


def _autopilot(options: argparse.Namespace) -> int:
    start_logging(options.verbose)
    check_package()
    from rass_mav.trust.keys.autopilot import autopilot_passphrase
    from rass_mav.trust.keys.files import read_drone
    from rass_mav.trust.keys.folder import drone_keys

    text: str = options.drone
    if text.isascii() and text.isdecimal():
        keys = drone_keys(options.folder, int(text), options.serial)
    elif options.serial is None:
        keys = read_drone(text)
    else:
        raise ConfigError("--serial: requires a node id and the mission's folder")
    own, passphrase = keys.certificate, autopilot_passphrase(keys.secret)
    lines = [
        passphrase,
        f"the passphrase of the autopilot of drone {own.node_id}, serial {own.serial}: secret, with its hyphens",
    ]
    answer(options, {"id": own.node_id, "serial": own.serial, "passphrase": passphrase}, lines)
    return 0

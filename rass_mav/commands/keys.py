"""`keys`: a mission's keys, and the files that its nodes get."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rass_mav.keys.settings import check_package

from .common import Subparsers, add_command, add_group, answer, start_logging
from .filters import MAX_NODE

if TYPE_CHECKING:
    from rass_mav.keys.folder import Issued


def register(subparsers: Subparsers) -> None:
    """Add the command."""
    actions = add_group(
        subparsers, "keys", "action", help="a mission's keys: new, drone, rotate, show",
        description="Keys by which the nodes of a mission know each other. Frames are not signed with them yet.",
        example="rass-mav keys new mission",
    )  # fmt: skip
    new = add_command(
        actions, "new", _new, help="create a mission: the ground's keys, for bases, in a folder",
        example="rass-mav keys new mission",
    )  # fmt: skip
    drone = add_command(
        actions, "drone", _drone, help="write the file of keys that a drone needs",
        example="rass-mav keys drone 7 8 9 -d mission",
    )  # fmt: skip
    rotate = add_command(
        actions, "rotate", _rotate, help="change the key that all nodes have, in three steps",
        example="rass-mav keys rotate add -d mission",
    )  # fmt: skip
    show = add_command(
        actions, "show", _show, help="show what is not secret in a file of keys",
        example="rass-mav keys show drone-7.keys",
    )  # fmt: skip
    new.add_argument("folder", metavar="DIR", type=Path, help="the mission's folder; created if it does not exist")
    drone.add_argument("ids", metavar="ID", type=_node_id, nargs="+", help=f"node ids, 0 to {MAX_NODE}")
    how = drone.add_mutually_exclusive_group()
    how.add_argument(
        "--replace", dest="how", action="store_const", const="replace",
        help="new keys, for another drone in the place of the one that had this id",
    )  # fmt: skip
    how.add_argument(
        "--again", dest="how", action="store_const", const="again", help="the same keys again, for the same drone"
    )  # fmt: skip
    drone.set_defaults(how="new")
    rotate.add_argument(
        "step", choices=("add", "use", "drop"),
        help="add: nodes accept a new key too; use: they sign with it; drop: they refuse the old one. After each "
        "step all nodes get their files",
    )  # fmt: skip
    for parser in (drone, rotate):
        parser.add_argument(
            "-d", "--dir", metavar="DIR", type=Path, default=Path(), dest="folder",
            help="the mission's folder (the current one)",
        )  # fmt: skip
    show.add_argument("file", metavar="FILE", help="ground.keys, or a drone's file")


def _node_id(text: str) -> int:
    if not (text.isascii() and text.isdecimal() and int(text) <= MAX_NODE):
        raise argparse.ArgumentTypeError(f"expected a node id, 0 to {MAX_NODE}, got {text!r}")
    return int(text)


def _new(options: argparse.Namespace) -> int:
    start_logging(options.verbose)
    check_package()
    from rass_mav.keys.files import GROUND_FILE
    from rass_mav.keys.folder import create

    mission = create(options.folder).public.mission
    path = options.folder / GROUND_FILE
    lines = [
        f"mission {mission}: {path} is for the bases; keep a copy in a safe place, and never put it on a drone",
        f"now the drones: rass-mav keys drone 7 8 9 -d {options.folder}",
    ]
    answer(options, {"mission": mission, "file": str(path)}, lines)
    return 0


def _drone(options: argparse.Namespace) -> int:
    start_logging(options.verbose)
    check_package()
    from rass_mav.keys.folder import issue

    issued = issue(options.folder, options.ids, options.how)
    lines = [_line(each) for each in issued]
    if options.how == "replace":
        lines.append("copy ground.keys to the bases and to its backup again: it has the new serials")
    answer(options, {"mission": issued[0].keys.ground.mission, "drones": [_plain(each) for each in issued]}, lines)
    return 0


def _rotate(options: argparse.Namespace) -> int:
    start_logging(options.verbose)
    check_package()
    from rass_mav.keys.folder import rotate

    ground, issued = rotate(options.folder, options.step)
    accepted = " and ".join(map(str, sorted(ground.links)))
    lines = [
        f"link keys: nodes sign with {ground.links[0]}, and accept {accepted}",
        *map(_line, issued),
        "copy ground.keys to all bases and each file to its drone, and restart them, before the next step",
    ]
    plain = {"mission": ground.public.mission, "link_keys": ground.links, "drones": [_plain(each) for each in issued]}
    answer(options, plain, lines)
    return 0


def _plain(issued: Issued) -> dict[str, Any]:
    own = issued.keys.certificate
    return {"id": own.node_id, "serial": own.serial, "file": str(issued.path)}


def _line(issued: Issued) -> str:
    own = issued.keys.certificate
    return f"drone {own.node_id}, serial {own.serial}: {issued.path}, for this drone and nowhere else"


def _show(options: argparse.Namespace) -> int:
    start_logging(options.verbose)
    check_package()
    from rass_mav.keys.files import read_keys
    from rass_mav.keys.identity import Ground

    keys = read_keys(options.file)
    plain: dict[str, Any]
    if isinstance(keys, Ground):
        drones = [{"id": id, "serial": serial} for id, serial in sorted(keys.serials.items())]
        plain = {
            "holds": "ground", "mission": keys.public.mission, "link_keys": list(keys.links), "drones": drones
        }  # fmt: skip
        said = ", ".join(f"{drone['id']} (serial {drone['serial']})" for drone in drones) or "none"
        lines = [f"the ground's keys of mission {keys.public.mission}: never on a drone", f"drones: {said}"]
    else:
        about = keys.about
        plain = {"holds": "drone", **about}
        lines = [f"the keys of drone {about['node_id']}, serial {about['serial']}, of mission {about['mission']}"]
    first, *others = plain["link_keys"]
    lines.append(f"link keys: signs with {first}" + "".join(f", accepts {other} too" for other in others))
    answer(options, plain, lines)
    return 0

"""`params`: checks parameter files for the autopilot, compares them with a vehicle, and writes them to it."""

from __future__ import annotations

import argparse
import asyncio
import sys
import time
from collections.abc import Awaitable, Callable, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

from rass_mav.errors import ConfigError, LinkError

from .common import Subparsers, add_command, add_group, answer, clean, print_json, say, start_logging

if TYPE_CHECKING:
    from rass_mav.mavlink.signedport import SignedPort
    from rass_mav.mavlink.signing import SigningKey
    from rass_mav.params.comparison import Comparison, Row
    from rass_mav.params.files import ParameterFile
    from rass_mav.params.session import Session

T = TypeVar("T")


def register(subparsers: Subparsers) -> None:
    """Add the command."""
    actions = add_group(
        subparsers, "params", "action", help="check or write the autopilot's parameters, or set up its signing",
        description="Check or write the autopilot's parameters or set up its signing.",
        example="rass-mav params check ardupilot-4.7.parm --live drone.yaml",
    )  # fmt: skip
    check = add_command(
        actions, "check", _check,
        help="check a file; with --live, compare the vehicle with it (exit code 1 if they differ)",
        example="rass-mav params check px4.params --live drone.yaml",
    )  # fmt: skip
    write = add_command(
        actions, "write", _write, help="set the vehicle's parameters that differ from a file, after confirmation",
        example="rass-mav params write px4.params --live drone.yaml",
    )  # fmt: skip
    for parser in (check, write):
        parser.add_argument(
            "file",
            metavar="FILE",
            help="parameters: .parm (NAME VALUE) or .params (QGroundControl); or the name of a file that comes with "
            "rass-mav: ardupilot-4.7.parm, ardupilot-4.6.parm, px4.params, each also with -signing before the dot",
        )
        parser.add_argument(
            "--live",
            metavar="CONFIG.yaml",
            required=parser is write,
            help="the node's configuration, for its autopilot",
        )
        parser.add_argument(
            "--sysid",
            type=_system_id,
            metavar="N",
            help="the system id that the vehicle should have (default: unchanged)",
        )
    signing = add_command(
        actions, "signing", _signing,
        help="give the autopilot this drone's key, so that the two sign their messages to each other",
        example="rass-mav params signing drone.yaml",
    )  # fmt: skip
    signing.add_argument("live", metavar="CONFIG.yaml", help="the node's configuration, for its autopilot and keys")
    signing.add_argument("--off", action="store_true", help="turn signing off")
    for parser in (write, signing):
        parser.add_argument("--yes", action="store_true", help="do not ask for confirmation")


def _system_id(text: str) -> int:
    if not (text.isascii() and text.isdecimal() and 1 <= int(text) <= 255):
        raise argparse.ArgumentTypeError(f"expected a system id, 1 to 255, got {text!r}")
    return int(text)


def _check(options: argparse.Namespace) -> int:
    from rass_mav.app.shipped import shipped_or
    from rass_mav.params.files import read_file

    start_logging(options.verbose)
    file = read_file(shipped_or(options.file))
    if options.live is None and options.sysid is not None:
        raise ConfigError("--sysid: requires --live")
    if options.live is None:
        plain = {"file": options.file, "format": file.format, "parameters": len(file.entries)}
        answer(options, plain, [f"{options.file}: ok, {len(file.entries)} parameters"])
        return 0
    found = _compared(_Vehicle(options.live), file, options)
    answer(options, _plain(options.file, found, found.rows), _lines(found))
    return 0 if all(row.state == "same" for row in found.rows) else 1


def _write(options: argparse.Namespace) -> int:
    from rass_mav.app.shipped import shipped_or
    from rass_mav.params.comparison import apply
    from rass_mav.params.files import read_file

    start_logging(options.verbose)
    file = read_file(shipped_or(options.file))
    vehicle = _Vehicle(options.live)
    found = _compared(vehicle, file, options)
    # The list comes before the question; with --json, stdout is for the result alone.
    tell = _tell if options.json else say
    for line in _lines(found):
        tell(line)
    rows = list(found.rows)
    due = [row for row in rows if row.state == "differs"]
    refusal = ""
    if found.misfit:
        refusal = found.misfit
    elif due and found.autopilot.armed:
        refusal = f"vehicle {found.autopilot.system_id} is armed"
    elif due and not options.yes and not _agreed(f"Write {len(due)} to vehicle {found.autopilot.system_id}?"):
        refusal = "not confirmed (--yes skips the question)"
    if refusal:
        tell(f"nothing written: {refusal}")
    elif due:
        applied = vehicle.ask(lambda session: apply(session, found.autopilot.system_id, found.rows))
        written = {row.entry.name: row for row in applied}
        rows = [written.get(row.entry.name, row) for row in rows]
        for row in written.values():
            tell(_line(row))
        tell(_counts(rows))
        if any(row.state == "written" and row.entry.reboot for row in rows):
            tell("reboot the autopilot: some of these take effect only then")
    if options.json:
        print_json(_plain(options.file, found, rows))
    return 0 if not refusal and all(row.state in ("same", "written") for row in rows) else 1


def _signing(options: argparse.Namespace) -> int:
    start_logging(options.verbose)
    from rass_mav.params import signing

    vehicle = _Vehicle(options.live)
    config = vehicle.config
    key, start = vehicle.key()
    vehicle.signing = watch = signing.Watch(key, start)
    tell = _tell if options.json else say
    autopilot = vehicle.ask(lambda session: session.find(config.mavlink.autopilot_id))
    system_id, found = autopilot.system_id, watch.found[autopilot.system_id]
    state = "armed" if autopilot.armed else "disarmed"
    tell(clean(f"vehicle {system_id}: {autopilot.firmware} {state}, signing is {found.value}"))
    wanted = signing.Signature.NONE if options.off else signing.Signature.OURS
    refusal, ahead_s = "", None
    if found is not wanted:
        refusal = signing.refusal(autopilot, watch)
        if not refusal and not options.off:
            tell("the key is sent in the clear: do this by wire or USB, not by radio")
        what = "Turn signing off at" if options.off else f"Give the key of drone {config.node_id} to"
        if not refusal and not options.yes and not _agreed(f"{what} vehicle {system_id}?"):
            refusal = "not confirmed (--yes skips the question)"
    if refusal:
        tell(f"nothing changed: {refusal}")
    elif options.off:
        if found is not wanted:
            vehicle.ask(lambda session: signing.turn_off(session, system_id, watch))
        tell("signing is off: its frames have no signature")
        if config.autopilot.signing:
            tell(f"now set autopilot.signing: false in {options.live}")
    else:
        if found is wanted:
            vehicle.ask(lambda session: signing.check(session, system_id, watch))
            tell("its signatures are valid, and it has answered a signed request")
        else:
            ahead_s = vehicle.ask(lambda session: signing.turn_on(session, system_id, watch, key, time.time()))
            tell(
                "signing is on: its signatures are valid, with timestamps "
                f"{ahead_s:.0f} s above the one it received, and it has answered a signed request"
            )
        if not config.autopilot.signing:
            tell(f"now set autopilot.signing: true in {options.live}")
    if options.json:
        print_json({
            "system_id": system_id, "before": found.name.lower(), "after": (found if refusal else wanted).name.lower(),
            "ahead_s": ahead_s, "refused": refusal or None,
        })  # fmt: skip
    return 1 if refusal else 0


def _compared(vehicle: _Vehicle, file: ParameterFile, options: argparse.Namespace) -> Comparison:
    from rass_mav.params.comparison import compare

    return vehicle.ask(lambda session: compare(session, vehicle.config.mavlink.autopilot_id, file, options.sysid))


def _agreed(question: str) -> bool:
    sys.stderr.write(f"{question} [y/N] ")
    sys.stderr.flush()
    return sys.stdin.readline().strip().lower() in ("y", "yes")


class _Vehicle:
    """The autopilot of a node, which must not be running."""

    def __init__(self, path: str) -> None:
        """`path`: the node's configuration. Raises `ConfigError`."""
        from rass_mav.app.config import load_config
        from rass_mav.mavlink.signedport import SignedPort

        self.path = path
        self.config = load_config(path)
        if self.config.autopilot.url is None:
            raise ConfigError(f"{path}: autopilot.url: missing, expected the autopilot's address")
        self.signing: SignedPort | None = SignedPort(*self.key()) if self.config.autopilot.signing else None
        """What the node does on this port; None: it does not sign."""

    def key(self) -> tuple[SigningKey, int]:
        """The key of the node and its autopilot, and the timestamp from which the node would go on."""
        keyring = self.config.open_keys()
        if keyring is None:
            raise ConfigError(f"{self.path}: keys: missing, expected the drone's key file (documentation: how-to/keys)")
        if self.config.is_base:
            raise ConfigError(f"{self.path}: node.role: expected drone; a base has no key for an autopilot")
        from rass_mav.app.signing import last_timestamp, signing_key

        return signing_key(keyring), last_timestamp(self.config.store_path)

    def ask(self, talk: Callable[[Session], Awaitable[T]]) -> T:
        """The result of a conversation with the autopilot."""
        from rass_mav.app.client import ControlClient
        from rass_mav.errors import ControlError
        from rass_mav.link.address import parse_vehicle_url
        from rass_mav.link.vehicle import open_vehicle
        from rass_mav.params.exchange import Patience, VehicleError
        from rass_mav.params.session import Session

        config = self.config
        assert config.autopilot.url is not None
        url = parse_vehicle_url(config.autopilot.url)
        mavlink = config.mavlink
        system_id = mavlink.system_id or mavlink.autopilot_id or (config.node_id - 1) % 255 + 1

        async def hold() -> T:
            port = open_vehicle(url)
            try:
                session = Session(
                    port, asyncio.get_running_loop().time, system_id=system_id, component_id=mavlink.component_id,
                    patience=Patience(), signing=self.signing,
                )  # fmt: skip
                return await talk(session)
            finally:
                port.close()

        try:
            return asyncio.run(hold())
        except (LinkError, VehicleError) as error:
            try:
                ControlClient(config.socket_path, timeout_s=1.0).close()
            except ControlError:
                raise error from None
            reason = error.text if isinstance(error, LinkError) else error
            raise type(error)(
                f"{reason}; the node of {self.path} is running and uses the autopilot's port: stop it first"
            ) from None


def _lines(found: Comparison) -> list[str]:
    lines = [found.vehicle()]
    lines += [_line(row) for row in found.rows if row.state != "same" or row.note]
    if found.misfit:
        lines.append(f"WARNING: {found.misfit}")
    return [*lines, _counts(found.rows)]


def _line(row: Row) -> str:
    entry, live = row.entry, row.live
    reboot = ", needs a reboot" if entry.reboot else ""
    if live is None:
        text = f"missing: {row.note}"
    elif row.state == "differs":
        text = f"{live.value:.9g} -> {entry.value:.9g}{reboot}"
    elif row.state == "same":
        text = f"{live.value:.9g}, {row.note}"
    elif row.state == "written":
        text = f"written: {live.value:.9g}{reboot}"
    else:
        text = f"{row.state}: {live.value:.9g}, not {entry.value:.9g}: {row.note}"
    return clean(f"  {entry.name:16} {text}")


def _counts(rows: Sequence[Row]) -> str:
    words = {"same": "the same", "differs": "different", "unfit": "of another type"}
    states = [row.state for row in rows]
    return ", ".join(f"{states.count(state)} {words.get(state, state)}" for state in dict.fromkeys(sorted(states)))


def _plain(path: str, found: Comparison, rows: Sequence[Row]) -> dict[str, Any]:
    from rass_mav.mavlink.firmware import firmware_name

    autopilot = found.autopilot
    return {
        "file": path,
        "vehicle": {
            "system_id": autopilot.system_id,
            "firmware": firmware_name(autopilot.type),
            "version": found.version,
            "armed": autopilot.armed,
        },
        "fitting_file": found.fitting,
        "misfit": found.misfit or None,
        "parameters": [row.plain() for row in rows],
    }


def _tell(text: str) -> None:
    sys.stderr.write(text + "\n")

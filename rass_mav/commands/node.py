"""`run` and `check`, and the commands to a running node: `status` and `put`."""

from __future__ import annotations

import argparse
import contextlib
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rass_mav.errors import ConfigError, DatumError, os_errors_as

from .common import Subparsers, add_command, add_set, answer, print_json, say, start_logging
from .report import status_lines

if TYPE_CHECKING:
    from rass_mav.app.client import ControlClient
    from rass_mav.app.config import RunConfig


#: Seconds between two looks with --watch.
WATCH_S = 1.0
# To the top left corner, and clear the screen.
_CLEAR = "\x1b[H\x1b[2J"


def register(subparsers: Subparsers) -> None:
    """Add the commands."""
    run = add_command(
        subparsers, "run", _run, help="run a node, on a drone or at the base, until SIGTERM",
        example="rass-mav run drone.yaml",
    )  # fmt: skip
    check = add_command(
        subparsers, "check", _check, help="check a configuration and show what is wrong with it",
        example="rass-mav check drone.yaml --print",
    )  # fmt: skip
    check.add_argument("--print", action="store_true", dest="show", help="show it with all defaults filled in")
    run.add_argument(
        "-q", "--quiet", action="store_true", help="do not report on the terminal (stderr) what the node observes"
    )  # fmt: skip
    for parser in (run, check):
        parser.add_argument("config", metavar="CONFIG.yaml", help="the configuration")
        add_set(parser)
    status = add_command(
        subparsers, "status", _status, help="show the state of the running node",
        example="rass-mav status drone.yaml --json",
    )  # fmt: skip
    put = add_command(
        subparsers, "put", _put, help="give a file or a line to the running node; returns when it is on its disk",
        example="rass-mav put -c drone.yaml --line 'all well'",
    )  # fmt: skip
    status.add_argument(
        "--watch", action="store_true", help="again every second, until Ctrl-C; with --json an object a line"
    )  # fmt: skip
    status.add_argument("config", metavar="CONFIG.yaml", nargs="?", help="the node's configuration")
    put.add_argument("-c", "--config", metavar="CONFIG.yaml", help="the node's configuration")
    for parser in (status, put):
        parser.add_argument("--socket", metavar="PATH", help="the node's control socket, instead of a configuration")
    what = put.add_mutually_exclusive_group(required=True)
    what.add_argument(
        "file", metavar="FILE", nargs="?", help="a file, stored with its name; -: stdin, stored without a name"
    )
    what.add_argument("--line", metavar="TEXT", help="a line of text")


def _config(options: argparse.Namespace) -> RunConfig:
    from rass_mav.app.config import load_config

    return load_config(options.config, getattr(options, "assignments", ()))


def _run(options: argparse.Namespace) -> int:
    from rass_mav.app.light import load_without_openssl

    # This must come first: later imports would load OpenSSL.
    load_without_openssl()
    from rass_mav.mavlink.dialect import forget_texts

    # The dialect is the largest module of a node. If it is loaded first, later modules reuse its temporary memory.
    forget_texts()
    config = _config(options)
    start_logging(options.verbose, config.log.level)
    from rass_mav.app.run import Runtime

    told = False

    def ready(about: dict[str, Any]) -> None:
        nonlocal told
        if not told and options.json:
            print_json(about)
            sys.stdout.flush()
        told = True

    Runtime(config, ready, narrator(quiet=options.quiet)).run()
    return 0


def narrator(*, quiet: bool) -> Callable[[str], None] | None:
    """Prints what a node observes, for a person at a terminal. A journal or a file only gets the log."""
    return None if quiet or not sys.stderr.isatty() else _narrate


def _narrate(line: str) -> None:
    """Print a line on the terminal, with the time of day."""
    # The node continues if its terminal is gone.
    with contextlib.suppress(OSError):
        sys.stderr.write(f"{time.strftime('%H:%M:%S')} {line}\n")


def _check(options: argparse.Namespace) -> int:
    from rass_mav.app.config import filled_in
    from rass_mav.config.loading import dump_yaml, to_plain

    config = _config(options)
    warnings = config.warnings()
    for warning in warnings:
        sys.stderr.write(f"{options.config}: warning: {warning}\n")
    if options.json:
        print_json({"ok": True, "config": to_plain(filled_in(config)), "warnings": warnings})
    elif options.show:
        sys.stdout.write(dump_yaml(filled_in(config)))
    else:
        say(f"{options.config}: ok ({config.node.role}, node {config.node_id})")
    return 0


def _client(options: argparse.Namespace) -> ControlClient:
    start_logging(options.verbose)
    from rass_mav.app.client import ControlClient

    if options.socket and options.config:
        raise ConfigError("--socket: cannot be combined with a configuration")
    if options.socket:
        return ControlClient(options.socket)
    if options.config:
        return ControlClient(_config(options).socket_path)
    found = sorted(Path().glob("rass-*.sock"))
    if len(found) != 1:
        what = "no" if not found else "more than one"
        raise ConfigError(f"{what} control socket rass-*.sock in this directory: give the configuration or --socket")
    return ControlClient(found[0])


def _status(options: argparse.Namespace) -> int:
    with _client(options) as client:
        while True:
            status = client.ask("status")["status"]
            if options.watch and not options.json and sys.stdout.isatty():
                sys.stdout.write(_CLEAR)
            answer(options, status, status_lines(status))
            if not options.watch:
                return 0
            sys.stdout.flush()
            time.sleep(WATCH_S)


def _put(options: argparse.Namespace) -> int:
    from rass_mav.app.payloads import pack_file
    from rass_mav.core.datum import MAX_PAYLOAD, Kind

    kind = Kind.BYTES
    # Read at most one byte more than a datum holds: enough to see that the file is too large.
    if options.line is not None:
        payload = options.line.encode(errors="surrogateescape")
    elif options.file == "-":
        payload = sys.stdin.buffer.read(MAX_PAYLOAD + 1)
    else:
        kind = Kind.FILE
        path = Path(options.file)
        with os_errors_as(ConfigError, path), path.open("rb") as file:
            payload = pack_file(path.name, file.read(MAX_PAYLOAD + 1))
    if not 0 < len(payload) <= MAX_PAYLOAD:
        raise DatumError(f"a datum holds 1 to {MAX_PAYLOAD} bytes, got {'more' if payload else 'none'}")
    with _client(options) as client:
        id = client.ask("put", payload=payload, kind=int(kind))["id"]
    answer(options, {"id": id, "bytes": len(payload)}, [id])
    return 0

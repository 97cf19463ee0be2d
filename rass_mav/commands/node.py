"""`run` and `check`, and the commands that hand something to a running node: `put` and `measure`."""

from __future__ import annotations

import argparse
import contextlib
import math
import re
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rass_mav.core.datum import MAX_PAYLOAD, MOST_PRIORITY, MOST_TTL_S, USUAL_PRIORITY, Kind, Terms
from rass_mav.errors import ConfigError, ControlError, DatumError, MalformedError, RassError, RefusedError

from .common import (
    Subparsers,
    add_command,
    add_set,
    add_socket,
    answer,
    client_of,
    complain,
    config_of,
    duration,
    keeping,
    lists,
    print_json,
    progress,
    say,
    socket_of,
    start_logging,
)

if TYPE_CHECKING:
    from rass_mav.app.client import ControlClient


#: Seconds between two looks with --wait.
WAIT_S = 0.5
#: Longest line with a reading, bytes.
_MOST_LINE = 4096
_PLACE = ("latitude", "longitude", "altitude")


def register(subparsers: Subparsers) -> None:
    """Add the commands."""
    run = add_command(
        subparsers, "run", _run, help="run a node on a drone or at the base, until Ctrl-C or SIGTERM",
        example="rass-mav run drone.yaml",
    )  # fmt: skip
    check = add_command(
        subparsers, "check", _check, help="check a configuration and report every error",
        example="rass-mav check drone.yaml --print",
    )  # fmt: skip
    check.add_argument(
        "--print", action="store_true", dest="show", help="show the configuration with all defaults filled in"
    )
    run.add_argument(
        "-q", "--quiet", action="store_true", help="do not say on stderr what the node is and observes"
    )  # fmt: skip
    for parser in (run, check):
        parser.add_argument("config", metavar="CONFIG.yaml", help="the node's configuration")
        add_set(parser)
    put = add_command(
        subparsers, "put", _put, help="submit files or text to the running node; print their ids once on disk",
        example="rass-mav put -c drone.yaml --line 'fire at the north gate' --priority 9 --ttl 2h",
    )  # fmt: skip
    measure = add_command(
        subparsers, "measure", _measure, help="submit a reading from your own detector to the running node",
        example="rass-mav measure 0.12 --unit uSv/h -c drone.yaml",
    )  # fmt: skip
    for parser in (put, measure):
        parser.add_argument("-c", "--config", metavar="CONFIG.yaml", help="the node's configuration")
        add_socket(parser)
    put.add_argument(
        "--priority", metavar="N",
        help=f"0 to {MOST_PRIORITY}; data with a higher priority leave each node first (default: {USUAL_PRIORITY})",
    )  # fmt: skip
    put.add_argument(
        "--ttl", metavar="TIME",
        help="lifetime, for example 90s, 10m, 2h or 1d; at most 194d. Data that have not arrived by then expire",
    )  # fmt: skip
    what = put.add_mutually_exclusive_group(required=True)
    what.add_argument(
        "files", metavar="FILE", nargs="*", default=[],
        help="a file, sent under its name; - reads stdin, sent without a name",
    )  # fmt: skip
    what.add_argument("--line", metavar="TEXT", help="a line of text")
    put.add_argument(
        "--redundancy", metavar="K/N", help="any K of N parts restore a file, for example 8/12; parts get no replicas"
    )  # fmt: skip
    put.add_argument("--wait", action="store_true", help="return once everything is known to have arrived at a base")
    _add_reading(measure)


def _add_reading(measure: argparse.ArgumentParser) -> None:
    # argparse treats `-35.36,149.17,584` as an option, because it starts with a minus and is not a plain number.
    measure._negative_number_matcher = re.compile(r"^-(\d|\.\d)")
    measure.add_argument("value", metavar="VALUE", nargs="?", help="the reading, at least 0")
    unit = measure.add_argument("--unit", metavar="UNIT", help="unit of the reading")
    lists(unit, _units)
    measure.add_argument(
        "--time", metavar="TIME", help="when it was measured: ISO 8601, UTC unless it names a zone (default: now)"
    )
    measure.add_argument(
        "--at", metavar="LAT,LON,ALT",
        help="place: degrees, and metres above mean sea level (default: that of the vehicle)",
    )  # fmt: skip
    measure.add_argument(
        "--follow", action="store_true",
        help="read readings from stdin, one JSON object per line, and answer each with one line",
    )  # fmt: skip


def _units() -> list[str]:
    from rass_mav.sensor.dose import STATED

    return [unit for unit in STATED if unit.isascii()]


def _run(options: argparse.Namespace) -> int:
    from rass_mav.app.light import load_without_openssl

    # This must come first: later imports would load OpenSSL.
    load_without_openssl()
    from rass_mav.mavlink.dialect import forget_texts

    # The dialect is the largest module of a node. If it is loaded first, later modules reuse its temporary memory.
    forget_texts()
    config = config_of(options)
    start_logging(options.verbose, config.log.level)
    from rass_mav.app.run import Runtime

    warned = False

    def ready(about: dict[str, Any]) -> None:
        nonlocal warned
        if not warned and options.json:
            print_json(about)
            sys.stdout.flush()
        warned = True

    # A journal or a file gets the first lines, and the log.
    Runtime(config, ready, None if options.quiet else _narrate, attended=sys.stderr.isatty()).run()
    return 0


def _narrate(line: str) -> None:
    """Print a line on stderr, with the time of day."""
    # The node continues if its terminal is gone.
    with contextlib.suppress(OSError):
        sys.stderr.write(f"{time.strftime('%H:%M:%S')} {line}\n")


def _check(options: argparse.Namespace) -> int:
    from rass_mav.app.config import filled_in
    from rass_mav.app.endurance import empty, endurance
    from rass_mav.config.loading import dump_yaml, to_plain
    from rass_mav.config.sections import under

    config = config_of(options)
    with under(options.config):
        config.check_keys()
    warnings = config.warnings()
    for warning in warnings:
        sys.stderr.write(f"{options.config}: warning: {warning}\n")
    lasts = None
    if not config.is_base:
        # The store's folder may be another user's.
        with contextlib.suppress(OSError):
            lasts = endurance(config, empty(config))
    if options.json:
        seconds = None if lasts is None or lasts.seconds == math.inf else round(lasts.seconds)
        print_json({"ok": True, "config": to_plain(filled_in(config)), "warnings": warnings, "store_lasts_s": seconds})
    elif options.show:
        sys.stdout.write(dump_yaml(filled_in(config)))
    else:
        say(f"{options.config}: ok ({config.node.role}, node {config.node_id})")
        if lasts is not None:
            say(f"{options.config}: an empty store {lasts.text}")
    return 0


def _put(options: argparse.Namespace) -> int:
    terms, redundancy = _terms(options), None
    if options.redundancy is not None:
        from rass_mav.app.redundancy import parse_redundancy

        redundancy = parse_redundancy(options.redundancy)
        if not options.files or "-" in options.files:
            raise ConfigError("--redundancy: applies to files only")
    with client_of(options) as client:
        failed: list[str] = []
        if options.line is not None:
            done = [_put_bytes(client, options.line.encode(errors="surrogateescape"), terms)]
        else:
            done, failed = _put_all(client, options.files, terms, redundancy)
        if not options.json:
            answer(options, {}, [each["id"] for each in done])
            sys.stdout.flush()
        complain(failed)
        if options.wait and done:
            with keeping(lambda: "data already submitted are unaffected"):
                _wait(client, done, quiet=options.json)
    if options.json:
        print_json({"put": done, "error": failed} if failed else done[0] if len(done) == 1 else {"put": done})
    return 1 if failed else 0


def _put_all(
    client: ControlClient, names: Sequence[str], terms: Terms, redundancy: tuple[int, int] | None
) -> tuple[list[dict[str, Any]], list[str]]:
    """Returns what was put, and what is wrong with the others. Raises what is wrong with an only one."""
    done: list[dict[str, Any]] = []
    failed: list[str] = []
    for number, name in enumerate(names):
        try:
            if name == "-":
                # At most one byte more than a datum holds: enough to see that it is too large.
                done.append(_put_bytes(client, sys.stdin.buffer.read(MAX_PAYLOAD + 1), terms))
            else:
                done.append(_put_file(client, name, terms, redundancy))
        except RassError as error:
            if len(names) == 1:
                raise
            failed += error.lines()
            if isinstance(error, ControlError) and not isinstance(error, RefusedError):
                failed += [f"{other}: not submitted" for other in names[number:]]
                break
    return done, failed


def _wait(client: ControlClient, done: Sequence[dict[str, Any]], *, quiet: bool) -> None:
    """Until what was put has arrived. Raises `ControlError` if some of it is lost."""
    waiting = {each["id"]: each for each in done}
    total = sum(_progress(client, each)["data"] for each in done)
    over = shown = 0
    with progress(total, "data", quiet=quiet) as advance:
        while True:
            found = {id: _progress(client, each) for id, each in waiting.items()}
            arrived = over + sum(each["arrived"] for each in found.values())
            advance(arrived - shown)
            shown = arrived
            for id, each in found.items():
                if each["arrived"] == each["data"]:
                    over += each["data"]
                    del waiting[id]
            if not waiting:
                return
            if lost := sum(each["lost"] for each in found.values()):
                raise ControlError(f"{lost} of {total} data are lost, {arrived} have arrived")
            time.sleep(WAIT_S)


def _progress(client: ControlClient, done: dict[str, Any]) -> dict[str, Any]:
    """How much has arrived of something that was put."""
    found = client.ask("progress", id=done["id"])
    if "parts" in done and found["data"] == 1:
        raise ControlError(f"{done['id']}: the node no longer tracks this file: too many newer ones were put")
    return found


def _put_bytes(client: ControlClient, payload: bytes, terms: Terms, kind: Kind = Kind.BYTES) -> dict[str, Any]:
    if not 0 < len(payload) <= MAX_PAYLOAD:
        raise DatumError(f"a datum holds 1 to {MAX_PAYLOAD} bytes, got {'more' if payload else 'none'}")
    return {"id": client.ask("put", payload=payload, kind=int(kind), **terms._asdict())["id"], "bytes": len(payload)}


def _put_file(client: ControlClient, name: str, terms: Terms, redundancy: tuple[int, int] | None) -> dict[str, Any]:
    from rass_mav.app.payloads import MOST_SMALL, pack_file
    from rass_mav.app.redundancy import shares_of
    from rass_mav.app.staging import Staging, in_pieces
    from rass_mav.wire.file import Cut

    path = Path(name)
    with Staging(path) as staging:
        if staging.size <= MOST_SMALL and (redundancy is None or not staging.size):
            return _put_bytes(client, pack_file(path.name, staging.whole()), terms, Kind.FILE)
        about = staging.look()
        needed, shares = redundancy or (0, 0)
        # No request holds control characters, and a photograph must not stay behind for its name.
        shown = "".join(c if c.isprintable() else "_" for c in about.name)
        begun = client.ask(
            "file", name=shown, size=about.size, digest=about.digest.hex(), packing=about.packing,
            length=about.length, time=about.time, needed=needed, shares=shares, **terms._asdict(),
        )  # fmt: skip
        cut = Cut(about.packing, needed, shares, begun["part_bytes"], about.length, b"")
        for piece in in_pieces(shares_of(staging.packed(about), cut)):
            client.ask("piece", payload=piece)
        return {**client.ask("done"), "bytes": about.size}


def _terms(options: argparse.Namespace) -> Terms:
    """What the options say. Raises `ConfigError`."""
    priority, ttl_s = USUAL_PRIORITY, None
    if (text := options.priority) is not None:
        if not (re.fullmatch(r"\d{1,3}", text, re.ASCII) and int(text) <= MOST_PRIORITY):
            raise ConfigError(f"--priority: expected 0 to {MOST_PRIORITY}, got {text!r}")
        priority = int(text)
    if (text := options.ttl) is not None:
        found_s = duration(text)
        if found_s is None or not 0 < found_s <= MOST_TTL_S:
            raise ConfigError(
                f"--ttl: expected a time like 90s, 10m, 2h, 1d, up to {MOST_TTL_S // 86400}d, got {text!r}"
            )
        ttl_s = math.ceil(found_s)
    return Terms(priority, ttl_s)


def _measure(options: argparse.Namespace) -> int:
    stated = [name for name in ("value", "unit", "time", "at") if getattr(options, name) is not None]
    if options.follow:
        if stated:
            raise ConfigError(f"--follow: readings come from stdin, expected no {stated[0]}")
        return _measure_lines(socket_of(options))
    if options.value is None or options.unit is None:
        raise ConfigError("measure: expected VALUE --unit UNIT, or --follow")
    fields = _reading(options)
    with client_of(options) as client:
        taken = {"ok": True, **client.ask("measure", **fields)}
    answer(options, taken, [_became(taken)])
    return 0


def _reading(options: argparse.Namespace) -> dict[str, Any]:
    """What the options state. Raises `ConfigError`."""
    from rass_mav.app.handed import HandedReading
    from rass_mav.config.typed import build

    fields: dict[str, Any] = {"value": _number("VALUE", options.value), "unit": options.unit}
    if options.time is not None:
        fields["time"] = options.time
    if options.at is not None:
        parts = options.at.split(",")
        if len(parts) != 3:
            raise ConfigError(f"--at: expected LAT,LON,ALT like 47.3977,8.5456,408, got {options.at!r}")
        fields |= {name: _number("--at", part) for name, part in zip(_PLACE, parts, strict=True)}
    build(fields, HandedReading)
    return fields


def _number(name: str, text: str) -> float:
    if not re.fullmatch(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d{1,3})?", text.strip(), re.ASCII):
        raise ConfigError(f"{name}: expected a number with a decimal point, like 0.12, got {text!r}")
    return float(text)


def _became(taken: dict[str, Any]) -> str:
    """What became of a reading, in words."""
    if taken["id"] is not None:
        return str(taken["id"])
    if taken["due_s"] is None:
        return "accepted; this node creates no measurements (data.interval_steps, data.until_step)"
    return f"accepted; the latest reading becomes a measurement in {taken['due_s']:.0f} s"


def _measure_lines(socket: Path) -> int:
    """Each line gets an answer, also while there is no node: a program need not care when that starts."""
    from rass_mav.app.client import ControlClient
    from rass_mav.app.handed import MOST_REASON, HandedReading
    from rass_mav.app.jsonlines import load_line
    from rass_mav.config.typed import build

    refused = False
    readline = sys.stdin.buffer.readline
    for line in iter(lambda: readline(_MOST_LINE + 1), b""):
        # Each connection is of its own: the node ends those that rest.
        try:
            if len(line) > _MOST_LINE and not line.endswith(b"\n"):
                while line and not line.endswith(b"\n"):
                    line = readline(_MOST_LINE)
                raise ConfigError(f"line too long, at most {_MOST_LINE} bytes")
            try:
                fields = load_line(line)
            except MalformedError as error:
                raise ConfigError(f"expected a JSON object on each line: {error}") from None
            build(fields, HandedReading)
        except ConfigError as error:
            taken: dict[str, Any] = {"ok": False, "error": "; ".join(error.lines())}
            with contextlib.suppress(ControlError), ControlClient(socket) as client:
                client.ask("refused", reason=taken["error"][:MOST_REASON])
        else:
            try:
                with ControlClient(socket) as client:
                    taken = {"ok": True, **client.ask("measure", **fields)}
            except RassError as error:
                taken = {"ok": False, "error": "; ".join(error.lines())}
        refused |= not taken["ok"]
        print_json(taken)
        sys.stdout.flush()
    return 1 if refused else 0

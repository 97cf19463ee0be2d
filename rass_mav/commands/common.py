"""Shared by the commands: options, output, logging."""

from __future__ import annotations

import argparse
import contextlib
import json
import logging
import os
import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TextIO

from rass_mav.errors import ConfigError

if TYPE_CHECKING:
    from tqdm import tqdm

    from rass_mav.app.client import ControlClient
    from rass_mav.app.config import RunConfig

#: Seconds between two lines about progress, where there is no progress bar.
LINE_EVERY_S = 30.0
_SECONDS = {"s": 1.0, "m": 60.0, "h": 3600.0, "d": 86_400.0}
_DURATION = re.compile(r"(\d{1,9}(?:\.\d{1,9})?)([smhd])", re.ASCII)
#: The type of the object that argparse's `add_subparsers` returns.
Subparsers = Any


class HelpFormatter(argparse.RawDescriptionHelpFormatter):
    """Help as wide as the terminal.

    argparse asks `shutil` for the width, and so loads its compression modules: half a MiB of a drone's memory.
    """

    def __init__(self, prog: str) -> None:
        super().__init__(prog, width=_terminal_width() - 2)

    def _split_lines(self, text: str, width: int) -> list[str]:
        """Keep names whole: `scale-free` is not broken at its hyphen."""
        import textwrap  # only needed for help

        return textwrap.wrap(" ".join(text.split()), width, break_on_hyphens=False)

    def _get_help_string(self, action: argparse.Action) -> str | None:
        """Add the names set by `lists`."""
        help = action.help
        names = listed(action)
        return f"{help}: {', '.join(names).replace('%', '%%')}" if names else help


def lists(action: argparse.Action, names: Callable[[], Iterable[str]]) -> None:
    """Add these names to the help of an option. They are requested only when the help is shown, because their registry
    takes time to load. The option is not limited to them: its value is checked where it is used."""
    action.names = names  # type: ignore[attr-defined]


def listed(action: argparse.Action) -> list[str]:
    """The names of an option; empty if it has none, or if their registry cannot be loaded here."""
    names: Callable[[], Iterable[str]] = getattr(action, "names", list)
    try:
        return list(names())
    except ModuleNotFoundError as error:
        if error.name != "msgspec":
            raise
        return []


def _terminal_width() -> int:
    columns = os.environ.get("COLUMNS", "")
    if columns.isdigit() and int(columns):
        return int(columns)
    try:
        return os.get_terminal_size(1).columns or 80
    except (OSError, ValueError):
        return 80


def add_command(
    subparsers: Subparsers, name: str, run: Callable[[argparse.Namespace], int], *, help: str, example: str
) -> argparse.ArgumentParser:
    """Add a command with -v and --json. `run` gets the parsed options and returns the exit code."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        name,
        help=help,
        description=help[0].upper() + help[1:] + ".",
        epilog=f"example: {example}",
        formatter_class=HelpFormatter,
    )
    parser.add_argument("-v", "--verbose", action="count", default=0, help="log to stderr; -vv for more")
    parser.add_argument("--json", action="store_true", help="print exactly one JSON object")
    parser.set_defaults(run=run, parser=parser)
    return parser


def add_group(
    subparsers: Subparsers, name: str, actions: str, *, help: str, description: str, example: str
) -> Subparsers:
    """Add a command with subcommands, and return the object to which `add_command` adds them. `actions`: their name."""
    parser = subparsers.add_parser(
        name, help=help, description=description, epilog=f"example: {example}", formatter_class=HelpFormatter
    )
    help_alone(parser)
    return parser.add_subparsers(dest=actions, metavar=actions.upper())


def help_alone(parser: argparse.ArgumentParser) -> None:
    """Let a command with subcommands show its help if none is given. Exit code 2."""

    def show(options: argparse.Namespace) -> int:
        say(parser.format_help().rstrip())
        return 2

    parser.set_defaults(run=show, parser=parser)


def add_set(parser: argparse.ArgumentParser) -> None:
    """The option --set."""
    parser.add_argument(
        "--set",
        metavar="KEY.PATH=VALUE",
        action="append",
        default=[],
        dest="assignments",
        help="override a key of the file; the value is YAML; repeatable",
    )


def duration(text: str) -> float | None:
    """The seconds in a text like 90s, 10m, 2h, 1d; None: it is no such text."""
    match = _DURATION.fullmatch(text)
    return None if match is None else float(match[1]) * _SECONDS[match[2]]


def start_logging(verbose: int, level: str = "warning") -> None:
    """Logs go to stderr. `verbose`: how often -v was given; 0: `level` (debug, info, warning or error)."""
    chosen = {0: level.upper(), 1: "INFO"}.get(verbose, "DEBUG")
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(
        _JournalFormatter("%(name)s: %(message)s")
        if _goes_to_journal(sys.stderr)
        else logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s")
    )
    logging.basicConfig(level=chosen, handlers=[handler], force=True)


class _JournalFormatter(logging.Formatter):
    """For journald, which adds its own time stamps: each line starts with its level instead (sd-daemon(3))."""

    def format(self, record: logging.LogRecord) -> str:
        prefix = f"<{_priority(record.levelno)}>"
        return "\n".join(prefix + line for line in super().format(record).splitlines())


def _priority(level: int) -> int:
    """The syslog priority: 2 critical, 3 error, 4 warning, 6 information, 7 debug."""
    return next((number for least, number in ((50, 2), (40, 3), (30, 4), (20, 6)) if level >= least), 7)


def _goes_to_journal(stream: TextIO) -> bool:
    """Whether journald reads the stream: $JOURNAL_STREAM contains the device and inode of its end (systemd.exec(5)).

    The variable alone is not enough: a program whose output is redirected still inherits it.
    """
    named = os.environ.get("JOURNAL_STREAM")
    if not named:
        return False
    try:
        about = os.fstat(stream.fileno())
    except (OSError, ValueError):
        return False
    return named == f"{about.st_dev}:{about.st_ino}"


def print_json(value: dict[str, Any]) -> None:
    """One JSON object on stdout."""
    say(json.dumps(value))


def answer(options: argparse.Namespace, plain: dict[str, Any], lines: Iterable[str]) -> None:
    """Print the result of a command: with --json as one object, otherwise as lines for people."""
    if options.json:
        print_json(plain)
    else:
        for line in lines:
            say(line)


def say(text: str) -> None:
    """Print a line on stdout. What a stream that is not UTF-8 cannot hold is escaped, as it is on stderr."""
    encoding = sys.stdout.encoding or "utf-8"
    sys.stdout.write(text.encode(encoding, errors="backslashreplace").decode(encoding) + "\n")


def painted(text: str, colour: str, stream: TextIO) -> str:
    """The text in colour, if the stream is a terminal and colours are not turned off (NO_COLOR)."""
    if not stream.isatty():
        return text
    from termcolor import colored

    return colored(text, colour)


def warn(text: str) -> None:
    """Print a warning on stderr."""
    sys.stderr.write(painted("WARNING:", "yellow", sys.stderr) + f" {text}\n")


def complain(lines: Iterable[str]) -> None:
    """Print what failed on stderr. The lines may name what others have sent."""
    for line in lines:
        sys.stderr.write(painted(clean(line), "red", sys.stderr) + "\n")


def clean(text: str) -> str:
    """Make untrusted text safe for a terminal: control characters are shown, not executed."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


class ProgressLines:
    """Reports progress in lines, where no bar can be drawn, for example in a log."""

    def __init__(
        self, total: int, unit: str, stream: TextIO, clock: Callable[[], float], every_s: float = LINE_EVERY_S
    ) -> None:
        """`total`: amount of work, in units. `clock`: returns seconds."""
        self._total, self._unit, self._stream, self._clock, self._every_s = total, unit, stream, clock, every_s
        self._done = 0
        self._begun = self._shown = clock()

    def advance(self, units: int) -> None:
        """Count units of finished work."""
        self._done += units
        now = self._clock()
        if now - self._shown >= self._every_s:
            self._shown = now
            self._stream.write(f"{self._done} of {self._total} {self._unit} done in {now - self._begun:.0f} s\n")
            self._stream.flush()


@contextlib.contextmanager
def progress(total: int, unit: str, *, quiet: bool) -> Iterator[Callable[[int], object]]:
    """Show progress on stderr, unless `quiet`: a progress bar on a terminal, otherwise an occasional line.

    The bar needs tqdm (the extra `sim`).
    """
    if quiet:
        yield lambda units: None
        return
    bar = _bar(total, unit) if sys.stderr.isatty() else None
    if bar is None:
        yield ProgressLines(total, unit, sys.stderr, time.monotonic).advance
        return
    with bar:
        yield bar.update


def _bar(total: int, unit: str) -> tqdm[NoReturn] | None:
    try:
        from tqdm import tqdm
    except ImportError:
        return None
    return tqdm(total=total, unit=f" {unit}", leave=False)


@contextlib.contextmanager
def keeping(remaining: Callable[[], str]) -> Iterator[None]:
    """If the block is interrupted, say what is kept of it."""
    try:
        yield
    except KeyboardInterrupt:
        raise KeyboardInterrupt(remaining()) from None


def add_socket(parser: argparse.ArgumentParser) -> None:
    """The option that names a running node without its configuration."""
    parser.add_argument("--socket", metavar="PATH", help="the node's control socket, instead of a configuration")


def config_of(options: argparse.Namespace) -> RunConfig:
    """The configuration that a command names. Raises `ConfigError`."""
    from rass_mav.app.config import load_config

    return load_config(options.config, getattr(options, "assignments", ()))


def client_of(options: argparse.Namespace) -> ControlClient:
    """A connection to the running node that a command names. Raises `ConfigError`, `ControlError`."""
    from rass_mav.app.client import ControlClient

    return ControlClient(socket_of(options))


def socket_of(options: argparse.Namespace) -> Path:
    """The control socket of the running node that a command names. Raises `ConfigError`."""
    start_logging(options.verbose)
    if options.socket and options.config:
        raise ConfigError("--socket: cannot be combined with a configuration")
    if options.socket:
        return Path(options.socket)
    if options.config:
        return config_of(options).socket_path
    found = sorted(Path().glob("rass-*.sock"))
    if len(found) != 1:
        what = "no" if not found else "more than one"
        raise ConfigError(f"{what} control socket rass-*.sock in this directory: specify the configuration or --socket")
    return found[0]

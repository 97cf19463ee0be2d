"""The command `rass-mav`. A module is loaded for its own commands and for help alone, so that each starts fast and
stays small. What it needs for its work is imported when that begins: help must not need it.

Exit codes: 0 success, 2 bad usage or configuration, 1 a failed run, 130 interrupted. Errors are lines on stderr. With
--json they are also an object on stdout: `{"error": ["the first line", ...]}`.
"""

from __future__ import annotations

import argparse
import importlib
import os
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from typing import NoReturn

from rass_mav import __version__
from rass_mav.commands.common import HelpFormatter, complain, help_alone, print_json
from rass_mav.errors import ConfigError, DatumError, RassError, comma_hint

#: The commands, in the order of `--help`, and the modules whose function `register(subparsers)` adds them.
COMMANDS = {
    **dict.fromkeys(("run", "check", "put", "measure"), "commands.node"),
    "status": "ground.commands.status",
    **dict.fromkeys(("ls", "get"), "ground.commands.data"),
    "export": "ground.commands.export",
    "report": "ground.commands.report",
    "sources": "ground.commands.sources",
    "page": "ground.commands.page",
    "doctor": "commands.doctor",
    "params": "commands.params",
    "keys": "commands.keys",
    "service": "commands.service",
    "try": "lab.commands.demo",
    "mock-vehicle": "lab.commands.mock_vehicle",
    "swarm": "lab.commands.swarm",
    "sitl": "lab.commands.sitl",
    "replay": "lab.commands.replay",
    "experiment": "lab.commands.experiment",
    "completion": "commands.completion",
}


class BadUsage(SystemExit):
    """A command line that is not understood. Exit code 2."""

    def __init__(self, parser: argparse.ArgumentParser, message: str) -> None:
        super().__init__(2)
        self.parser = parser
        self.message = message


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are raised, not printed."""

    def error(self, message: str) -> NoReturn:
        """Raises `BadUsage`."""
        raise BadUsage(self, message)

    def _check_value(self, action: argparse.Action, value: object) -> None:
        """Like argparse, which suggests a correction only from Python 3.14 on."""
        if action.choices is None or value in action.choices:
            return
        names = [str(choice) for choice in action.choices]
        meant = _closest(str(value), names)
        hint = f"one of {', '.join(names)}" if meant is None else f"did you mean {meant!r}?"
        if isinstance(action, argparse._SubParsersAction):
            others: dict[str, str] = self.get_default("elsewhere") or {}
            hint = others.get(os.path.splitext(str(value))[1], hint)
            if groups := [name for name, parser in action.choices.items() if str(value) in _actions(parser)]:
                hint = f"did you mean {f'{groups[0]} {value}'!r}?"
            raise argparse.ArgumentError(None, f"unknown {action.dest} {value!r} ({hint})")
        raise argparse.ArgumentError(action, f"invalid choice: {value!r} ({hint})")


def _actions(parser: argparse.ArgumentParser) -> Iterable[str]:
    """The subcommands of a command."""
    groups = (action for action in parser._actions if isinstance(action, argparse._SubParsersAction))
    return [name for group in groups for name in group.choices]


def build_parser(name: str | None = None) -> argparse.ArgumentParser:
    """The command line. `name`: of a command, whose module is enough; if there is none of this name, all are loaded."""
    parser = Parser(
        prog="rass-mav",
        description="Risk-Aware Swarm Storage for MAVLink drones.",
        epilog="example: rass-mav run drone.yaml",
        formatter_class=HelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"rass-mav {__version__}")
    help_alone(parser)
    parser.set_defaults(whole=build_parser)
    subparsers = parser.add_subparsers(dest="command", metavar="COMMAND")
    for module in dict.fromkeys([COMMANDS[name]] if name in COMMANDS else COMMANDS.values()):
        importlib.import_module(f"rass_mav.{module}").register(subparsers)
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command. Returns the exit code (bad usage raises SystemExit(2), as argparse does)."""
    words = sys.argv[1:] if arguments is None else list(arguments)
    try:
        options, unknown = build_parser(*words[:1]).parse_known_args(words)
        if unknown:
            options.parser.error(f"unrecognized arguments: {' '.join(unknown)}")
    except BadUsage as bad:
        _tell([_usage_line(bad, words)], json="--json" in words)
        raise
    run: Callable[[argparse.Namespace], int] = options.run
    try:
        code = run(options)
        sys.stdout.flush()
        return code
    except (ConfigError, DatumError) as error:
        return _failed(options, error, 2)
    except RassError as error:
        return _failed(options, error, 1)
    except ModuleNotFoundError as error:
        # A node does not need msgspec; the simulations do (docs/how-to/install.md).
        if error.name != "msgspec":
            raise
        return _failed(options, RassError(f"{options.command}: needs the package msgspec: pip install msgspec"), 1)
    except KeyboardInterrupt as stop:
        return _failed(options, RassError(f"interrupted: {stop}" if str(stop) else "interrupted"), 130)
    except BrokenPipeError:
        # The reader of our output has closed it. The interpreter must not fail again when it flushes.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1


def _failed(options: argparse.Namespace, error: RassError, code: int) -> int:
    _tell(error.lines(), json=getattr(options, "json", False))
    return code


def _tell(lines: Sequence[str], *, json: bool) -> None:
    complain(lines)
    if json:
        print_json({"error": list(lines)})


def _usage_line(bad: BadUsage, words: Sequence[str]) -> str:
    """The error in a command line, with the options that were probably meant."""
    options = [option for option in bad.parser._option_string_actions if option.startswith("--")]
    present = [word.partition("=")[0] for word in words if word.startswith("--") and word != "--"]
    unknown = [word for word in present if not any(option.startswith(word) for option in options)]
    others: dict[str, str] = bad.parser.get_default("elsewhere") or {}
    meant = dict.fromkeys(
        option for word in unknown if (option := others.get(word) or _closest(word, options)) is not None
    )
    hint = f" (did you mean {' '.join(meant)}?)" if meant else ""
    if (value := re.search(r"invalid float value: '(.*)'$", bad.message)) is not None:
        hint = comma_hint(value[1])
    return " ".join(f"{bad.parser.prog}: {bad.message}{hint} (see {bad.parser.prog} --help)".split())


def _closest(name: str, names: Sequence[str]) -> str | None:
    from rass_mav.config.typed import closest

    return closest(name, names)

"""The command `rass-mav`. Each module in `rass_mav.commands` adds its own.

What a command needs is imported when it runs, so that the others start fast and stay small.

Exit codes: 0 success, 2 bad usage or configuration, 1 a failed run, 130 interrupted. An error is one line on stderr.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import sys
from collections.abc import Callable, Sequence
from typing import NoReturn

from rass_mav import __version__
from rass_mav.commands.common import HelpFormatter
from rass_mav.errors import ConfigError, DatumError, RassError

#: Modules with a function `register(subparsers)`, in the order of `--help`.
COMMANDS = ("node", "doctor", "params", "service", "desk", "swarm", "sitl", "replay", "experiment")


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        """Exit code 2."""
        self.exit(2, f"{self.prog}: {message} (see {self.prog} --help)\n")


def build_parser() -> argparse.ArgumentParser:
    """The whole command line."""
    parser = Parser(
        prog="rass-mav",
        description="Risk-Aware Swarm Storage for MAVLink drones.",
        epilog="example: rass-mav run drone.yaml",
        formatter_class=HelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"rass-mav {__version__}")
    subparsers = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name in COMMANDS:
        importlib.import_module(f"rass_mav.commands.{name}").register(subparsers)
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command. Returns the exit code (bad usage raises SystemExit(2), as argparse does)."""
    options = build_parser().parse_args(arguments)
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
        # A node does without it; what simulates one does not (docs/raspberry-pi.md).
        if error.name != "msgspec":
            raise
        return _failed(options, RassError(f"{options.command}: needs the package msgspec: pip install msgspec"), 1)
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        # Who reads our output has seen enough. The interpreter must not stumble over it again when it flushes.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1


def _failed(options: argparse.Namespace, error: RassError, code: int) -> int:
    text = " ".join(str(error).split())
    sys.stderr.write(f"{text}\n")
    if getattr(options, "json", False):
        sys.stdout.write(json.dumps({"error": text}) + "\n")
    return code

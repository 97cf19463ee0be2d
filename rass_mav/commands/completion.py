"""`completion`: prints a shell's completions of the commands."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

from rass_mav.errors import RassError

from .common import Subparsers, add_command, print_json

#: The folder with the files, where the program was installed from a wheel.
_DIRECTORY = Path(__file__).parent / "shell"
#: The file of each shell.
FILES = {"bash": "rass-mav", "zsh": "_rass-mav", "fish": "rass-mav.fish"}

_HOW = """
bash: rass-mav completion bash > ~/.local/share/bash-completion/completions/rass-mav
zsh:  rass-mav completion zsh > ~/.zfunc/_rass-mav, with `fpath+=~/.zfunc; autoload -U compinit; compinit` in ~/.zshrc
fish: rass-mav completion fish > ~/.config/fish/completions/rass-mav.fish
"""


def register(subparsers: Subparsers) -> None:
    """Add the command."""
    completion = add_command(
        subparsers, "completion", _completion, help="print the completion script for a shell",
        example="rass-mav completion bash > ~/.local/share/bash-completion/completions/rass-mav",
    )  # fmt: skip
    completion.description = f"{completion.description}\n{_HOW}".rstrip()
    completion.add_argument("shell", choices=tuple(FILES), metavar="SHELL", help=f"one of {', '.join(FILES)}")


def _completion(options: argparse.Namespace) -> int:
    text = _script(options.shell, options.whole)
    if options.json:
        print_json({"shell": options.shell, "script": text})
    else:
        sys.stdout.write(text)
    return 0


def _script(shell: str, whole: Callable[[], argparse.ArgumentParser]) -> str:
    """What came with the wheel; in a checkout it is generated from the whole command line."""
    file = _DIRECTORY / FILES[shell]
    if file.exists():
        return file.read_text(encoding="utf-8")
    try:
        from .shell_files import script
    except ModuleNotFoundError as error:
        if error.name != "shtab":
            raise
        raise RassError("completion: a checkout needs the package shtab: pip install shtab") from None
    return script(shell, whole())

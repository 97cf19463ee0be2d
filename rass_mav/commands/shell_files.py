"""What shells and `man` know of the commands: completions and the manual page, generated from the commands themselves.

setup.py puts them into the wheel, so that a drone needs neither shtab nor argparse-manpage. In a checkout, `rass-mav
completion` generates what it prints.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import shtab

from rass_mav import __version__

from .common import listed, lists

# What completes an argument, by its metavar.
_BY_METAVAR = {
    "FILE": shtab.FILE,
    "FILE.csv": shtab.FILE,
    "FILE.tlog": shtab.FILE,
    "CONFIG.yaml": shtab.FILE,
    "LOG": shtab.FILE,
    "PATH": shtab.FILE,
    "DIR": shtab.DIRECTORY,
}


def _actions(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    for action in parser._actions:
        yield action
        if isinstance(action, argparse._SubParsersAction):
            for below in action.choices.values():
                yield from _actions(below)


def _name_or_file(names: list[str]) -> dict[str, object]:
    """For an argument that is a file or one of these names."""
    words = " ".join(names)
    return {
        "bash": "_rass_mav_name_or_file",
        "zsh": "_rass_mav_name_or_file",
        "fish": f"(string split ' ' '{words}'; __fish_complete_path (commandline -ct))",
        "preamble": {
            "bash": f'_rass_mav_name_or_file() {{\n  compgen -W "{words}" -- "$1"\n  compgen -f -- "$1"\n}}',
            "zsh": f"_rass_mav_name_or_file() {{\n  _alternative 'names:name:({words})' 'files:file:_files'\n}}",
        },
    }


def script(shell: str, parser: argparse.ArgumentParser) -> str:
    """What the shell has to load. `parser` is the whole command line. It is changed: use another for anything else."""
    for action in _actions(parser):
        names = listed(action)
        lists(action, tuple)
        if names and action.option_strings:
            action.choices = names
        elif names:
            action.complete = _name_or_file(names)  # type: ignore[attr-defined]
        elif action.metavar in _BY_METAVAR:
            action.complete = _BY_METAVAR[str(action.metavar)]  # type: ignore[attr-defined]
    text: str = shtab.complete(parser, shell)
    return text.rstrip() + "\n"


def manual(parser: argparse.ArgumentParser) -> str:
    """The manual page. `parser` is the whole command line. It is changed: use another for anything else."""
    from argparse_manpage.manpage import Manpage  # the completions do without

    parser.man_short_description = "risk-aware swarm storage for MAVLink drones"  # type: ignore[attr-defined]
    # The page has a formatter of its own, which adds no names to the help.
    for action in _actions(parser):
        if names := listed(action):
            action.help = f"{action.help}: {', '.join(names)}"
    page = Manpage(parser, {"project_name": "rass-mav", "version": __version__, "manual_title": "User Commands"})
    page.date = ""  # the day on which it was generated says nothing
    return str(page)

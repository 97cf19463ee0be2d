"""The command line as a whole: help, errors, JSON, colour, progress, interruption."""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import pty
import re
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from rass_mav.cli import COMMANDS as MODULES
from rass_mav.cli import build_parser, main
from rass_mav.commands.common import LINE_EVERY_S, ProgressLines, help_alone, listed
from rass_mav.lab.medium.neighbours import reachable
from rass_mav.lab.swarm.mobility import TOPOLOGIES
from rass_mav.lab.swarm.scenario import shipped
from rass_mav.policy.settings import kinds

Capture = pytest.CaptureFixture[str]
WRONG = "node: {id: 1, rolle: base}\npolicy: {alpha: ten}\nlinks: [{peers: [{address: 'a:1'}]}]\n"
TWO_LINES = [
    "node.yaml: node.rolle: unknown key (did you mean 'role'?)",
    "node.yaml: policy.alpha: expected a number >= 0, got 'ten'",
]


def commands(parser: argparse.ArgumentParser, name: str = "") -> Iterator[tuple[str, argparse.ArgumentParser]]:
    """All commands, those inside others too: their words, and the parser of their options."""
    inner = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    if not inner:
        yield name.strip(), parser
    for action in inner:
        for word, below in action.choices.items():
            yield from commands(below, f"{name} {word}")


COMMANDS = dict(commands(build_parser()))


@pytest.mark.parametrize("name", MODULES)
def test_a_command_has_the_same_options_whatever_else_is_loaded(name: str) -> None:
    alone = dict(commands(build_parser(name)))
    for words in (words for words in COMMANDS if words.split()[0] == name):
        assert alone[words].format_help() == COMMANDS[words].format_help()
    assert list(dict.fromkeys(words.split()[0] for words in COMMANDS)) == list(MODULES)


def refused(capsys: Capture, *words: str) -> str:
    """What is said of a command line that is not understood; with --json the same is on stdout."""
    with pytest.raises(SystemExit) as end:
        main(words)
    assert end.value.code == 2
    said = capsys.readouterr()
    assert said.err.count("\n") == 1
    assert said.out == (json.dumps({"error": [said.err.rstrip("\n")]}) + "\n" if "--json" in words else "")
    return said.err.rstrip("\n")


# -- help --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("words", [[], ["params"], ["service"], ["experiment"]], ids=str)
def test_a_command_that_needs_another_shows_its_help(words: list[str], capsys: Capture) -> None:
    assert main(words) == 2
    said = capsys.readouterr()
    assert said.out.startswith(f"usage: {' '.join(['rass-mav', *words])} [-h]")
    assert "example: " in said.out
    assert said.err == ""


@pytest.mark.parametrize("name", COMMANDS)
def test_every_help_has_an_example_and_its_own_words(name: str) -> None:
    text = COMMANDS[name].format_help()
    assert re.search(rf"^example: (sudo )?rass-mav {name}\b", text, re.M)


def test_the_names_in_the_help_come_from_where_they_are_defined() -> None:
    def named(command: str, option: str) -> list[str]:
        (action,) = (a for a in COMMANDS[command]._actions if option in (a.dest, *a.option_strings))
        text = " ".join(COMMANDS[command].format_help().split())
        assert f": {', '.join(listed(action))}" in text
        return listed(action)

    for command in ("swarm", "sitl", "experiment policies", "experiment five-drones", "experiment moving-sources"):
        assert set(named(command, "--policy")) == set(kinds())
    assert set(named("swarm", "--topology")) == set(TOPOLOGIES)
    assert named("swarm", "--transport") == ["loopback", "udp"]
    assert named("swarm", "scenario") == shipped()


# -- bad usage ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["chekc"], "rass-mav: unknown command 'chekc' (did you mean 'check'?) (see rass-mav --help)"),
        (["revoke", "7"], "rass-mav: unknown command 'revoke' (did you mean 'keys revoke'?) (see rass-mav --help)"),
        (["swarm", "--listen", "127.0.0.1:8000"],
         "rass-mav swarm: unrecognized arguments: --listen (did you mean --page HOST:PORT?) "
         "(see rass-mav swarm --help)"),
        (["swarm", "--loss", "0,1"],
         "rass-mav swarm: argument --loss: invalid float value: '0,1' (a number has a decimal point: 0.1) "
         "(see rass-mav swarm --help)"),
        (["params", "chek"],
         "rass-mav params: unknown action 'chek' (did you mean 'check'?) (see rass-mav params --help)"),
        (["params", "xyz"],
         "rass-mav params: unknown action 'xyz' (one of check, write, signing) (see rass-mav params --help)"),
        (["experiment", "flights/mine.yaml", "--out", "x"],
         "rass-mav experiment: unknown name 'flights/mine.yaml' (experiments have their own scenarios; to compare "
         "policies on yours: documentation, evaluation/simulation) (see rass-mav experiment --help)"),
        (["swarm", "--stpes=4"],
         "rass-mav swarm: unrecognized arguments: --stpes=4 (did you mean --steps?) (see rass-mav swarm --help)"),
        (["run", "a.yaml", "b.yaml"],
         "rass-mav run: unrecognized arguments: b.yaml (see rass-mav run --help)"),
        (["experiment", "paper", "--otu", "x"],
         "rass-mav experiment paper: the following arguments are required: --out (did you mean --out?) "
         "(see rass-mav experiment paper --help)"),
        (["sitl", "a", "--firmware", "px5"],
         "rass-mav sitl: argument --firmware: invalid choice: 'px5' (did you mean 'px4'?) (see rass-mav sitl --help)"),
        (["swarm", "--nodes", "ten"],
         "rass-mav swarm: argument --nodes: invalid int value: 'ten' (see rass-mav swarm --help)"),
    ],
)  # fmt: skip
def test_bad_usage_is_one_line_that_says_what_was_meant(words: list[str], expected: str, capsys: Capture) -> None:
    assert refused(capsys, *words) == expected


@pytest.mark.parametrize(
    "words", ["--json", "rnu --json", "params --json", "service install --json", "swarm --x --json"]
)
def test_bad_usage_is_json_too(words: str, capsys: Capture) -> None:
    refused(capsys, *words.split())


# -- errors of a run ---------------------------------------------------------------------------------------------------


def test_several_errors_are_several_lines_and_a_list(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("node.yaml").write_text(WRONG)
    for command in ("check", "run", "status"):
        assert main([command, "node.yaml", "--json"]) == 2
        said = capsys.readouterr()
        assert said.err.splitlines() == TWO_LINES
        assert json.loads(said.out) == {"error": TWO_LINES}
    assert main(["check", "node.yaml"]) == 2
    assert capsys.readouterr().out == ""


def test_a_failed_run_is_json(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["status", "--socket", "none.sock", "--json"]) == 1
    said = capsys.readouterr()
    assert said.err.startswith("none.sock: no running node")
    assert json.loads(said.out) == {"error": [said.err.rstrip("\n")]}


def test_the_list_of_scenarios_is_json(capsys: Capture) -> None:
    assert main(["swarm", "--list", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["scenarios"]["islands"].startswith("the far half of the swarm")


@pytest.mark.parametrize(
    ("words", "unreal"),
    [
        ("demo", True),
        ("hostile", False),
        ("field-sik-64k", True),
        ("field-sik-64k --set radiation.page_dose=9.0e+7", False),
        ("field-sik-64k --set radiation.corruption=false", False),
    ],
)
def test_a_swarm_says_when_its_radiation_does_what_real_radiation_does_not(
    words: str, unreal: bool, capsys: Capture
) -> None:
    assert main(["swarm", *words.split(), "--steps", "1"]) == 0
    assert ("about a million times too low" in capsys.readouterr().out) == unreal


# -- who can reach a base ----------------------------------------------------------------------------------------------


def test_a_way_to_a_base_may_have_many_hops() -> None:
    assert reachable([[1], [0, 2], [1], [4], [3]], 1) == 2
    assert reachable([[1], [0], []], 2) == 0


@pytest.mark.parametrize(
    ("options", "reached", "warning"),
    [
        ([], 8, ""),
        (["--range", "0.5"], 0, "WARNING: 9 nodes, 0 can reach a base at the start: 8 drones cannot "
         "(topology: grid, radio.range_m: 0.5)\n"),
    ],
    ids=["all", "none"],
)  # fmt: skip
def test_a_swarm_that_cannot_reach_its_base_is_told(
    options: list[str], reached: int, warning: str, capsys: Capture
) -> None:
    assert main(["swarm", "--nodes", "9", "--steps", "2", "--json", *options]) == 0
    said = capsys.readouterr()
    assert (json.loads(said.out)["reachable"], said.err) == (reached, warning)


@pytest.mark.parametrize(
    ("options", "warning"),
    [
        (["traffic.load=0.5"],
         "WARNING: traffic.load: 0.5 is more than a measurement of 20 bytes from each drone in each step, which is a "
         "load of 0.0025\n"),
        (["traffic.load=0.5", "traffic.picture_bytes=9"],
         "WARNING: traffic.load: 0.5 is more than a picture of 9 bytes from each drone in each step, which with "
         "measurements is a load of 0.002\n"),
        (["traffic.load=0.002"], ""),
    ],
)  # fmt: skip
def test_a_load_that_drones_cannot_create_is_told(options: list[str], warning: str, capsys: Capture) -> None:
    keys = ["radio.preset=wifi-6m", "nodes=9", "node.step_s=1", *options]
    assert main(["swarm", "--steps", "1", "--json", *(word for key in keys for word in ("--set", key))]) == 0
    assert capsys.readouterr().err == warning


@pytest.mark.parametrize(("metres", "told"), [("0.5", True), ("3", False)])
def test_the_summary_says_when_no_drone_can_reach_a_base(metres: str, told: bool, capsys: Capture) -> None:
    assert main(["swarm", "--nodes", "9", "--steps", "2", "--range", metres]) == 0
    line = f"no drone has a route to a base at the start (radio.range_m: {metres})"
    assert (line in capsys.readouterr().out.splitlines()) == told


# -- colour ------------------------------------------------------------------------------------------------------------


def on_a_terminal(monkeypatch: pytest.MonkeyPatch, *words: str) -> tuple[int, str]:
    """The exit code, and all that a terminal gets."""
    main_end, end = pty.openpty()
    with os.fdopen(end, "w") as terminal, monkeypatch.context() as patched:
        patched.setattr(sys, "stdout", terminal)
        patched.setattr(sys, "stderr", terminal)
        code = main(words)
    said = b""
    # The kernel may hand it over in pieces. An error ends what a closed terminal was sent.
    with os.fdopen(main_end, "rb", buffering=0) as ours, contextlib.suppress(OSError):
        while piece := ours.read(1 << 16):
            said += piece
    return code, said.decode().replace("\r\n", "\n")


@pytest.mark.skipif(find_spec("termcolor") is None, reason="termcolor is not installed")
def test_errors_are_red_on_a_terminal_unless_colours_are_off(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from termcolor import termcolor

    monkeypatch.chdir(tmp_path)
    Path("node.yaml").write_text(WRONG)
    for name in ("NO_COLOR", "FORCE_COLOR", "ANSI_COLORS_DISABLED"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("TERM", "xterm")
    plain = "".join(f"{line}\n" for line in TWO_LINES)
    termcolor.can_colorize.cache_clear()
    assert on_a_terminal(monkeypatch, "check", "node.yaml") == (
        2, "".join(f"\x1b[31m{line}\x1b[0m\n" for line in TWO_LINES)
    )  # fmt: skip
    code, said = on_a_terminal(monkeypatch, "doctor", "none.yaml")
    assert code == 1
    assert "\x1b[31mfail\x1b[0m  configuration: " in said
    assert "\x1b[32mpass\x1b[0m  python: " in said
    monkeypatch.setenv("NO_COLOR", "1")
    termcolor.can_colorize.cache_clear()
    assert on_a_terminal(monkeypatch, "check", "node.yaml") == (2, plain)
    termcolor.can_colorize.cache_clear()


# -- long work ---------------------------------------------------------------------------------------------------------


def test_long_work_off_a_terminal_prints_a_line_now_and_then() -> None:
    log, now = io.StringIO(), [100.0]
    lines = ProgressLines(500, "steps", log, lambda: now[0])
    for _ in range(100):
        now[0] += LINE_EVERY_S / 32
        lines.advance(2)
    assert log.getvalue().splitlines() == [f"{64 * n} of 500 steps done in {LINE_EVERY_S * n:.0f} s" for n in (1, 2, 3)]


def interrupt(*_: Any, **__: Any) -> None:
    raise KeyboardInterrupt


@pytest.mark.parametrize(
    ("words", "kept"),
    [
        (["swarm", "--nodes", "4"], "nothing was saved"),
        (["swarm", "--nodes", "4", "--record", "a.tlog"], "the frames so far are in a.tlog"),
    ],
)
def test_an_interrupted_swarm_says_what_is_kept(
    words: list[str], kept: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("rass_mav.lab.swarm.world.World.step", interrupt)
    assert main([*words, "--json"]) == 130
    said = capsys.readouterr()
    assert said.err == f"interrupted: {kept}\n"
    assert json.loads(said.out) == {"error": [f"interrupted: {kept}"]}


def test_an_interrupted_experiment_says_how_to_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    from rass_mav.lab.experiment import runner

    monkeypatch.chdir(tmp_path)
    execute: Any = vars(runner)["execute"]
    done: list[Any] = []

    def once(run: Any) -> Any:
        if done:
            raise KeyboardInterrupt
        done.append(run)
        return execute(run)

    monkeypatch.setattr(runner, "execute", once)
    words = [
        "experiment",
        "five-drones",
        "--out",
        "out",
        "--runs",
        "2",
        "--steps",
        "5",
        "--policy",
        "rass",
        "--jobs",
        "1",
    ]
    assert main(words) == 130
    assert capsys.readouterr().err == (
        "interrupted: finished runs: 1, kept in out/runs; repeat the command to continue\n"
    )


def test_help_alone_is_no_success() -> None:
    """A script that forgets the command notices."""
    parser = argparse.ArgumentParser(prog="x")
    help_alone(parser)
    assert parser.parse_args([]).run(argparse.Namespace()) == 2


def test_what_a_terminal_cannot_show_is_escaped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    raw = io.BytesIO()
    stream = io.TextIOWrapper(raw, encoding="ascii")
    monkeypatch.setattr("sys.stdout", stream)
    config = tmp_path / "p\xf6l.yaml"
    config.write_text("node: {id: 5}\nlinks: [{broadcast: '127.255.255.255:9'}]\n")
    assert main(["check", str(config)]) == 0
    assert b"p\\xf6l.yaml" in raw.getvalue()

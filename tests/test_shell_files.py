"""The completions of the shells, tried in the shells, and the manual page."""

from __future__ import annotations

import json
import os
import pty
import select
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from rass_mav.cli import build_parser, main
from rass_mav.commands.completion import FILES
from rass_mav.lab.swarm.scenario import shipped
from rass_mav.policy.settings import kinds

PATIENCE_S = 60.0


def needs(program: str) -> pytest.MarkDecorator:
    return pytest.mark.skipif(shutil.which(program) is None, reason=f"{program} is not installed")


@pytest.fixture(scope="module")
def directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the completions, under the names by which shells find them."""
    pytest.importorskip("shtab")
    from rass_mav.commands.shell_files import script

    folder = tmp_path_factory.mktemp("shell")
    for shell, name in FILES.items():
        (folder / name).write_text(script(shell, build_parser()), encoding="utf-8")
    return folder


@pytest.mark.parametrize("shell", FILES)
def test_the_command_prints_them(shell: str, directory: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = (directory / FILES[shell]).read_text(encoding="utf-8")
    assert main(["completion", shell]) == 0
    assert capsys.readouterr().out == text
    assert main(["completion", shell, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"shell": shell, "script": text}


def test_without_what_generates_them_a_checkout_names_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delitem(sys.modules, "rass_mav.commands.shell_files", raising=False)
    monkeypatch.setitem(sys.modules, "shtab", None)
    assert main(["completion", "bash"]) == 1
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err == "completion: a checkout needs the package shtab: pip install shtab\n"


_IN_BASH = """
source "$1"
shift
COMP_WORDS=("$@")
COMP_CWORD=$(($# - 1))
COMPREPLY=()
function=$(complete -p rass-mav | sed 's/.*-F \\([^ ]*\\) .*/\\1/')
"$function" rass-mav "${@: -1}" "${@: -2:1}"
printf '%s\\n' "${COMPREPLY[@]}"
"""


def completed_by(shell: str, script: Path, *words: str) -> set[str]:
    """What may stand in the place of the last word."""
    file = str(script)
    if shell == "bash":
        command = ["bash", "--norc", "-c", _IN_BASH, "bash", file, *words]
    else:
        command = ["fish", "--no-config", "-c", f"source {file}; complete -C '{' '.join(words)}'"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=PATIENCE_S)
    return {line.split("\t")[0] for line in done.stdout.splitlines()}


@pytest.mark.parametrize("shell", [pytest.param(shell, marks=needs(shell)) for shell in ("bash", "fish")])
def test_commands_options_and_names_are_completed(
    shell: str, directory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    script = directory / FILES[shell]
    Path("paper-plane.yaml").touch()
    assert completed_by(shell, script, "rass-mav", "sw") == {"swarm"}
    assert {"check", "write"} <= completed_by(shell, script, "rass-mav", "params", "")
    assert "--topology" in completed_by(shell, script, "rass-mav", "swarm", "--to")
    assert completed_by(shell, script, "rass-mav", "swarm", "--policy", "") == set(kinds())
    named = {name for name in shipped() if name.startswith("paper-")}
    assert completed_by(shell, script, "rass-mav", "swarm", "paper-") == {*named, "paper-plane.yaml"}
    assert completed_by(shell, script, "rass-mav", "check", "pap") == {"paper-plane.yaml"}


@needs("zsh")
def test_zsh_completes_too(directory: Path, tmp_path: Path) -> None:
    """zsh completes only what somebody types."""
    process, terminal = pty.fork()
    if process == 0:
        os.execvpe("zsh", ["zsh", "-f", "-i"], {**os.environ, "TERM": "dumb", "HOME": str(tmp_path), "ZDOTDIR": ""})
    try:
        setup = f"PS1=; fpath=({directory} $fpath); autoload -U compinit; compinit -D; echo rea''dy\n"
        os.write(terminal, setup.encode())
        _await(terminal, b"\nready")
        os.write(terminal, b"rass-mav swarm --topology len\t")
        _await(terminal, b"rass-mav swarm --topology lennard-jones")
    finally:
        os.kill(process, signal.SIGKILL)
        os.waitpid(process, 0)
        os.close(terminal)


def _await(terminal: int, text: bytes) -> None:
    said = b""
    deadline = time.monotonic() + PATIENCE_S
    while text not in said:
        assert select.select([terminal], [], [], max(0.0, deadline - time.monotonic()))[0], said
        said += os.read(terminal, 4096)


@needs("groff")
def test_the_manual_page_is_a_manual_page() -> None:
    pytest.importorskip("shtab")
    pytest.importorskip("argparse_manpage")
    from rass_mav.commands.shell_files import manual

    command = ["groff", "-man", "-Tascii", "-ww", "-rLL=100n"]
    done = subprocess.run(
        command, input=manual(build_parser()), capture_output=True, text=True, check=True, timeout=PATIENCE_S
    )
    assert done.stderr == ""
    for words in ("rass-mav run", "--through-autopilots", ", ".join(sorted(kinds()))):
        assert words in " ".join(done.stdout.split())

"""One more of each kind, added to a copy of the program in the places that docs/contribute/guide.md names, and
nowhere else.

Policies, sensors, links and experiments are added in the running program (tests/test_registries.py).
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from tools.wire_table import MESSAGES, MORE

from .environment import environment
from .ground.mission_stores import measured, stored
from .test_registries import PACKAGE


class Scratch:
    """A copy of the program."""

    def __init__(self, place: Path) -> None:
        self.place = place
        self.package = place / "rass_mav"
        shutil.copytree(PACKAGE, self.package, ignore=shutil.ignore_patterns("__pycache__"))

    def add(self, module: str, source: str) -> None:
        """A new module."""
        path = self.package / module
        assert not path.exists()
        path.write_text(source, encoding="utf-8")

    def insert(self, module: str, before: str, text: str) -> None:
        """Some lines before a line that there is once."""
        path = self.package / module
        source = path.read_text(encoding="utf-8")
        assert source.count(before) == 1, (module, before)
        path.write_text(source.replace(before, text + before), encoding="utf-8")

    def python(self, *words: str, code: int = 0) -> str:
        """What an interpreter prints that imports the copy."""
        done = subprocess.run(
            [sys.executable, *words],
            cwd=self.place, env=environment(PYTHONPATH=str(self.place)), capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert done.returncode == code, done.stdout + done.stderr
        return done.stdout

    def run(self, *words: str, code: int = 0) -> str:
        """What the program prints."""
        return self.python("-m", "rass_mav", *words, code=code)

    def json(self, *words: str, code: int = 0) -> dict[str, Any]:
        found = json.loads(self.run(*words, "--json", code=code))
        assert isinstance(found, dict)
        return found


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Scratch:
    return Scratch(tmp_path_factory.mktemp("scratch"))


def test_a_new_export_format_is_one_module(scratch: Scratch) -> None:
    scratch.add(
        "ground/formats/tsv.py",
        """
from collections import Counter

from . import Exported, Format

def write(entries, out, source):
    lines = [f"{entry.name}\\t{entry.size}\\n" for entry in entries]
    out.write_text("".join(lines))
    return Exported(len(lines), Counter(), [out])

FORMAT = Format(".tsv", "names and sizes", write)
""",
    )
    stored(scratch.place / "base.db", [measured(3), measured(4)], time.time())
    # The ending is enough.
    assert scratch.json("export", "base.db", "-o", "mission.tsv")["data"] == 2
    assert [line.split("\t")[1] for line in (scratch.place / "mission.tsv").read_text().splitlines()] == ["21", "21"]


def test_a_new_attacker_is_one_class_and_one_row(scratch: Scratch) -> None:
    scratch.insert(
        "lab/hostile/kinds.py",
        "#: By the names that `hostile: [{kind: ...}]` uses.",
        '''class Mumbler(Attacker):
    """Sends beacons that end after their first byte."""

    def turn(self, now: float) -> Iterable[Said]:
        return (bytes([VERSION << 4 | 1]),)


''',
    )
    scratch.insert("lab/hostile/kinds.py", '    "sinkhole": Sinkhole,\n', '    "mumbler": Mumbler,\n')
    summary = scratch.json("swarm", "--nodes", "9", "--steps", "20", "--set", "hostile=[{kind: mumbler, near: 3}]")
    assert summary["frames"]["malformed"] >= 20


def test_a_new_fate_stands_beside_the_others_and_where_data_are_dropped(scratch: Scratch) -> None:
    scratch.insert(
        "core/datum.py", '    EXPIRED = "expired"\n', '    FORGOTTEN = "forgotten"\n    """Nobody asked for it."""\n'
    )
    for table in ("RECORDED = (", "BEYOND_REPAIR = ("):
        path = scratch.package / "core" / "datum.py"
        path.write_text(path.read_text().replace(table, f"{table}Fate.FORGOTTEN, "), encoding="utf-8")
    scratch.insert("core/datum.py", "    Fate.CORRUPTED: 1, ", "    Fate.FORGOTTEN: 8,\n")
    path = scratch.package / "lab" / "ledger.py"
    path.write_text(path.read_text().replace("LOST = (", "LOST = (Fate.FORGOTTEN, "), encoding="utf-8")
    scratch.insert(
        "core/custody/custody_store.py",
        "        lifetime_s = self.settings.data.lifetime_s\n",
        "        for holding in self.holdings.older(now - 3.0):\n            self.drop(holding, Fate.FORGOTTEN)\n",
    )
    summary = scratch.json("swarm", "--nodes", "9", "--steps", "60", "--check", "--set", "radio.loss=0.9")
    lost = summary["lost"]
    assert lost["forgotten"] > 0
    assert summary["created"] == summary["delivered"] + summary["held"] + sum(lost.values())


def test_a_new_setting_is_one_field(scratch: Scratch) -> None:
    scratch.insert(
        "core/settings.py",
        "    receipt_steps: Count = 3\n",
        '    patience_steps: Count = 3\n    """How long a node waits."""\n',
    )
    (scratch.place / "node.yaml").write_text(
        "node: {id: 1}\nlinks: [{multicast: '239.0.0.1:14601'}]\ncustody: {patience_steps: 4}\n", encoding="utf-8"
    )
    scratch.run("check", "node.yaml")
    swarm = ("swarm", "--nodes", "4", "--steps", "2")
    scratch.json(*swarm, "--set", "custody.patience_steps=5")
    [problem] = scratch.json(*swarm, "--set", "custody.patience_steps=0", code=2)["error"]
    assert "custody.patience_steps: expected" in problem


def test_a_new_command_is_one_module_and_one_row(scratch: Scratch) -> None:
    scratch.add(
        "commands/greet.py",
        """
from .common import add_command, print_json

def register(subparsers):
    add_command(subparsers, "greet", _greet, help="say hello", example="rass-mav greet")

def _greet(options):
    print_json({"hello": True}) if options.json else print("hello")
    return 0
""",
    )
    scratch.insert("cli.py", '    "service": "commands.service",\n', '    "greet": "commands.greet",\n')
    assert scratch.json("greet") == {"hello": True}
    assert "say hello" in scratch.run("--help")


def test_a_new_message_is_a_class_a_layout_and_a_handler(scratch: Scratch) -> None:
    """Its number is in the second byte: those of four bits are all in use."""
    root = PACKAGE.parent
    shutil.copytree(root / "tools", scratch.place / "tools", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(root / "docs", scratch.place / "docs")
    shutil.copy(root / "pyproject.toml", scratch.place)
    scratch.insert(
        "core/messages.py",
        "Message: TypeAlias = (\n",
        '@_kind(Target.NAMED, Urgency.ANSWER, _on_nothing)\nclass Nudge(NamedTuple):\n    """Asks for a beacon."""\n\n'
        "    sender: int\n    target: int\n    turns: int\n\n\n",
    )
    scratch.insert("core/messages.py", "    | SequenceMark", "    | Nudge\n")
    scratch.insert("core/node.py", "    messages.SequenceMark: Node", "    messages.Nudge: Node._ignore,\n")
    number = max(MORE, *(layout.number for layout in MESSAGES)) + 1
    row = f'    Layout({number}, core.Nudge, (*TO, Field("turns", "u16"))),\n'
    scratch.insert("../tools/wire_table.py", "    Layout(14, ", row)
    scratch.insert("../docs/reference/protocol.md", "### 14 ", "<!-- layout: Nudge -->\n<!-- end of layout -->\n\n")
    scratch.python("-m", "tools.generate_wire")
    code = (
        "from rass_mav.core.messages import Nudge; from rass_mav.wire import codec; m = Nudge(2, 3, 40); "
        "[p] = codec.encode(m, 0.0); print(p.hex(), codec.target_of(p), codec.decode(p, 0.0) == m)"
    )
    assert scratch.python("-c", code).split() == [f"4f{number:02x}020003002800", "3", "True"]
    assert scratch.json("swarm", "--nodes", "4", "--steps", "5")["frames"]["malformed"] == 0

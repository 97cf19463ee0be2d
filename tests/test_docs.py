"""The documents tell the truth: links lead somewhere, commands exist, examples are what the program prints."""

from __future__ import annotations

import argparse
import ast
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
import yaml

from rass_mav.app.config import load_config
from rass_mav.cli import build_parser
from rass_mav.core.alarms import Alarm
from rass_mav.core.custody.holdings import CHANGES, State
from rass_mav.policy.settings import kinds as policies
from rass_mav.store.repairs import OpenReport
from tests.patience import PATIENCE_S

ROOT = Path(__file__).parents[1]
PAGES = sorted(
    path
    for path in ROOT.rglob("*.md")
    if not any(part.startswith(".") or part in ("build", "dist") for part in path.relative_to(ROOT).parts)
)
README = (ROOT / "README.md").read_text(encoding="utf-8")
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.M | re.S)


def name(path: Path) -> str:
    return str(path.relative_to(ROOT))


def without_code(text: str) -> str:
    """Headings and links are looked for in prose only."""
    return re.sub(r"^(    .*\n)+", "", FENCE.sub("", text), flags=re.M)


def anchors(path: Path) -> set[str]:
    """Names that the forges give to a page's headings."""
    found: list[str] = []
    for heading in re.findall(r"^#+ (.*)$", without_code(path.read_text(encoding="utf-8")), re.M):
        found.append(re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-"))
    return {slug if not (before := found[:at].count(slug)) else f"{slug}-{before}" for at, slug in enumerate(found)}


def links(path: Path) -> list[str]:
    text = re.sub(r"`[^`\n]*`", "", without_code(path.read_text(encoding="utf-8")))
    return [link for link in re.findall(r"\]\(([^)\s]+)\)", text) if not re.match(r"https?://", link)]


def commands(path: Path) -> Iterator[str]:
    """Whole command lines of ours: in blocks of code, up to two blanks or `>`."""
    text = path.read_text(encoding="utf-8")
    blocks = [code for language, code in FENCE.findall(text) if language in ("", "sh")]
    blocks += re.findall(r"^(?:    .*\n)+", FENCE.sub("", text), re.M)
    for line in "\n".join(blocks).splitlines():
        found = re.match(r"(?:sudo (?:-u \S+ )?)?(?:\S*/)?rass-mav (.*)", line.strip())
        if found:
            yield re.split(r"  +|\s[#>]", found[1])[0]


ALL_LINKS = [(page, link) for page in PAGES for link in links(page)]
ALL_COMMANDS = [(page, command) for page in PAGES for command in commands(page)]


def test_there_is_something_to_look_at() -> None:
    assert {"README.md", "CHANGELOG.md"} <= {name(page) for page in PAGES}
    assert len(ALL_LINKS) > 20
    assert len(ALL_COMMANDS) > 10


@pytest.mark.parametrize(
    ("page", "link"), ALL_LINKS, ids=lambda value: name(value) if isinstance(value, Path) else value
)
def test_links_lead_somewhere(page: Path, link: str) -> None:
    file, _, anchor = link.partition("#")
    target = (page.parent / file).resolve() if file else page
    assert target.is_relative_to(ROOT)
    assert target.exists()
    if anchor:
        assert anchor in anchors(target)


#: Where a page is named without a link: comments of the program, the list of changes, examples.
_NAMED = re.compile(r"(?<![\w/])docs/((?:[\w-]+/)?[\w-]+\.md)(?:#([\w-]+))?")
#: How a message of the program names a page. A wheel has no docs/, so messages name no file there.
_IN_MESSAGES = re.compile(r"documentation: ([a-z-]+/[\w-]+)")
SOURCES = sorted(
    path
    for folder in ("rass_mav", "docs/examples", "firmware_params", "tools", "benchmarks", "sitl")
    for path in (ROOT / folder).rglob("*")
    if path.suffix in (".py", ".yaml", ".lua", ".md", ".parm", ".params")
)


def test_pages_that_are_named_exist_with_their_headings() -> None:
    missing = []
    for path in [*SOURCES, ROOT / "CHANGELOG.md", ROOT / "Makefile", ROOT / "pyproject.toml"]:
        for page, anchor in _NAMED.findall(path.read_text(encoding="utf-8")):
            target = ROOT / "docs" / page
            if not target.exists() or (anchor and anchor not in anchors(target)):
                missing.append(f"{name(path)}: docs/{page}#{anchor}")
    assert missing == []


def test_programs_that_import_from_the_checkout_are_run_as_modules() -> None:
    """As files they would not find each other."""
    run = re.compile(r"python3? (?:tools|tests|benchmarks)/\S+\.py")
    assert [(name(path), line) for path in [*SOURCES, *PAGES] for line in run.findall(path.read_text("utf-8"))] == []


def test_the_guide_names_files_by_their_path() -> None:
    text = (ROOT / "docs" / "contribute" / "guide.md").read_text(encoding="utf-8")
    paths = [path for path in re.findall(r"`([\w.-]+/[\w./-]+\.\w+)`", text) if "NAME" not in path]
    assert [path for path in paths if not ((ROOT / path).exists() or (ROOT / "rass_mav" / path).exists())] == []
    assert len(paths) > 40


def parsed(*words: str) -> Iterator[tuple[Path, ast.Module]]:
    """The modules in which one of the words stands; to parse all takes seconds."""
    for path in sorted((ROOT / "rass_mav").rglob("*.py")):
        source = path.read_text(encoding="utf-8")
        if any(word in source for word in words):
            yield path, ast.parse(source)


def messages(*words: str) -> Iterator[tuple[str, str]]:
    """The strings of the modules in which one of the words stands, with the modules; without docstrings."""
    for path, tree in parsed(*words):
        docstrings = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        for node in ast.walk(tree):
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings:
                yield name(path), node.value


def test_messages_name_pages_by_their_place_in_the_documentation() -> None:
    said = messages("documentation: ")
    named = [(where, page) for where, text in said for page in _IN_MESSAGES.findall(text)]
    assert len(named) > 10
    assert [each for each in named if not (ROOT / "docs" / f"{each[1]}.md").exists()] == []
    assert [each for each in messages("docs/") if re.search(r"\bdocs/.*\.md", each[1])] == []


@cache
def parser() -> argparse.ArgumentParser:
    """It is the same for all commands, and takes longer to build than to use."""
    return build_parser()


@pytest.mark.parametrize(
    ("page", "command"), ALL_COMMANDS, ids=lambda value: name(value) if isinstance(value, Path) else value
)
def test_commands_are_understood(page: Path, command: str) -> None:
    try:
        parser().parse_args(shlex.split(command))
        code: object = 0
    except SystemExit as end:
        # --help and --version end with 0, a line that is not understood with 2.
        code = end.code
    assert code == 0


def subcommands() -> set[str]:
    (action,) = (a for a in parser()._actions if isinstance(a, argparse._SubParsersAction))
    return set(action.choices)


def test_the_readme_shows_every_command_and_no_other() -> None:
    assert set(re.findall(r"^\| `rass-mav ([\w-]+)", README, re.M)) == subcommands()


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_commands_named_in_prose_exist(page: Path) -> None:
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    assert set(re.findall(r"`rass-mav ([a-z][a-z-]*)", text)) <= subcommands()


def test_the_index_names_every_page() -> None:
    index = ROOT / "docs" / "README.md"
    named = {(index.parent / link).resolve() for link in links(index)}
    assert set((ROOT / "docs").rglob("*.md")) - {index} <= named


def test_the_first_two_blocks_are_the_demo_and_the_tests() -> None:
    blocks = [code for language, code in FENCE.findall(README) if language == "sh"]
    assert blocks[:2] == ["make demo\n", "make test\n"]
    targets = re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M)
    assert {block.split()[1] for block in blocks[:2]} <= set(targets)


def test_the_readmes_configurations_are_valid(tmp_path: Path) -> None:
    blocks = [code for language, code in FENCE.findall(README) if language == "yaml"]
    roles = []
    for code in blocks:
        file = tmp_path / "node.yaml"
        file.write_text(code, encoding="utf-8")
        roles.append(load_config(str(file)).node.role)
    assert roles == ["drone", "base"]


#: The demo takes as long as hundreds of tests. `.ci/run` has just run it, and says where its lines are; otherwise it is
#: for a soak.
WITH_THE_DEMO: list[pytest.MarkDecorator] = [] if "RASS_DEMO" in os.environ else [pytest.mark.soak]


def printed_by_the_demo() -> list[str]:
    if file := os.environ.get("RASS_DEMO"):
        return Path(file).read_text(encoding="utf-8").splitlines()
    command = [sys.executable, "-m", "rass_mav", "swarm"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True, timeout=PATIENCE_S)
    return done.stdout.splitlines()


@pytest.mark.parametrize("page", [pytest.param(README, id="README", marks=WITH_THE_DEMO)])
def test_the_readme_shows_what_the_demo_prints(page: str) -> None:
    (shown,) = (code.splitlines() for language, code in FENCE.findall(page) if language == "text")
    # `make` may have said something before. The last line tells how long it took.
    assert shown[:-1] == printed_by_the_demo()[-len(shown) : -1]


def locked(file: str) -> dict[str, str]:
    """What a lock file pins: by the package's name its version, for whom it is, and its checksums."""
    text = re.sub(r"^ *#.*\n", "", (ROOT / file).read_text(encoding="utf-8"), flags=re.M)
    return {pin.split("==")[0].lower().replace("_", "-"): pin for pin in re.split(r"\n(?=\S)", text.rstrip())}


def wanted(part: str) -> set[str]:
    """Names of the packages that pyproject.toml demands below a heading or in a list."""
    return {name.lower() for name in re.findall(r'"([A-Za-z][\w.-]*)[^"\n]*"', part)} - {"rass-mav"}


def test_the_lock_files_fit_the_project_and_name_no_index() -> None:
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    (dependencies,) = re.findall(r"^dependencies = (\[\n.*?^\])", project, re.M | re.S)
    (extras,) = re.findall(r"^\[project.optional-dependencies\]\n(.*?)^\[", project, re.M | re.S)
    (demo,) = re.findall(r"^demo = (.*\n)", project, re.M)
    assert {"pymavlink", "pyyaml"} <= wanted(dependencies)
    assert {"pyserial", "ruff", "setuptools", "mavsdk"} <= wanted(extras)
    assert wanted(demo) == {"tqdm", "setuptools"}
    everything, small = locked("requirements.lock"), locked("requirements-demo.lock")
    assert wanted(dependencies) | wanted(extras) <= set(everything) | set(locked("requirements-interop.lock"))
    assert wanted(dependencies) | wanted(demo) <= set(small)
    # What the demo was shown with is what the tests are run with.
    assert small.items() <= everything.items()
    for pin in [*everything.values(), *small.values()]:
        assert "--hash=sha256:" in pin
        assert not re.search(r"://|--(extra-)?index-url|--find-links", pin)


def test_the_citation_names_this_version_and_the_paper() -> None:
    """It was checked once against the schema of version 1.2.0 (package cffconvert 2.0.0)."""
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    for key in ("version", "license"):
        assert f'\n{key} = "{citation[key]}"\n' in project
    assert {"cff-version", "message", "title", "authors"} <= citation.keys()
    (paper,) = citation["references"]
    assert {"type", "title", "authors"} <= paper.keys()
    assert [author["family-names"] for author in paper["authors"]] == ["Arseneault", "Vielfaure", "Beltrame"]


def test_scenarios_and_examples_are_yaml_that_people_can_read() -> None:
    for path in [*ROOT.glob("sitl/*.yaml"), *ROOT.glob("docs/examples/*.yaml")]:
        text = path.read_text(encoding="utf-8")
        assert isinstance(yaml.safe_load(text), dict)
        assert text.startswith("# ")


#: How figures of speed, start and memory are headed.
SPEED = re.compile(r"(robot-steps?|hand-overs?) (a|per) second|start of a node, ms|memory of (the|a) node|\bRSS\b")


@pytest.mark.parametrize("page", [page for page in PAGES if page.name != "performance.md"], ids=name)
def test_one_page_alone_has_figures_of_speed(page: Path) -> None:
    """Others link to docs/evaluation/performance.md, so that one fact has one figure. What the demo printed is in a
    block."""
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    assert [line for line in text.splitlines() if SPEED.search(line)] == []


def test_the_page_has_a_row_for_every_policy() -> None:
    page = (ROOT / "docs" / "explanation" / "policies.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `([\w-]+)` \| (\d+) \|", page, re.M)
    assert {name: int(number) for name, number in rows} == {kind.name: kind.number for kind in policies().values()}


def states_of_a_copy() -> str:
    """What docs/contribute/architecture.md shows of `CHANGES`: a picture and a table."""
    declared = [f'    state "{state.value}" as {state.name}' for state in State]
    arrows = [" --> ".join("[*]" if state is None else state.name for state in change) for change in CHANGES]
    words = [" | ".join("no copy" if state is None else state.value for state in change) for change in CHANGES]
    rows = [f"| {change} | {cause} |" for change, cause in zip(words, CHANGES.values(), strict=True)]
    picture = ["```mermaid", "stateDiagram-v2", *declared, *(f"    {arrow}" for arrow in arrows), "```"]
    return "\n".join([*picture, "", "| from | to | by |", "|---|---|---|", *rows, "", ""])


def test_the_page_draws_the_states_of_a_copy_as_the_code_has_them() -> None:
    page = (ROOT / "docs" / "contribute" / "architecture.md").read_text(encoding="utf-8")
    wanted = states_of_a_copy()
    assert wanted in page, f"docs/contribute/architecture.md should have:\n\n{wanted}"


def said_to_the_ground() -> Iterator[str]:
    """Texts of the code that begin with `RASS: `, as regular expressions without that. A text that consists of another
    one is left out."""
    for _, tree in parsed("RASS: "):
        texts = [node.values for node in ast.walk(tree) if isinstance(node, ast.JoinedStr)]
        pieces = {id(piece) for values in texts for piece in values}
        texts += [[node] for node in ast.walk(tree) if isinstance(node, ast.Constant) and id(node) not in pieces]
        for parts in texts:
            words = [str(part.value) if isinstance(part, ast.Constant) else None for part in parts]
            text = "".join(word for word in words if word is not None)
            if text.startswith("RASS: ") and re.search(r"[a-z]", text):
                pattern = "".join(".+" if word is None else re.escape(word) for word in words)
                yield pattern.removeprefix(re.escape("RASS: "))


def test_every_text_at_the_ground_station_has_its_row() -> None:
    page = (ROOT / "docs" / "how-to" / "troubleshooting.md").read_text(encoding="utf-8")
    section = page.partition("\n## Texts at the ground station\n")[2].partition("\n## ")[0]
    rows = [text for cell in re.findall(r"^\| (`.*?) \| ", section, re.M) for text in re.findall(r"`([^`]+)`", cell)]
    texts = list(said_to_the_ground())
    assert len(texts) > 15
    assert [text for text in texts if not any(re.fullmatch(text, row) for row in rows)] == []
    assert {alarm.value for alarm in Alarm} <= set(rows)
    found = OpenReport(
        set_aside=Path("rass-7.db.damaged-1"), closed=((1, 2),), salvaged=40, lost=3,
        dropped=("row 4 of table datum",), unwritable="read-only file system",
    )  # fmt: skip
    assert {*found.remarks, *OpenReport(salvaged=40).remarks} <= set(rows)

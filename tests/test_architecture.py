"""The rules of docs/contribute/architecture.md: who may import whom, and who knows what."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from pathlib import Path

import pytest

from rass_mav.agent.commits import CommitGate
from rass_mav.core.messages import KINDS
from rass_mav.lab.swarm.virtual import VirtualSwarm

from .core import test_custody_machine

PACKAGE = Path(__file__).parents[1] / "rass_mav"
FILES = sorted(PACKAGE.rglob("*.py"))

#: What each room may import of the others, beside `errors`, which all may. `cli.py` may import everything.
MAY_IMPORT: dict[str, set[str]] = {"config": set(), "core": {"config"}}
for _room in ("policy", "wire", "mavlink", "link", "store", "sensor"):
    MAY_IMPORT[_room] = {"config", "core"}
MAY_IMPORT["sensor"] |= {"link"}
MAY_IMPORT["params"] = {"core", "mavlink", "link"}
_BELOW = {"config", "core", "policy", "wire", "mavlink", "link", "store", "sensor"}
MAY_IMPORT["agent"] = _BELOW
MAY_IMPORT["station"] = _BELOW | {"agent"}
#: Keys are behind the agent's seam: only what creates a node with keys knows them.
MAY_IMPORT["trust"] = {"config", "core", "mavlink", "wire", "agent"}
MAY_IMPORT["app"] = _BELOW | {"agent", "station", "trust"}
MAY_IMPORT["doctor"] = MAY_IMPORT["app"] | {"app", "params"}
MAY_IMPORT["commands"] = set(MAY_IMPORT)
#: The two wings that no drone needs: what flies imports neither. Each has commands of its own.
MAY_IMPORT["ground"] = MAY_IMPORT["app"] | {"app", "commands"}
MAY_IMPORT["lab"] = MAY_IMPORT["ground"] | {"ground"}

#: The same inside core, for its modules and its sub-rooms. The ground floor is what all of core may import.
GROUND_FLOOR = {
    "alarms", "datum", "exchange", "messages", "observer", "pace", "risk", "seals", "shares", "store",
}  # fmt: skip
IN_CORE: dict[str, set[str]] = {part: set() for part in GROUND_FLOOR}
IN_CORE["routes"] = {"settings"}
IN_CORE["gossip"] = set()
IN_CORE["policy"] = {"routes"}
IN_CORE["news"] = {"routes", "gossip"}
IN_CORE["settings"] = {"policy"}
IN_CORE["custody"] = {"settings", "policy", "routes", "news", "gossip"}
IN_CORE["replicas"] = IN_CORE["participant"] = IN_CORE["custody"] | {"custody"}
IN_CORE["stigmergy"] = IN_CORE["participant"] | {"participant"}
IN_CORE["node"] = IN_CORE["stigmergy"] | {"replicas"}

#: The same inside the lab, for its rooms, and for the ledger, which the simulated disks and all swarms keep.
IN_LAB: dict[str, set[str]] = {room: set() for room in ("ledger", "medium", "baselines")}
IN_LAB["hostile"] = {"medium"}
IN_LAB["disk"] = {"ledger"}
IN_LAB["swarm"] = {"ledger", "medium", "hostile", "disk"}
IN_LAB["fleet"] = {"ledger", "medium", "swarm"}
IN_LAB["sitl"] = {"medium", "swarm", "fleet"}
IN_LAB["replay"] = {"medium", "swarm"}
IN_LAB["experiment"] = {"ledger", "medium", "hostile", "swarm", "baselines"}
IN_LAB["commands"] = set(IN_LAB)

#: What core may import of the standard library: nothing that knows a clock, a file, a thread or the environment.
PURE = {
    "__future__", "abc", "array", "bisect", "collections", "collections.abc", "dataclasses", "enum", "functools",
    "heapq", "itertools", "math", "operator", "random", "struct", "typing", "zlib",
}  # fmt: skip


def module(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module(path): path for path in FILES}


def imported(node: ast.AST, path: Path) -> Iterator[str]:
    """What a statement imports, by full name: modules of ours as such, else what it names behind `import` or `from`."""
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        package = path.relative_to(PACKAGE.parent).parts[: -node.level] if node.level else ()
        origin = ".".join([*package, *([node.module] if node.module else [])])
        for alias in node.names:
            inner = f"{origin}.{alias.name}"
            yield inner if inner in MODULES or origin == "rass_mav" else origin


def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def statements(path: Path) -> list[ast.Import | ast.ImportFrom]:
    """All imports of a file, wherever in it. They stand among statements only: what is inside these is left out."""
    found: list[ast.Import | ast.ImportFrom] = []
    blocks: list[ast.AST] = [parsed(path)]
    while blocks:
        block = blocks.pop()
        if isinstance(block, ast.Import | ast.ImportFrom):
            found.append(block)
        for field in ("body", "orelse", "finalbody", "handlers", "cases"):
            inner = getattr(block, field, ())
            blocks += inner if isinstance(inner, list) else ()
    return found


@cache
def imports(path: Path) -> frozenset[str]:
    """All modules that a file imports, by full name, wherever in it."""
    return frozenset(name for node in statements(path) for name in imported(node, path))


@cache
def named(path: Path) -> frozenset[str]:
    """What a file has of other modules, by full name."""
    nodes = [node for node in statements(path) if isinstance(node, ast.ImportFrom)]
    return frozenset(
        f"{origin}.{alias.name}" for node in nodes for origin in imported(node, path) for alias in node.names
    )


def outside_functions(tree: ast.AST) -> Iterator[ast.AST]:
    for node in ast.iter_child_nodes(tree):
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            yield node
            yield from outside_functions(node)


def circle(edges: dict[str, set[str]]) -> list[str]:
    """Some circle, from a node back to itself; empty: there is none."""
    done: set[str] = set()

    def look(node: str, way: list[str]) -> list[str]:
        if node in way:
            return [*way[way.index(node) :], node]
        found: list[str] = []
        if node not in done:
            for other in sorted(edges.get(node, ())):
                found = found or look(other, [*way, node])
            done.add(node)
        return found

    for node in sorted(edges):
        if found := look(node, []):
            return found
    return []


def room(path: Path) -> str | None:
    parts = path.relative_to(PACKAGE).parts
    return parts[0] if len(parts) > 1 else None


def name(path: Path) -> str:
    return str(path.relative_to(PACKAGE))


CORE = [path for path in FILES if room(path) == "core"]


def found_in(files: Iterable[Path], search: Callable[[Path], object]) -> dict[str, object]:
    """What a search found in each file, by the file's name; without those in which it found nothing."""
    return {name(path): found for path in files if (found := search(path))}


def test_every_room_is_in_the_rules() -> None:
    assert {r for r in map(room, FILES) if r} <= MAY_IMPORT.keys()


def test_arrows_point_one_way() -> None:
    def wrong(path: Path) -> set[str]:
        own = room(path)
        assert own is not None
        others = {m.split(".")[1] for m in imports(path) if m.startswith("rass_mav.")}
        return others - {own, "__version__", "errors"} - MAY_IMPORT[own]

    assert found_in(filter(room, FILES), wrong) == {}


PAGE = (PACKAGE.parent / "docs" / "contribute" / "architecture.md").read_text(encoding="utf-8")


def test_the_page_says_who_may_import_whom() -> None:
    rooms = re.findall(r"^\| `([a-z]+)/` \|.*\| ([^|]*) \|$", PAGE, re.M)
    said: dict[str, set[str]] = {}
    for own, cell in rooms:
        named = set(re.findall(r"`([a-z]+)`", cell))
        said[own] = said.keys() - named if cell.startswith("all above") else named
    assert said == MAY_IMPORT


def test_the_page_draws_what_is_below_what_in_core() -> None:
    [picture] = re.findall(r"## Inside core\n\n```text\n(.*?)```", PAGE, re.S)
    lines = [words for line in picture.splitlines() if (words := re.findall(r"[a-z]+", line))]
    height = {part: -at for at, line in enumerate(lines) for part in line}
    assert height.keys() == IN_CORE.keys()
    upwards = [(part, other) for part in IN_CORE for other in IN_CORE[part] if height[other] >= height[part]]
    assert upwards == [("routes", "settings")]
    assert set(lines[-1]) == GROUND_FLOOR


def test_the_search_for_circles_finds_them() -> None:
    assert circle({"a": {"b", "c"}, "b": {"c"}, "c": set()}) == []
    assert circle({"a": {"b"}, "b": {"c"}, "c": {"d"}, "d": {"b"}}) == ["b", "c", "d", "b"]
    assert circle({"a": {"a"}}) == ["a", "a"]


def test_no_circle_of_imports() -> None:
    """Those for type checkers and those inside functions count too."""
    assert circle({module(path): set(imports(path)) for path in FILES}) == []


@pytest.mark.parametrize(("own", "rules", "below"), [("core", IN_CORE, GROUND_FLOOR), ("lab", IN_LAB, set())])
def test_arrows_inside_a_room_point_one_way(own: str, rules: dict[str, set[str]], below: set[str]) -> None:
    files = [path for path in FILES if room(path) == own and path != PACKAGE / own / "__init__.py"]

    def part(path: Path) -> str:
        return path.relative_to(PACKAGE / own).with_suffix("").parts[0]

    def wrong(path: Path) -> set[str]:
        others = {m.split(".")[2] for m in imports(path) if m.startswith(f"rass_mav.{own}.")}
        return others - {part(path)} - rules[part(path)] - below

    assert {part(path) for path in files} == rules.keys()
    assert found_in(files, wrong) == {}
    # Settings of the core know policies, which look at neighbours; so the room `routes` lies on both sides of them.
    assert circle({part: others - {"settings"} for part, others in rules.items()}) == []


def test_nobody_in_core_below_the_node_knows_it() -> None:
    """In code; prose may tell of it."""

    def mentions(path: Path) -> list[int]:
        """The lines that name it."""
        tree = parsed(path)
        prose = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        lines = []
        for node in ast.walk(tree):
            named = [getattr(node, key, None) for key in ("id", "attr", "name", "asname")]
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in prose:
                named += re.findall(r"\w+", node.value)
            if "Node" in named:
                lines.append(node.lineno)  # type: ignore[attr-defined]
        return lines

    assert found_in((path for path in CORE if path.name != "node.py"), mentions) == {}


@pytest.mark.parametrize(
    ("package", "own"), [("pymavlink", "mavlink"), ("aiohttp", "ground"), ("nacl", "trust"), ("numpy", "ground")]
)
def test_a_package_is_imported_in_one_room_only(package: str, own: str) -> None:
    def users(path: Path) -> list[str]:
        return [m for m in imports(path) if m.split(".")[0] == package]

    assert {room(PACKAGE / file) for file in found_in(FILES, users)} == {own}


def test_mavutil_is_never_imported() -> None:
    assert found_in(FILES, lambda path: [m for m in imports(path) if "mavutil" in m]) == {}


def test_keys_are_drawn_and_files_of_keys_touched_in_one_place_each() -> None:
    """All else that is about them is pure: no clock, no chance, no file."""
    about = [path for path in FILES if "trust/keys" in path.as_posix()]
    pure = {path.name: imports(path) for path in about if path.stem not in ("files", "folder")}
    world = {"os", "io", "pathlib", "time", "datetime", "random", "secrets", "socket", "subprocess", "threading"}
    assert {file: found & world for file, found in pure.items() if found & world} == {}
    drawing = {name(path) for path in about if "secrets" in imports(path)}
    assert drawing == {"trust/keys/folder.py"}


def called(call: ast.Call) -> str | None:
    """The name of what is called, without what it belongs to."""
    match call.func:
        case ast.Name(id=name) | ast.Attribute(attr=name):
            return name
    return None


def impure(path: Path) -> set[str]:
    """What a file has of the world outside. `Random` is for types: the generator itself is passed in."""
    found = {m for m in imports(path) if not m.startswith("rass_mav")} - PURE
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.ImportFrom) and node.module == "random":
            found |= {f"random.{alias.name}" for alias in node.names} - {"random.Random"}
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "random":
            found |= {f"random.{node.attr}"} - {"random.Random"}
        match node:
            case ast.Call(func=ast.Name(id="open" | "input" | "print" | "__import__" as function)):
                found.add(f"{function}()")
            case ast.Call() if called(node) == "Random":
                found.add("Random()")
    return found


def test_core_is_pure() -> None:
    assert found_in(CORE, impure) == {}


def test_what_a_message_rests_on_is_said_in_core_and_asked_in_one_place() -> None:
    """`KINDS` says it, `agent/outgoing.py` makes frames that know whether to wait, and the gate alone asks them."""
    made, asked = set(), set()
    for path in FILES:
        # To parse all takes a second.
        source = path.read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(source)) if "Outgoing(" in source or ".promises" in source else ():
            if isinstance(node, ast.Call) and called(node) == "Outgoing":
                made.add(name(path))
            if isinstance(node, ast.Attribute) and node.attr == "promises":
                asked.add(name(path))
    assert (made, asked) == ({"agent/outgoing.py"}, {"agent/commits.py"})
    about = {name(path) for path in FILES if "rass_mav.core.messages.KINDS" in named(path)}
    assert about == {"agent/outgoing.py"}


def test_who_carries_messages_does_not_ask_of_which_kind_they_are() -> None:
    """But for the beacon: whoever says one is a neighbour."""
    kinds = {f"rass_mav.core.messages.{kind.__name__}" for kind in KINDS} - {"rass_mav.core.messages.Beacon"}
    carriers = [path for path in FILES if room(path) in ("agent", "trust", "station", "app", "link", "store")]
    assert found_in(carriers, lambda path: named(path) & kinds) == {}


def test_the_driver_the_mock_swarm_and_the_custody_machine_have_the_same_gate() -> None:
    assert VirtualSwarm.make_gate is test_custody_machine.Swarm.make_gate is CommitGate
    gates = {room(path) for path in FILES if "rass_mav.agent.commits.CommitGate" in named(path)}
    assert gates == {"app", "lab"}

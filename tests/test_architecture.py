"""The import rules of docs/architecture.md, and a bound on how much a class may hold."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "rass_mav"
FILES = sorted(PACKAGE.rglob("*.py"))

#: What each room may import of the others, beside `errors`, which all may. `cli.py` may import everything.
MAY_IMPORT: dict[str, set[str]] = {"config": set(), "core": {"config"}}
for _room in ("policy", "wire", "mavlink", "link", "store", "sensor"):
    MAY_IMPORT[_room] = {"config", "core"}
MAY_IMPORT["params"] = {"core", "mavlink", "link"}
MAY_IMPORT["agent"] = {"config", "core", "policy", "wire", "mavlink", "link", "store", "sensor"}
MAY_IMPORT["app"] = MAY_IMPORT["base"] = MAY_IMPORT["agent"] | {"agent"}
MAY_IMPORT["doctor"] = MAY_IMPORT["app"] | {"app", "params"}
MAY_IMPORT["swarm"] = MAY_IMPORT["app"] | {"app"}
MAY_IMPORT["replay"] = MAY_IMPORT["experiment"] = MAY_IMPORT["swarm"] | {"swarm"}
MAY_IMPORT["commands"] = set(MAY_IMPORT) - {"commands"}

#: What core may import of the standard library: nothing that knows a clock, a file, a thread or the environment.
PURE = {
    "__future__", "abc", "bisect", "collections", "collections.abc", "dataclasses", "enum", "functools", "heapq",
    "itertools", "math", "operator", "random", "struct", "typing", "zlib",
}  # fmt: skip

#: Attributes of a class that does something. Data (`is_data`) have as many fields as they need.
MOST_ATTRIBUTES = 33
#: Whoever derives from these is data, and so is a frozen dataclass. A section is a part of a configuration file.
DATA_BASES = {"NamedTuple", "Struct", "TypedDict", "Section"}


def imports(path: Path) -> Iterator[str]:
    """All modules that a file imports, by full name, wherever in it."""
    inside = path.relative_to(PACKAGE.parent).with_suffix("").parts
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            if node.level:
                module = ".".join([*inside[: -node.level], *([node.module] if node.module else [])])
            else:
                assert node.module is not None
                module = node.module
            yield module
            yield from (f"{module}.{alias.name}" for alias in node.names if module == "rass_mav")


def room(path: Path) -> str | None:
    parts = path.relative_to(PACKAGE).parts
    return parts[0] if len(parts) > 1 else None


def name(path: Path) -> str:
    return str(path.relative_to(PACKAGE))


def test_every_room_is_in_the_rules() -> None:
    assert {r for r in map(room, FILES) if r} <= MAY_IMPORT.keys()


@pytest.mark.parametrize("path", [p for p in FILES if room(p)], ids=name)
def test_arrows_point_one_way(path: Path) -> None:
    own = room(path)
    assert own is not None
    others = {m.split(".")[1] for m in imports(path) if m.startswith("rass_mav.")} - {own, "__version__", "errors"}
    assert others <= MAY_IMPORT[own]


@pytest.mark.parametrize("path", FILES, ids=name)
def test_pymavlink_is_imported_in_its_room_only_and_never_mavutil(path: Path) -> None:
    pymavlink = [m for m in imports(path) if m.split(".")[0] == "pymavlink"]
    assert not pymavlink or room(path) == "mavlink"
    assert not [m for m in pymavlink if "mavutil" in m]


@pytest.mark.parametrize("path", [p for p in FILES if room(p) == "core"], ids=name)
def test_core_is_pure(path: Path) -> None:
    assert {m for m in imports(path) if not m.startswith("rass_mav")} <= PURE
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module == "random":
            assert [alias.name for alias in node.names] == ["Random"]
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "random":
            # As a type; the generator itself is passed in.
            assert node.attr == "Random"
        if isinstance(node, ast.Call):
            assert ast.unparse(node.func) not in ("random.Random", "Random", "open", "input", "print", "__import__")


def is_data(cls: ast.ClassDef) -> bool:
    """Whether a class only holds fields for others: settings, messages, reports."""
    frozen = any("dataclass" in ast.unparse(d) and "frozen=True" in ast.unparse(d) for d in cls.decorator_list)
    return frozen or any(ast.unparse(base).split(".")[-1] in DATA_BASES for base in cls.bases)


def attributes(cls: ast.ClassDef) -> set[str]:
    """What an instance has of its own: its slots, the fields that its class annotates, what its methods assign."""
    found = set()
    for statement in cls.body:
        if isinstance(statement, ast.AnnAssign):
            found.add(ast.unparse(statement.target))
        elif isinstance(statement, ast.Assign) and ast.unparse(statement.targets[0]) == "__slots__":
            found |= set(ast.literal_eval(statement.value))
    for node in ast.walk(cls):
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store) and ast.unparse(node.value) == "self":
            found.add(node.attr)
    return found


def test_what_counts_as_an_attribute() -> None:
    code = """
class Node:
    __slots__ = ("a",)
    b: int = 0
    CONSTANT = 1
    def step(self):
        self.c, self.d[0] = self.e = 1, 2
        self.f += 1
        self.g: int = 3
        other.h = self.i
"""
    (cls,) = ast.parse(code).body
    assert isinstance(cls, ast.ClassDef)
    assert attributes(cls) == set("abcefg")


@pytest.mark.parametrize("path", FILES, ids=name)
def test_no_class_has_too_many_attributes(path: Path) -> None:
    classes = [node for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(node, ast.ClassDef)]
    counted = {cls.name: len(attributes(cls)) for cls in classes if not is_data(cls)}
    assert {name: count for name, count in counted.items() if count > MOST_ATTRIBUTES} == {}

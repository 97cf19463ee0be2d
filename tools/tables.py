"""The mutable tables and the constants of one node, by mechanism: what a reader has to keep in the head.

    python -m tools.tables               a line for each module, and the sums
    python -m tools.tables --list        every table
    python -m tools.tables --constants   every constant by its class, with what the code says of it

A table is an attribute of an object that holds a dictionary, list, set, deque or counter, as its class creates it: one
for each attribute, however many objects of the class there are, and one for each element of a tuple of them. Caches of
functions (`lru_cache`) are tables too.

A constant is a number with a name of its own at the top of a module of core, trust or agent. Its class is:

- bound, if it is named `MAX_...` or its comment begins with `Bound:`. It protects memory, airtime or the processor;
- fact, if its comment begins with `Fact:`. It follows from the wire, an RFC, the world or how numbers are rounded;
- derived, if it is computed from another constant;
- tuned otherwise: a wait, a gain or a threshold that was chosen. `tools/sensitivity.py` shows what it is worth.
"""

from __future__ import annotations

import argparse
import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

PACKAGE = Path(__file__).resolve().parent.parent / "rass_mav"
#: The rooms of one node without input and output.
ROOMS = ("core", "trust", "agent", "station")
_TYPES = {"dict", "list", "set", "deque", "Counter", "OrderedDict", "defaultdict", "bytearray"}
_CACHES = {"lru_cache", "cache"}


#: Modules whose numbers follow from the wire, the world or the machine: there is nothing to choose.
FACTS = (
    "core/datum", "core/messages", "core/news/layouts", "core/news/statements", "core/policy", "core/routes/costs",
    "core/seals", "core/settings", "trust/beaconkeys", "trust/chains", "trust/keys/", "trust/seals",
)  # fmt: skip
_BOUND = "MAX_"


class Table(NamedTuple):
    """One of them."""

    module: str
    """Its path in the package."""
    owner: str
    """Class, or function with a cache."""
    name: str


def _is_table(value: ast.expr | None, annotation: ast.expr | None = None) -> int:
    """How many tables an assignment creates: 0 or 1, or one for each element of a tuple."""
    match annotation:
        case ast.Subscript(value=ast.Name(id=name)) if name in _TYPES:
            return 1
        case ast.Name(id=name) if name in _TYPES:
            return 1
    match value:
        case ast.Dict() | ast.List() | ast.Set() | ast.DictComp() | ast.ListComp() | ast.SetComp():
            return 1
        case ast.Call(func=ast.Name(id=name)) if name in _TYPES:
            return 1
        case ast.Call(func=ast.Attribute(value=ast.Name(id=name), attr="fromkeys")) if name in _TYPES:
            return 1
        case ast.Tuple(elts=elements):
            return sum(_is_table(element) for element in elements)
    return 0


def _of_class(module: str, node: ast.ClassDef) -> Iterator[Table]:
    found: dict[str, int] = {}
    for inner in ast.walk(node):
        match inner:
            case ast.AnnAssign(
                target=ast.Attribute(value=ast.Name(id="self"), attr=name), annotation=kind, value=value
            ):
                found[name] = max(found.get(name, 0), _is_table(value, kind))
            case ast.Assign(targets=targets, value=value):
                for target in targets:
                    match target:
                        case ast.Attribute(value=ast.Name(id="self"), attr=name):
                            found[name] = max(found.get(name, 0), _is_table(value))
    for name, count in found.items():
        for _ in range(count):
            yield Table(module, node.name, name)


def _is_cached(node: ast.FunctionDef) -> bool:
    names = [inner.id for each in node.decorator_list for inner in ast.walk(each) if isinstance(inner, ast.Name)]
    return not _CACHES.isdisjoint(names)


def tables() -> list[Table]:
    """All tables of a node."""
    found: list[Table] = []
    for room in ROOMS:
        for file in sorted((PACKAGE / room).rglob("*.py")):
            module = str(file.relative_to(PACKAGE))
            for node in ast.walk(ast.parse(file.read_bytes())):
                if isinstance(node, ast.ClassDef):
                    found += _of_class(module, node)
                elif isinstance(node, ast.FunctionDef) and _is_cached(node):
                    found.append(Table(module, node.name, "cache"))
    return found


KINDS = ("tuned", "derived", "bound", "fact")


class Constant(NamedTuple):
    """A number with a name."""

    module: str
    name: str
    value: str
    """As the code has it."""
    about: str
    """Its comment, or that of the one before; empty: there is none."""

    @property
    def kind(self) -> str:
        """One of `KINDS`."""
        if self.name.startswith(_BOUND):
            return "bound"
        said = self.about.partition(":")[0].lower()
        if said in KINDS:
            return said
        return "derived" if re.search(r"\b_?[A-Z]{2}", self.value) else "tuned"

    @property
    def label(self) -> str:
        """Its whole name: `core.pace.FULL`."""
        return f"{self.module.replace('/', '.')}.{self.name}"


def _is_number(value: ast.expr | None) -> bool:
    if isinstance(value, ast.Name):
        return value.id.isupper()
    return isinstance(value, ast.Constant | ast.BinOp | ast.UnaryOp) and not any(
        isinstance(inner, ast.Constant) and isinstance(inner.value, str | bytes) for inner in ast.walk(value)
    )


def _about(lines: list[str], line: int) -> str:
    """The comment that ends before a line, counted from 1."""
    first = line - 1
    while lines[first - 1].startswith("#: "):
        first -= 1
    return " ".join(text[3:].strip() for text in lines[first : line - 1])


def constants() -> list[Constant]:
    """All constants of a node, but those of modules that only hold facts."""
    found: list[Constant] = []
    for file in (file for room in ("core", "trust", "agent") for file in sorted((PACKAGE / room).rglob("*.py"))):
        module = str(file.relative_to(PACKAGE).with_suffix(""))
        if module.startswith(FACTS):
            continue
        text, about = file.read_text(encoding="utf-8"), ""
        for node in ast.parse(text).body:
            match node:
                case ast.Assign(targets=[ast.Name(id=name)], value=value):
                    pairs = [(name, value)]
                case ast.Assign(targets=[ast.Tuple(elts=names)], value=ast.Tuple(elts=values)):
                    pairs = [(ast.unparse(name), value) for name, value in zip(names, values, strict=True)]
                case _:
                    continue
            about = _about(text.splitlines(), node.lineno) or about
            found += [
                Constant(module, name, ast.unparse(value), about)
                for name, value in pairs
                if name.isupper() and _is_number(value)
            ]
    return found


def _print_constants() -> None:
    found = constants()
    for kind in KINDS:
        of_kind = [constant for constant in found if constant.kind == kind]
        print(f"{kind:<44}{len(of_kind):>4}")
        for module in dict.fromkeys(constant.module for constant in of_kind):
            here = [constant for constant in of_kind if constant.module == module]
            print(f"  {module:<42}{len(here):>4}")
            for about in dict.fromkeys(constant.about for constant in here):
                those = [f"{constant.name} = {constant.value}" for constant in here if constant.about == about]
                print(f"      {', '.join(those)}: {about}")


def main() -> None:
    """Print them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--list", action="store_true", help="each table")
    parser.add_argument("--constants", action="store_true", help="the constants instead")
    options = parser.parse_args()
    if options.constants:
        _print_constants()
        return
    found = tables()
    for room in ROOMS:
        here = [table for table in found if table.module.startswith(room + "/")]
        print(f"{room:<44}{len(here):>4}")
        for module in sorted({table.module for table in here}):
            those = [table for table in here if table.module == module]
            print(f"  {module:<42}{len(those):>4}")
            if options.list:
                for table in those:
                    print(f"      {table.owner}.{table.name}")
    print(f"{'all':<44}{len(found):>4}")


if __name__ == "__main__":
    main()

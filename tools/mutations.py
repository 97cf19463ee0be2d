"""How many small faults the tests notice: changes one place of the package at a time, and runs the tests that know it.

    python -m tools.mutations --count 100 --seed 1           in a copy of this checkout
    python -m tools.mutations --count 100 --seed 1 --list    only what would be changed

The places are drawn with a fixed seed, from each room of the package in proportion to its size. A mutant is killed if a
test fails, or does not end. Those that survive are listed: read whether the change matters, and if it does, write the
test.
"""

from __future__ import annotations

import argparse
import ast
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parent.parent
_SWAPS: dict[type[ast.AST], str] = {
    ast.Lt: "<=", ast.LtE: "<", ast.Gt: ">=", ast.GtE: ">", ast.Eq: "!=", ast.NotEq: "==", ast.In: "not in",
    ast.NotIn: "in", ast.Is: "is not", ast.IsNot: "is", ast.Add: "-", ast.Sub: "+", ast.Mult: "//", ast.FloorDiv: "*",
    ast.And: "or", ast.Or: "and",
}  # fmt: skip


class Mutant(NamedTuple):
    """One changed place."""

    path: Path
    """Relative to the checkout."""
    line: int
    before: str
    after: str
    begin: int
    """Where it is in the file, bytes."""
    end: int


def _changed(node: ast.AST) -> tuple[ast.AST, str] | None:
    """What of a node is replaced, and by which code; None: nothing is."""
    match node:
        case ast.Compare(left=left, ops=[op], comparators=[right]):
            return node, f"{ast.unparse(left)} {_SWAPS[type(op)]} {ast.unparse(right)}"
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _SWAPS:
            return node, f"({ast.unparse(left)} {_SWAPS[type(op)]} {ast.unparse(right)})"
        case ast.BoolOp(op=op, values=values):
            return node, "(" + f" {_SWAPS[type(op)]} ".join(map(ast.unparse, values)) + ")"
        case ast.UnaryOp(op=ast.Not(), operand=operand):
            return node, f"({ast.unparse(operand)})"
        case ast.Constant(value=bool() as value):
            return node, str(not value)
        case ast.Constant(value=int() as value):
            return node, str(value + 1)
        case ast.If(test=ast.Name() as test) | ast.IfExp(test=ast.Name() as test):
            return test, f"(not {test.id})"
    return _removed(node)


def _removed(node: ast.AST) -> tuple[ast.AST, str] | None:
    match node:
        case ast.Return(value=value) if value is not None and not isinstance(value, ast.Constant):
            return node, "return None"
        case ast.AugAssign() | ast.Delete() | ast.Expr(value=ast.Call()):
            return node, "pass"
        case ast.Assign(targets=[ast.Attribute() | ast.Subscript()]):
            return node, "pass"
    return None


def mutants_of(path: Path, root: Path) -> Iterator[Mutant]:
    """All places of a file that can be changed."""
    source = (root / path).read_bytes()
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    tree = ast.parse(source)
    left_out = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        for field in ("annotation", "returns"):
            if isinstance(kind := getattr(node, field, None), ast.AST):
                left_out |= {id(inner) for inner in ast.walk(kind)}
    for node in ast.walk(tree):
        changed = None if id(node) in left_out else _changed(node)
        if changed is not None:
            place: Any = changed[0]
            begin = starts[place.lineno - 1] + place.col_offset
            end = starts[place.end_lineno - 1] + place.end_col_offset
            yield Mutant(path, place.lineno, source[begin:end].decode(), changed[1], begin, end)


def draw(root: Path, count: int, seed: int) -> list[Mutant]:
    """`count` places: each room has as many as its share of all places, and at least one."""
    rooms: dict[str, list[Mutant]] = {}
    for file in sorted((root / "rass_mav").rglob("*.py")):
        path = file.relative_to(root)
        rooms.setdefault(path.parts[1], []).extend(mutants_of(path, root))
    rng = random.Random(seed)
    total = sum(map(len, rooms.values()))
    drawn = []
    for _, places in sorted(rooms.items()):
        if places:
            drawn += rng.sample(places, max(1, round(count * len(places) / total)))
    return drawn


def selected(path: Path, root: Path) -> list[str]:
    """The tests that know a module: first those that import it, then those of its room."""
    module = ".".join(path.with_suffix("").parts).removesuffix(".__init__")
    files = sorted((root / "tests").rglob("test_*.py"))
    knowing = [file for file in files if module in file.read_text(encoding="utf-8")]
    folder = root / "tests" / Path(*path.parts[1:-1])
    while folder != root / "tests" and not folder.is_dir():
        folder = folder.parent
    room = [] if folder == root / "tests" else sorted(folder.rglob("test_*.py"))
    return [str(file.relative_to(root)) for file in dict.fromkeys(knowing + room)]


def is_killed(mutant: Mutant, root: Path, limit_s: float) -> bool:
    """Whether a test fails in `root` with the change, or does not end."""
    file = root / mutant.path
    source = file.read_bytes()
    file.write_bytes(source[: mutant.begin] + mutant.after.encode() + source[mutant.end :])
    tests = selected(mutant.path, root) or ["tests"]
    command = [sys.executable, "-m", "pytest", "-x", "-q", "--no-header", "-p", "no:cacheprovider", *tests]
    try:
        # What the caller's pytest and coverage are set to is not for these tests.
        kept = {name: value for name, value in os.environ.items() if not name.startswith(("COVERAGE_", "PYTEST_"))}
        environment = {**kept, "PYTHONPATH": str(root)}
        done = subprocess.run(command, cwd=root, env=environment, capture_output=True, timeout=limit_s, check=False)
        return done.returncode != 0
    except subprocess.TimeoutExpired:
        return True
    finally:
        file.write_bytes(source)


def main() -> None:
    """Draw, try, and print what survives."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100, help="about so many places (default: 100)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--limit", type=float, default=600.0, metavar="S", help="seconds for the tests of one")
    parser.add_argument("--list", action="store_true", help="only list the places")
    options = parser.parse_args()
    drawn = draw(ROOT, options.count, options.seed)
    survived = 0
    with tempfile.TemporaryDirectory() as scratch:
        copy = Path(scratch) / "checkout"
        if not options.list:
            shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(".git", ".venv", "__pycache__", ".*_cache"))
        for mutant in drawn:
            said = f"{mutant.path}:{mutant.line}: {mutant.before!r} -> {mutant.after!r}"
            killed = not options.list and is_killed(mutant, copy, options.limit)
            survived += not killed
            print(said if options.list else f"{'killed  ' if killed else 'SURVIVED'} {said}", flush=True)
    if not options.list:
        print(f"{len(drawn) - survived} of {len(drawn)} killed")


if __name__ == "__main__":
    main()

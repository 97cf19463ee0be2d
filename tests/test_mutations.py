"""tools/mutations.py: which places it changes, and that a test which fails kills a mutant."""

from __future__ import annotations

from pathlib import Path

from tools.mutations import draw, is_killed, mutants_of, selected

SOURCE = '''"""Prose 1."""


def least(a: int, b: int) -> int:
    """The lesser one."""
    return a if a < b else b
'''
TEST = "from rass_mav.room.numbers import least\n\n\ndef test_least() -> None:\n    assert least(1, 2) == 1\n"


def checkout(root: Path) -> Path:
    for path in ("rass_mav", "rass_mav/room", "tests"):
        (root / path).mkdir()
        (root / path / "__init__.py").touch()
    (root / "rass_mav/room/numbers.py").write_text(SOURCE)
    (root / "tests/test_numbers.py").write_text(TEST)
    return Path("rass_mav/room/numbers.py")


def test_prose_and_types_are_left_alone_and_the_seed_decides(tmp_path: Path) -> None:
    path = checkout(tmp_path)
    assert {(m.before, m.after) for m in mutants_of(path, tmp_path)} == {
        ("a < b", "a <= b"), ("return a if a < b else b", "return None"),
    }  # fmt: skip
    assert draw(tmp_path, 1, 3) == draw(tmp_path, 1, 3)
    assert selected(path, tmp_path) == ["tests/test_numbers.py"]


def test_what_the_tests_notice_is_killed_and_the_file_is_as_before(tmp_path: Path) -> None:
    path = checkout(tmp_path)
    killed = {m.after: is_killed(m, tmp_path, 60.0) for m in mutants_of(path, tmp_path)}
    assert killed == {"a <= b": False, "return None": True}
    assert (tmp_path / path).read_text() == SOURCE

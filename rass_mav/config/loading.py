"""From YAML to typed settings and back, with errors that a person can act on.

Every error is a `ConfigError` of one line: `node.yaml: policy.alpha: expected a number >= 0, got 'ten'`.
"""

from __future__ import annotations

import re
from collections.abc import Hashable
from pathlib import Path
from typing import Any, TypeVar

import yaml

from rass_mav.config.sections import Section, under
from rass_mav.config.typed import build, plain, shown
from rass_mav.errors import ConfigError, os_errors_as

S = TypeVar("S", bound=Section)

#: Largest file that is read, bytes of UTF-8.
MAX_FILE_BYTES = 1 << 20


class _Loader(yaml.SafeLoader):
    """YAML as people expect it: a key stands once, numbers like 1e-3 are numbers, no aliases."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            mark = self.peek_event().start_mark  # type: ignore[no-untyped-call]
            raise yaml.constructor.ConstructorError(None, None, "aliases (*name) are not supported", mark)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen: set[Any] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, str):
                raise yaml.constructor.ConstructorError(
                    None, None, f"expected a name as key, got {shown(key)}", key_node.start_mark
                )
            if key in seen:
                raise yaml.constructor.ConstructorError(None, None, f"key {key!r} stands twice", key_node.start_mark)
            seen.add(key)
        return super().construct_mapping(node, deep)


# YAML 1.1, which PyYAML reads, takes 1e-3 for text because it has no dot.
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?[0-9][0-9_]*(?:\.[0-9_]*)?[eE][-+]?[0-9]+$"), list("-+0123456789")
)


def read_yaml(path: str | Path) -> dict[str, Any]:
    """The mapping in a YAML file; an empty file is an empty mapping. Raises `ConfigError`."""
    with os_errors_as(ConfigError, path), Path(path).open("rb") as file:
        data = file.read(MAX_FILE_BYTES + 1)
    if len(data) > MAX_FILE_BYTES:
        raise ConfigError(f"{path}: larger than {MAX_FILE_BYTES} bytes")
    with under(str(path)):
        raw = _parse(data)
    if raw is None:
        return {}
    if not isinstance(raw, dict):
        raise ConfigError(f"{path}: expected keys with values, got {shown(raw)}")
    return raw


def _parse(text: str | bytes) -> Any:
    try:
        return yaml.load(text if isinstance(text, str) else text.decode(), _Loader)
    except UnicodeDecodeError as error:
        raise ConfigError(f"not UTF-8 text (byte {error.start})") from None
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        where = f"line {mark.line + 1}: " if mark is not None else ""
        raise ConfigError(where + " ".join((error.problem or "not YAML").split())) from None
    except yaml.YAMLError as error:
        raise ConfigError("not YAML: " + " ".join(str(error).split())) from None
    except RecursionError:
        raise ConfigError("nested too deeply") from None
    except ValueError as error:
        # For example a date 2026-99-99, or a number with more digits than Python reads.
        raise ConfigError(f"not YAML: {error}") from None


def set_key(raw: dict[str, Any], assignment: str) -> None:
    """Carry out `--set key.path=value` on what `read_yaml` gave. The value is read as YAML; lists by number
    (`links.0.listen=...`). Raises `ConfigError`."""
    key, equals, text = assignment.partition("=")
    path = key.strip().split(".")
    if not equals or not all(path):
        raise ConfigError(f"--set: expected key.path=value, got {assignment!r}")
    with under(f"--set {key}"):
        value = _parse(text)
    place: Any = raw
    for depth, name in enumerate(path):
        last = depth == len(path) - 1
        if isinstance(place, list):
            if not name.isdecimal() or int(name) >= len(place):
                raise ConfigError(f"--set {key}: {'.'.join(path[:depth])} has items 0 to {len(place) - 1}, not {name}")
            index: Any = int(name)
        elif isinstance(place, dict):
            index = name
        else:
            raise ConfigError(f"--set {key}: {'.'.join(path[:depth])} is a value, not a section")
        if last:
            place[index] = value
        else:
            if isinstance(place, dict) and place.get(index) is None:
                place[index] = {}
            place = place[index]


def convert(raw: Any, type: type[S], source: str) -> S:
    """`raw` as a section. Raises `ConfigError` that begins with `source`, a file's name for instance."""
    with under(source):
        return build(raw, type)


def to_plain(section: Section) -> dict[str, Any]:
    """A section as plain values, every default filled in."""
    return dict(plain(section))


def dump_yaml(section: Section) -> str:
    """A section as YAML, every default filled in."""
    text: str = yaml.safe_dump(to_plain(section), sort_keys=False, allow_unicode=True, width=120)
    return text

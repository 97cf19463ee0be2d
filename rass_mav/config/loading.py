"""Converts YAML to typed settings and back, with errors that a person can act on.

Every error is a `ConfigError`. Each of its lines names the file and the key:
`node.yaml: policy.alpha: expected a number >= 0, got 'ten'`.
"""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Hashable, Iterable
from pathlib import Path
from typing import Any, TypeVar

import yaml

from rass_mav.config.sections import Mistakes, Section, under
from rass_mav.config.typed import build, plain, shown
from rass_mav.errors import ConfigError, os_errors_as

S = TypeVar("S", bound=Section)

#: Largest file that is read, bytes of UTF-8.
MAX_FILE_BYTES = 1 << 18
#: Keys, values, lists and sections in one file. A thousand take 0.1 s to read on a PC, and 2 s on a Pi Zero.
MAX_VALUES = 10_000
#: Depth of nested lists and sections.
MAX_DEPTH = 32
#: Longest key or value, characters.
MAX_TEXT = 4096
# A number that no float can hold.
_MAX_BITS = 1023


class _Loader(yaml.SafeLoader):
    """YAML as people expect it: no duplicate keys, numbers like 1e-3 are numbers, no aliases. Its size is bounded."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._values = 0
        self._depth = 0

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        event = self.peek_event()  # type: ignore[no-untyped-call]
        if isinstance(event, yaml.AliasEvent):
            raise _refused("aliases (*name) are not supported", event)
        if isinstance(event, yaml.ScalarEvent) and len(event.value) > MAX_TEXT:
            raise _refused(f"a value of more than {MAX_TEXT} characters", event)
        if self._values >= MAX_VALUES:
            raise _refused(f"more than {MAX_VALUES} values", event)
        if self._depth >= MAX_DEPTH:
            raise ConfigError("nested too deeply")
        self._values += 1
        self._depth += 1
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node

    def construct_yaml_int(self, node: yaml.ScalarNode) -> int:
        value: int = super().construct_yaml_int(node)
        if value.bit_length() > _MAX_BITS:
            raise _refused("a number with too many digits", node)
        return value

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen: set[Any] = set()
        for key_node, value_node in node.value:
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, str):
                # {step_s: 0,5} is step_s: 0 and a key 5.
                comma = " (a number has a decimal point)" if isinstance(key, int) and value_node.value == "" else ""
                raise yaml.constructor.ConstructorError(
                    None, None, f"expected a name as key, got {shown(key)}{comma}", key_node.start_mark
                )
            if key in seen:
                raise yaml.constructor.ConstructorError(None, None, f"key {key!r} appears twice", key_node.start_mark)
            seen.add(key)
        return super().construct_mapping(node, deep)


def _refused(why: str, where: Any) -> yaml.MarkedYAMLError:
    return yaml.constructor.ConstructorError(None, None, why, where.start_mark)


_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_yaml_int)


class _Dumper(yaml.SafeDumper):
    """Writes what `_Loader` reads back as the same."""


# In YAML 1.1, which PyYAML reads, 1e-3 is text because it has no dot. Text that looks so must be quoted then.
for _one in (_Loader, _Dumper):
    _one.add_implicit_resolver(
        "tag:yaml.org,2002:float", re.compile(r"^[-+]?[0-9][0-9_]*(?:\.[0-9_]*)?[eE][-+]?[0-9]+$"), list("-+0123456789")
    )


def read_yaml(path: str | Path) -> dict[str, Any]:
    """The mapping in a YAML file; an empty file is an empty mapping. Raises `ConfigError`."""
    with os_errors_as(ConfigError, path), open(opened(path), "rb") as file:
        data = file.read(MAX_FILE_BYTES + 1)
    with under(str(path)):
        return parse_yaml(data)


def parse_yaml(data: bytes) -> dict[str, Any]:
    """The mapping in a YAML text, of at most `MAX_FILE_BYTES`. Raises `ConfigError`."""
    if len(data) > MAX_FILE_BYTES:
        raise ConfigError(f"larger than {MAX_FILE_BYTES} bytes")
    raw = _parse(data)
    if raw is None:
        return {}
    if not isinstance(raw, dict):
        raise ConfigError(f"expected keys with values, got {shown(raw)}")
    return raw


def opened(path: str | Path) -> int:
    """The descriptor of a regular file. Opening a pipe would block, and a device may never end."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    kind = os.fstat(descriptor).st_mode
    if stat.S_ISREG(kind):
        return descriptor
    os.close(descriptor)
    if stat.S_ISDIR(kind):
        raise ConfigError(f"{path} is a folder, not a file")
    raise ConfigError(f"{path}: expected a file, got something else")


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
    except (ValueError, OverflowError) as error:
        # For example a date 2026-99-99, or a number with more digits than Python reads.
        raise ConfigError(f"not YAML: {error}") from None


def set_key(raw: dict[str, Any], assignment: str) -> None:
    """Apply `--set key.path=value` to a result of `read_yaml`. The value is parsed as YAML. A number selects an item of
    a list (`links.0.listen=...`). Raises `ConfigError`."""
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


def set_keys(raw: dict[str, Any], assignments: Iterable[str], mistakes: Mistakes) -> None:
    """Apply several assignments like `set_key`. Add invalid ones to `mistakes`."""
    for assignment in assignments:
        try:
            set_key(raw, assignment)
        except ConfigError as error:
            path = assignment.partition("=")[0].strip()
            mistakes.add_line(re.sub(r"\.([0-9]+)(?![^.])", r"[\1]", path), str(error))


def convert(raw: Any, type: type[S], source: str) -> S:
    """`raw` as a section. Raises `ConfigError`; each line starts with `source`, for example the name of a file."""
    with under(source):
        return build(raw, type)


def to_plain(section: Section) -> dict[str, Any]:
    """A section as plain values, with all defaults filled in."""
    return dict(plain(section))


def dump_yaml(section: Section) -> str:
    """A section as YAML, with all defaults filled in."""
    text: str = yaml.dump(to_plain(section), Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=120)
    return text

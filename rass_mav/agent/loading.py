"""From YAML to typed settings and back, with errors that a person can act on.

Every error is a `ConfigError` of one line: `node.yaml: policy.alpha: expected a number >= 0, got 'ten'`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Hashable
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import yaml
from msgspec import inspect

from rass_mav.core.errors import ConfigError

T = TypeVar("T")

#: Largest file that is read, bytes of UTF-8.
MAX_FILE_BYTES = 1 << 20
_SHOWN = 60
_AT = re.compile(r"^(?P<text>.*) - at `(?P<path>[^`]*)`$", re.DOTALL)
_UNKNOWN = re.compile(r"^Object contains unknown field `(?P<key>.*)`$", re.DOTALL)
_MISSING = re.compile(r"^Object missing required field `(?P<key>.*)`$", re.DOTALL)
# What msgspec says by itself; everything else is the text of a ValueError in a Struct's __post_init__.
_OF_MSGSPEC = ("Expected `", "Object ", "Invalid ", "Number out of range")


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
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?[0-9][0-9_]*(?:\.[0-9_]*)?[eE][-+]?[0-9]+$"),
    list("-+0123456789"),
)


def read_yaml(path: str | Path) -> dict[str, Any]:
    """The mapping in a YAML file; an empty file is an empty mapping. Raises `ConfigError`."""
    try:
        with Path(path).open("rb") as file:
            data = file.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        raise ConfigError(f"{path}: {(error.strerror or str(error)).lower()}") from None
    if len(data) > MAX_FILE_BYTES:
        raise ConfigError(f"{path}: larger than {MAX_FILE_BYTES} bytes")
    try:
        raw = _parse(data.decode())
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not UTF-8 text (byte {error.start})") from None
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    if raw is None:
        return {}
    if not isinstance(raw, dict):
        raise ConfigError(f"{path}: expected keys with values, got {shown(raw)}")
    return raw


def _parse(text: str) -> Any:
    try:
        return yaml.load(text, _Loader)
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
    try:
        value = _parse(text)
    except ConfigError as error:
        raise ConfigError(f"--set {key}: {error}") from None
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


def convert(raw: Any, type: type[T], source: str) -> T:
    """`raw` as a Struct. Raises `ConfigError` that begins with `source`, a file's name for instance."""
    _check_finite(raw, source, "")
    try:
        return msgspec.convert(raw, type)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{source}: {_explained(str(error), raw, type)}") from None


def to_plain(struct: msgspec.Struct) -> dict[str, Any]:
    """A Struct as plain values, every default filled in."""
    plain: dict[str, Any] = msgspec.to_builtins(struct)
    return plain


def dump_yaml(struct: msgspec.Struct) -> str:
    """A Struct as YAML, every default filled in."""
    text: str = yaml.safe_dump(to_plain(struct), sort_keys=False, allow_unicode=True, width=120)
    return text


def shown(value: Any) -> str:
    """A value as it stands in an error: short, on one line, and as YAML writes it."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "true" if value else "false"
    try:
        text = repr(value)
    except ValueError:
        text = "a number of very many digits"
    return text if len(text) <= _SHOWN else text[: _SHOWN - 3] + "..."


def _check_finite(raw: Any, source: str, path: str) -> None:
    # .nan passes every comparison, and .inf most of them.
    if isinstance(raw, float) and not math.isfinite(raw):
        raise ConfigError(f"{source}: {path}: expected a finite number, got {raw}")
    if isinstance(raw, dict):
        for key, value in raw.items():
            _check_finite(value, source, f"{path}.{key}" if path else str(key))
    elif isinstance(raw, list):
        for index, value in enumerate(raw):
            _check_finite(value, source, f"{path}[{index}]")


def _explained(message: str, raw: Any, type: type) -> str:
    found = _AT.match(message)
    text, at = (found["text"], found["path"]) if found else (message, "$")
    path = at.removeprefix("$").removeprefix(".")
    steps: list[str | int] = [
        int(step[1:-1]) if step.startswith("[") else step for step in re.findall(r"\[\d+\]|[^.\[\]]+", path)
    ]
    here = _type_at(_type_info(type), steps)
    if unknown := _UNKNOWN.match(text):
        key = unknown["key"]
        struct = _struct_in(here)
        known = [field.encode_name for field in struct.fields] if struct is not None else []
        import difflib  # only who makes a mistake needs it

        close = difflib.get_close_matches(key, known, 1)
        hint = f"did you mean {close[0]!r}?" if close else f"known: {', '.join(known)}"
        return f"{_join(path, key)}: unknown key ({hint})"
    if missing := _MISSING.match(text):
        field = _type_at(here, [missing["key"]]) if here is not None else None
        return f"{_join(path, missing['key'])}: missing, expected {_words(field)}"
    if not text.startswith(_OF_MSGSPEC):
        # A Struct's own words. It may know its place in the whole, or just its own keys.
        return text if not path or text.startswith((path + ".", path + ":")) else _join(path, text)
    return f"{path or 'the whole file'}: expected {_words(here)}, got {shown(_value_at(raw, steps))}"


def _join(path: str, key: str) -> str:
    return f"{path}.{key}" if path else key


@lru_cache(maxsize=32)
def _type_info(type: type) -> Any:
    return inspect.type_info(type)


def _alternatives(info: Any) -> list[Any]:
    if isinstance(info, inspect.Metadata):
        info = info.type
    return list(info.types) if isinstance(info, inspect.UnionType) else [info]


def _struct_in(info: Any) -> Any:
    return next((t for t in _alternatives(info) if isinstance(t, inspect.StructType)), None)


def _type_at(info: Any, steps: list[str | int]) -> Any:
    """The type that stands at a path, or None."""
    for step in steps:
        for option in _alternatives(info):
            if isinstance(option, inspect.StructType) and isinstance(step, str):
                info = next((field.type for field in option.fields if field.encode_name == step), None)
                break
            if isinstance(option, inspect.TupleType) and isinstance(step, int):
                info = option.item_types[step]
                break
            if isinstance(option, (inspect.ListType, inspect.VarTupleType)) and isinstance(step, int):
                info = option.item_type
                break
        else:
            return None
    return info


def _value_at(raw: Any, steps: list[str | int]) -> Any:
    for step in steps:
        raw = raw[step]
    return raw


def _words(info: Any) -> str:
    """What a type takes, in plain words. null goes without saying where something else can stand."""
    options = [_option(option) for option in _alternatives(info) if not isinstance(option, inspect.NoneType)]
    return " or ".join(dict.fromkeys(options)) or "null"


def _option(info: Any) -> str:
    if isinstance(info, inspect.Metadata):
        info = info.type
    if isinstance(info, inspect.IntType):
        return "a whole number" + _bounds(info)
    if isinstance(info, inspect.FloatType):
        return "a number" + _bounds(info)
    if isinstance(info, inspect.BoolType):
        return "true or false"
    if isinstance(info, inspect.StrType):
        return "text" + _length(info.min_length, info.max_length, "characters")
    if isinstance(info, inspect.LiteralType):
        values = [str(value) for value in sorted(info.values, key=str)]
        return values[0] if len(values) == 1 else "one of " + ", ".join(values)
    if isinstance(info, inspect.TupleType):
        return f"a list of {len(info.item_types)} values"
    if isinstance(info, (inspect.ListType, inspect.VarTupleType)):
        return "a list" + _length(info.min_length, info.max_length, "items")
    if isinstance(info, inspect.StructType):
        return "a section with keys " + ", ".join(field.encode_name for field in info.fields)
    return "another value"


def _bounds(info: Any) -> str:
    bounds = ((">=", info.ge), (">", info.gt), ("<=", info.le), ("<", info.lt))
    said = [f"{sign} {bound}" for sign, bound in bounds if bound is not None]
    return " " + " and ".join(said) if said else ""


def _length(least: int | None, most: int | None, unit: str) -> str:
    if least is not None and most is not None:
        return f" of {least} to {most} {unit}"
    if least is not None:
        return f" of at least {least} {unit}"
    return f" of at most {most} {unit}" if most is not None else ""

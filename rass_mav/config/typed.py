"""Plain values, as YAML and JSON have them, to sections and back. What does not fit is said in words for people."""

from __future__ import annotations

import math
import re
from functools import lru_cache
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

from rass_mav.config.sections import Meta, Section, fields_of
from rass_mav.errors import ConfigError

S = TypeVar("S", bound=Section)

_SHOWN = 60
_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f\ud800-\udfff]")


def build(raw: Any, section: type[S]) -> S:
    """`raw` as a section. Raises `ConfigError` that begins with the key: `links[0].peers: expected a list, got 3`."""
    _check_values(raw, "")
    built: S = _build(raw, section, "")
    return built


def plain(value: Any) -> Any:
    """A section as plain values, every default filled in."""
    if isinstance(value, Section):
        return {field.name: plain(getattr(value, field.name)) for field in fields_of(type(value))}
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    return value


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


def _check_values(raw: Any, path: str) -> None:
    """What no type can say. .nan passes every comparison, and .inf most of them. No path, name or address has control
    characters or halves of a character in it: they end it for the system, or do worse to who reads the log."""
    if isinstance(raw, float) and not math.isfinite(raw):
        raise ConfigError(f"{path}: expected a finite number, got {raw}")
    if isinstance(raw, str) and _CONTROL.search(raw):
        raise ConfigError(f"{path or 'the whole file'}: expected text without control characters, got {shown(raw)}")
    if isinstance(raw, dict):
        for key, value in raw.items():
            if _CONTROL.search(str(key)):
                raise ConfigError(f"{path or 'the whole file'}: expected a name as key, got {shown(key)}")
            _check_values(value, _join(path, str(key)))
    elif isinstance(raw, list):
        for index, value in enumerate(raw):
            _check_values(value, f"{path}[{index}]")


def _join(path: str, key: str) -> str:
    return f"{path}.{key}" if path else key


# -- what a type takes -------------------------------------------------------------------------------------------------


@lru_cache(maxsize=256)
def _alternatives(hint: Any) -> tuple[tuple[Any, Any], ...]:
    """The types of a union, or the only one, each with its bounds (None: it has none)."""
    if get_origin(hint) in (Union, UnionType):
        return tuple(option for member in get_args(hint) for option in _alternatives(member))
    if get_origin(hint) is Annotated:
        inner, *about = get_args(hint)
        bounds = next((one for one in about if isinstance(one, Meta)), None)
        return tuple((kind, bounds) for kind, _ in _alternatives(inner))
    return ((hint, None),)


def _build(raw: Any, hint: Any, path: str) -> Any:
    for kind, bounds in _alternatives(hint):
        if _is(raw, kind):
            value = _container(raw, kind, path) if isinstance(raw, (dict, list, tuple)) and kind is not Any else raw
            if kind is float:
                value = float(raw)
            if bounds is None or _within(value, bounds):
                return value
    raise ConfigError(f"{path or 'the whole file'}: expected {_words(hint)}, got {shown(raw)}")


def _is(raw: Any, kind: Any) -> bool:
    """Whether a value is of a kind; of a list or section only that it is one."""
    origin = get_origin(kind)
    if kind is Any:
        return True
    if kind is NoneType:
        return raw is None
    if origin is Literal:
        return any(type(raw) is type(value) and raw == value for value in get_args(kind))
    if kind is float:
        return isinstance(raw, (int, float)) and not isinstance(raw, bool) and abs(raw) < 1 << 1023
    if kind is int:
        return isinstance(raw, int) and not isinstance(raw, bool)
    if kind in (bool, str):
        return isinstance(raw, kind)
    if origin in (list, tuple):
        return isinstance(raw, (list, tuple)) and _count_fits(len(raw), kind)
    return isinstance(raw, dict)


def _count_fits(count: int, kind: Any) -> bool:
    members = get_args(kind)
    return get_origin(kind) is list or members[-1] is Ellipsis or len(members) == count


def _within(value: Any, bounds: Any) -> bool:
    size = len(value) if isinstance(value, (str, list, tuple, dict)) else None
    return (
        (bounds.ge is None or value >= bounds.ge)
        and (bounds.gt is None or value > bounds.gt)
        and (bounds.le is None or value <= bounds.le)
        and (bounds.lt is None or value < bounds.lt)
        and (bounds.min_length is None or size is None or size >= bounds.min_length)
        and (bounds.max_length is None or size is None or size <= bounds.max_length)
        and (bounds.one_of is None or value in bounds.one_of())
    )


def _container(raw: Any, kind: Any, path: str) -> Any:
    members = get_args(kind)
    origin = get_origin(kind)
    if origin is dict:
        key_hint, hint = members
        return {_build(key, key_hint, _join(path, str(key))): _build(raw[key], hint, _join(path, key)) for key in raw}
    if origin in (list, tuple):
        hints = [members[0]] * len(raw) if origin is list or members[-1] is Ellipsis else members
        items = [_build(item, hint, f"{path}[{n}]") for n, (item, hint) in enumerate(zip(raw, hints, strict=True))]
        return items if origin is list else tuple(items)
    return _section(raw, kind, path)


def _section(raw: dict[str, Any], section: type[Section], path: str) -> Section:
    known = {field.name: field for field in fields_of(section)}
    values = {}
    for key, value in raw.items():
        if key not in known:
            raise ConfigError(f"{_join(path, key)}: unknown key ({_hint(key, list(known))})")
        values[key] = _build(value, known[key].hint, _join(path, key))
    for field in known.values():
        if field.required and field.name not in raw:
            raise ConfigError(f"{_join(path, field.name)}: missing, expected {_words(field.hint)}")
    try:
        return section(**values)
    except ValueError as error:
        # A section's own words. It may know its place in the whole, or just its own keys.
        text = str(error)
        raise ConfigError(
            text if not path or text.startswith((path + ".", path + ":")) else _join(path, text)
        ) from None


def _hint(key: str, known: list[str]) -> str:
    import difflib  # only who makes a mistake needs it

    close = difflib.get_close_matches(key, known, 1)
    return f"did you mean {close[0]!r}?" if close else f"known: {', '.join(known)}"


# -- the same in words -------------------------------------------------------------------------------------------------


def _words(hint: Any) -> str:
    """What a type takes, in plain words. null goes without saying where something else can stand."""
    options = [_option(kind, bounds) for kind, bounds in _alternatives(hint) if kind is not NoneType]
    return " or ".join(dict.fromkeys(options)) or "null"


def _option(kind: Any, bounds: Any) -> str:
    origin, members = get_origin(kind), get_args(kind)
    if kind is int:
        return "a whole number" + _range(bounds)
    if kind is float:
        return "a number" + _range(bounds)
    if kind is bool:
        return "true or false"
    if origin is Literal or (bounds is not None and bounds.one_of is not None):
        values = sorted(map(str, members or bounds.one_of()))
        return values[0] if len(values) == 1 else "one of " + ", ".join(values)
    if kind is str:
        return "text" + _length(bounds, "characters")
    if origin is tuple and members[-1] is not Ellipsis:
        return f"a list of {len(members)} values"
    if origin in (list, tuple):
        return "a list" + _length(bounds, "items")
    if isinstance(kind, type) and issubclass(kind, Section):
        return "a section with keys " + ", ".join(field.name for field in fields_of(kind))
    return "another value"


def _range(bounds: Any) -> str:
    if bounds is None:
        return ""
    limits = ((">=", bounds.ge), (">", bounds.gt), ("<=", bounds.le), ("<", bounds.lt))
    said = [f"{sign} {limit}" for sign, limit in limits if limit is not None]
    return " " + " and ".join(said) if said else ""


def _length(bounds: Any, unit: str) -> str:
    least, most = (None, None) if bounds is None else (bounds.min_length, bounds.max_length)
    if least is not None and most is not None:
        return f" of {least} to {most} {unit}"
    if least is not None:
        return f" of at least {least} {unit}"
    return f" of at most {most} {unit}" if most is not None else ""

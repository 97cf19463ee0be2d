"""Converts plain values, as in YAML and JSON, to sections and back. Errors are in words for people."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from functools import lru_cache
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

from rass_mav.config.sections import Meta, Mistakes, Section, fields_of
from rass_mav.errors import ConfigError, comma_hint

S = TypeVar("S", bound=Section)

_SHOWN = 60
_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f\ud800-\udfff]")


class _Bad:
    """Replaces a value that cannot be built."""

    def __repr__(self) -> str:
        return "..."


_BAD = _Bad()


def build(raw: Any, section: type[S]) -> S:
    """`raw` as a section. Raises `ConfigError`; each line starts with the key:
    `links[0].peers: expected a list, got 3`."""
    mistakes = Mistakes()
    built = build_with(raw, section, mistakes)
    mistakes.check()
    assert built is not None
    return built


def build_with(raw: Any, section: type[S], mistakes: Mistakes) -> S | None:
    """Like `build`, but add what is wrong to `mistakes`.

    The result then has defaults in place of the mistakes, for further checks. None: that is impossible too.
    """
    built = _build(_possible(raw, "", mistakes), section, "", mistakes)
    return None if built is _BAD else built


def plain(value: Any) -> Any:
    """A section as plain values, with all defaults filled in."""
    if isinstance(value, Section):
        return {field.name: plain(getattr(value, field.name)) for field in fields_of(type(value))}
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    return value


def shown(value: Any) -> str:
    """A value for an error message: short, on one line, and in YAML's notation."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "true" if value else "false"
    try:
        text = repr(value)
    except ValueError:
        text = "a number with too many digits"
    return text if len(text) <= _SHOWN else text[: _SHOWN - 3] + "..."


def _possible(raw: Any, path: str, mistakes: Mistakes) -> Any:
    """The values without those that are wrong for every type. .nan passes every comparison, and .inf most of them. No
    path, name or address contains control characters or surrogates: they would end it for the system, or harm the
    reader of the log."""
    if isinstance(raw, float) and not math.isfinite(raw):
        mistakes.add(path, f"expected a finite number, got {raw}")
        return _BAD
    if isinstance(raw, str) and _CONTROL.search(raw):
        mistakes.add(path, f"expected text without control characters, got {shown(raw)}")
        return _BAD
    if isinstance(raw, dict):
        kept = {}
        for key, value in raw.items():
            if _CONTROL.search(str(key)):
                mistakes.add(path, f"expected a name as key, got {shown(key)}")
            else:
                kept[key] = _possible(value, _join(path, str(key)), mistakes)
        return kept
    if isinstance(raw, list):
        return [_possible(value, f"{path}[{index}]", mistakes) for index, value in enumerate(raw)]
    return raw


def _join(path: str, key: str) -> str:
    return f"{path}.{key}" if path else key


# -- what a type accepts -----------------------------------------------------------------------------------------------


@lru_cache(maxsize=256)
def alternatives(hint: Any) -> tuple[tuple[Any, Any], ...]:
    """The types of a union, or the single type, each with its bounds (None: it has none)."""
    if get_origin(hint) in (Union, UnionType):
        return tuple(option for member in get_args(hint) for option in alternatives(member))
    if get_origin(hint) is Annotated:
        inner, *about = get_args(hint)
        bounds = next((one for one in about if isinstance(one, Meta)), None)
        return tuple((kind, bounds) for kind, _ in alternatives(inner))
    return ((hint, None),)


def _build(raw: Any, hint: Any, path: str, mistakes: Mistakes) -> Any:
    if raw is _BAD:
        return _BAD
    for kind, bounds in alternatives(hint):
        if _is(raw, kind):
            value = raw
            if isinstance(raw, (dict, list, tuple)) and kind is not Any:
                value = _container(raw, kind, path, mistakes)
            elif kind is float:
                value = float(raw)
            if value is _BAD or bounds is None or _within(value, bounds):
                return value
    comma = comma_hint(raw) if any(kind is float for kind, _ in alternatives(hint)) else ""
    mistakes.add(path, f"expected {_words(hint)}, got {shown(raw)}{comma}")
    return _BAD


def _is(raw: Any, kind: Any) -> bool:
    """Whether a value is of a kind. For a list or section, only whether it is one."""
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


def _container(raw: Any, kind: Any, path: str, mistakes: Mistakes) -> Any:
    members = get_args(kind)
    origin = get_origin(kind)
    if origin is dict:
        key_hint, hint = members
        built = {
            _build(key, key_hint, _join(path, str(key)), mistakes): _build(raw[key], hint, _join(path, key), mistakes)
            for key in raw
        }
        return _BAD if any(item is _BAD for pair in built.items() for item in pair) else built
    if origin in (list, tuple):
        hints = [members[0]] * len(raw) if origin is list or members[-1] is Ellipsis else members
        items = [
            _build(item, hint, f"{path}[{n}]", mistakes) for n, (item, hint) in enumerate(zip(raw, hints, strict=True))
        ]
        if any(item is _BAD for item in items):
            return _BAD
        return items if origin is list else tuple(items)
    return _section(raw, kind, path, mistakes)


def _section(raw: dict[str, Any], section: type[Section], path: str, mistakes: Mistakes) -> Any:
    known = {field.name: field for field in fields_of(section)}
    values = {}
    # Whether its own keys are right, regardless of mistakes in the sections below it.
    right = True
    for key, value in raw.items():
        if key not in known:
            right = False
            meant = closest(key, known)
            hint = "known: " + ", ".join(known) if meant is None else f"did you mean {meant!r}?"
            mistakes.add(_join(path, key), f"unknown key ({hint})")
            if meant is not None:
                mistakes.doubt(_join(path, meant))
            continue
        built = _build(value, known[key].hint, _join(path, key), mistakes)
        if built is not _BAD:
            values[key] = built
        elif mistakes.has(_join(path, key)) or not isinstance(value, dict):
            right = False
    for field in known.values():
        if field.required and field.name not in values:
            right = False
            if field.name not in raw:
                mistakes.add(_join(path, field.name), f"missing, expected {_words(field.hint)}")
    if not right and any(field.required and field.name not in values for field in known.values()):
        return _BAD
    try:
        return section(**values)
    except ConfigError as error:
        # The section's own messages, which start with the whole path or only with its own keys.
        if right:
            at_home = (path + ".", path + ":")
            said = (line if not path or line.startswith(at_home) else _join(path, line) for line in error.mistakes)
            mistakes.add_lines(said)
        return _BAD


def choices(section: type[Section], key: str) -> list[str]:
    """The valid names for a key such as `policy.name`."""
    name, _, rest = key.partition(".")
    (hint,) = (field.hint for field in fields_of(section) if field.name == name)
    ((kind, bounds),) = alternatives(hint)
    return choices(kind, rest) if rest else sorted(_names(kind, bounds))


def closest(name: str, known: Iterable[str]) -> str | None:
    """The name that was probably meant; None: none is similar."""
    import difflib  # only needed after a mistake

    return next(iter(difflib.get_close_matches(name, list(known), 1)), None)


# -- the same in words -------------------------------------------------------------------------------------------------


def _words(hint: Any) -> str:
    """What a type accepts, in plain words. null is only mentioned if nothing else is accepted."""
    options = [_option(kind, bounds) for kind, bounds in alternatives(hint) if kind is not NoneType]
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
        values = sorted(_names(kind, bounds))
        return values[0] if len(values) == 1 else "one of " + ", ".join(values)
    if kind is str:
        return "text" + _length(bounds, "characters")
    if origin is tuple and members[-1] is not Ellipsis:
        return f"a list of {len(members)} values"
    if origin in (list, tuple):
        return "a list" + _length(bounds, "items")
    if isinstance(kind, type) and issubclass(kind, Section):
        return f"a section with keys {_keys(kind)}"
    return "another value"


def _keys(section: type[Section]) -> str:
    needed = ", ".join(field.name for field in fields_of(section) if field.required)
    others = ", ".join(field.name for field in fields_of(section) if not field.required)
    return f"{needed} (optional: {others})" if needed and others else needed or others


def _names(kind: Any, bounds: Any) -> list[str]:
    return [str(name) for name in get_args(kind) or bounds.one_of()]


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

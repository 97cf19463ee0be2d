"""What an object is made of, down to the last number, to see whether anything in it has changed."""

from __future__ import annotations

import random
from collections.abc import Callable, Collection, Mapping
from enum import Enum
from typing import Any

_PLAIN = (int, float, str, bytes, bool, type(None), Enum, type)


def picture(thing: Any, *, without: Collection[type] = ()) -> Any:
    """Equal for two moments if nothing has changed in between. `without`: parts of these types are left out."""
    return _look(thing, tuple(without), {})


def _look(thing: Any, without: tuple[type, ...], seen: dict[int, tuple[int, Any]]) -> Any:
    if isinstance(thing, _PLAIN):
        return thing
    if isinstance(thing, without):
        return "left out"
    if id(thing) in seen:
        return ("seen", seen[id(thing)][0])
    # With the thing itself: another one could have its id if it were gone.
    seen[id(thing)] = len(seen), thing
    if isinstance(thing, random.Random):
        return thing.getstate()
    if isinstance(thing, Mapping):
        return [(_look(key, without, seen), _look(value, without, seen)) for key, value in thing.items()]
    if isinstance(thing, set | frozenset):
        return sorted(map(repr, thing))
    if isinstance(thing, Collection):
        return [_look(part, without, seen) for part in thing]
    owner = getattr(thing, "__self__", None)
    if isinstance(thing, Callable) and not _attributes(thing):  # type: ignore[arg-type]
        return (getattr(thing, "__qualname__", type(thing).__name__), _look(owner, without, seen))
    return (type(thing).__name__, {name: _look(value, without, seen) for name, value in _attributes(thing).items()})


def _attributes(thing: Any) -> dict[str, Any]:
    slots = [name for kind in type(thing).__mro__ for name in getattr(kind, "__slots__", ())]
    found = {name: getattr(thing, name) for name in slots if hasattr(thing, name)}
    return found | getattr(thing, "__dict__", {})

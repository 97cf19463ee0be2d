"""What sections of a configuration are made of: classes with typed, bounded fields that cannot be changed.

A section is a frozen dataclass, so that a node needs nothing compiled. Bounds stand in the annotations
(`Annotated[int, Meta(ge=0)]`); `typed` builds sections from plain values and checks them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar, get_type_hints

from rass_mav.errors import ConfigError

if TYPE_CHECKING:
    from typing_extensions import dataclass_transform
else:

    def dataclass_transform(**_):
        """Python 3.10 has none; only type checkers look at it."""
        return lambda cls: cls


S = TypeVar("S")


class Field(NamedTuple):
    """A key of a section."""

    name: str
    hint: Any
    """Its type, with bounds as `Annotated[..., Meta(...)]`."""
    required: bool
    """It has no default."""


class Meta(NamedTuple):
    """Bounds of a value, of the length of a text, or the names of which a text is one."""

    ge: float | None = None
    gt: float | None = None
    le: float | None = None
    lt: float | None = None
    min_length: int | None = None
    max_length: int | None = None
    one_of: Callable[[], Collection[str]] | None = None
    """Gives the names in a room's registry, of which a text is one."""


@dataclass_transform(frozen_default=True, kw_only_default=True, field_specifiers=(dataclasses.field,))
class Section:
    """Base of all sections: each subclass becomes a frozen dataclass with keywords only."""

    def __init_subclass__(cls, **more: Any) -> None:
        super().__init_subclass__(**more)
        dataclasses.dataclass(frozen=True, kw_only=True)(cls)


def fields_of(section: type[Section]) -> tuple[Field, ...]:
    """The keys of a section, in the order of the file's documentation."""
    # A class, so it can be hashed; mypy looks at its instances.
    return _fields_of(section)  # type: ignore[arg-type]


@lru_cache(maxsize=64)
def _fields_of(section: type[Section]) -> tuple[Field, ...]:
    hints = get_type_hints(section, include_extras=True)
    missing = dataclasses.MISSING
    return tuple(
        Field(f.name, hints[f.name], f.default is missing and f.default_factory is missing)
        for f in dataclasses.fields(section)  # type: ignore[arg-type]  # subclasses are
    )


@contextmanager
def under(key: str) -> Iterator[None]:
    """Put a key in front of the `ConfigError`s of a block."""
    try:
        yield
    except ConfigError as error:
        raise ConfigError(f"{key}: {error}") from None

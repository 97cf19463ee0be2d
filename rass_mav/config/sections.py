"""The base of configuration sections: immutable classes with typed, bounded fields.

A section is a frozen dataclass, so that a node needs nothing compiled. Bounds are part of the annotations
(`Annotated[int, Meta(ge=0)]`). `typed` builds sections from plain values and checks them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, TypeVar, get_type_hints

from rass_mav.errors import ConfigError

if TYPE_CHECKING:
    from typing_extensions import dataclass_transform
else:

    def dataclass_transform(**_):
        """Python 3.10 does not have it. Only type checkers need it."""
        return lambda cls: cls


S = TypeVar("S")


class Field(NamedTuple):
    """A key of a section."""

    name: str
    hint: Any
    """Its type, with bounds as `Annotated[..., Meta(...)]`."""
    required: bool
    """Whether it has no default."""


class Meta(NamedTuple):
    """Bounds of a value or of the length of a text, or the valid names."""

    ge: float | None = None
    gt: float | None = None
    le: float | None = None
    lt: float | None = None
    min_length: int | None = None
    max_length: int | None = None
    one_of: Callable[[], Collection[str]] | None = None
    """Returns the valid names of a text, from a package's registry."""


#: The highest id of a node.
MAX_NODE = 65534
# Bounds that many keys have.
Positive = Annotated[float, Meta(gt=0)]
NonNegative = Annotated[float, Meta(ge=0)]
Fraction = Annotated[float, Meta(ge=0, le=1)]
Count = Annotated[int, Meta(ge=1)]
NodeId = Annotated[int, Meta(ge=0, le=MAX_NODE)]


@dataclass_transform(frozen_default=True, kw_only_default=True, field_specifiers=(dataclasses.field,))
class Section:
    """Base of all sections. Each subclass becomes a frozen dataclass with keyword arguments only."""

    def __init_subclass__(cls, **more: Any) -> None:
        super().__init_subclass__(**more)
        dataclasses.dataclass(frozen=True, kw_only=True)(cls)

    def __post_init__(self) -> None:
        """Raises `ConfigError` with all mistakes."""
        mistakes = tuple(self.mistakes())
        if mistakes:
            raise ConfigError(*mistakes)

    def mistakes(self) -> Iterable[str]:
        """Mistakes that concern more than one key: one line for each, which starts with the key."""
        return ()


def fields_of(section: type[Section]) -> tuple[Field, ...]:
    """The keys of a section, in the order of the file's documentation."""
    # A class can be hashed; mypy checks its instances.
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
    """Put a key before each line of a `ConfigError` in the block."""
    try:
        yield
    except ConfigError as error:
        raise ConfigError(*(f"{key}: {mistake}" for mistake in error.mistakes)) from None


class Mistakes:
    """Collects all mistakes in a configuration, so that they can be reported at once.

    Each key is reported once. A check of several keys must first ask whether they are `sound`: a consequence of a
    mistake is not a mistake of its own.
    """

    def __init__(self, source: str = "") -> None:
        """`source`: the text before all keys, for example the name of a file."""
        self._source = source
        self._lines: list[str] = []
        self._keys: set[str] = set()
        self._doubtful: set[str] = set()

    def add(self, key: str, text: str) -> None:
        """Add a mistake at a key such as `links[0].listen`; empty: in the whole configuration."""
        if key not in self._keys:
            self.add_line(key, self._line(f"{key or 'the whole file'}: {text}"))

    def add_line(self, key: str, line: str) -> None:
        """Add a mistake as a complete line."""
        self._lines.append(line)
        self._keys.add(key)
        self._doubtful.add(key)

    def doubt(self, key: str) -> None:
        """Mark a key as doubtful, because a mistake elsewhere is probably meant for it."""
        self._doubtful.add(key)

    def has(self, key: str) -> bool:
        """Whether there is a mistake at exactly this key."""
        return key in self._keys

    def sound(self, *keys: str) -> bool:
        """Whether there is no mistake at these keys, in them or around them."""
        return not any(_within(key, bad) or _within(bad, key) for key in keys for bad in self._doubtful)

    @contextmanager
    def gathering(self, key: str = "") -> Iterator[None]:
        """Collect the mistakes of a `ConfigError` in the block. `key`: put before the lines; empty: they have keys.

        Mistakes at keys that are not `sound` are left out.
        """
        try:
            yield
        except ConfigError as error:
            before = f"{key}: " if key else ""
            self.add_lines(before + line for line in error.mistakes)

    def add_lines(self, lines: Iterable[str]) -> None:
        """Add lines that start with their keys, like `gathering`."""
        keyed = [(line.partition(": ")[0], line) for line in lines]
        for key, line in [(key, line) for key, line in keyed if self.sound(key)]:
            self.add_line(key, self._line(line))

    def check(self) -> None:
        """Raise `ConfigError` if there are any mistakes."""
        if self._lines:
            raise ConfigError(*self._lines)

    def _line(self, text: str) -> str:
        return f"{self._source}: {text}" if self._source else text


def _within(key: str, whole: str) -> bool:
    return key == whole or not whole or key.startswith((whole + ".", whole + "["))

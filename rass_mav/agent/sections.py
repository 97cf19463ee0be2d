"""What sections of a configuration are made of: classes with typed, bounded fields that cannot be changed.

They are Structs of msgspec where it is installed; the mock swarm needs it, to write and read them as JSON. It is
compiled, and not to be had for every board. So a node does without: then they are dataclasses. Who handles them by what
is here need not know which.
"""

from __future__ import annotations

import dataclasses
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar, get_type_hints

S = TypeVar("S")


class Field(NamedTuple):
    """A key of a section."""

    name: str
    hint: Any
    """Its type, with bounds as `Annotated[..., Meta(...)]`."""
    required: bool
    """It has no default."""


class _Bounds(NamedTuple):
    ge: float | None = None
    gt: float | None = None
    le: float | None = None
    lt: float | None = None
    min_length: int | None = None
    max_length: int | None = None


class _Frozen:
    """A frozen dataclass is made of each subclass. Its keywords are those of a Struct."""

    def __init_subclass__(
        cls, frozen: bool = True, kw_only: bool = True, forbid_unknown_fields: bool = True, **more: Any
    ) -> None:
        super().__init_subclass__(**more)
        dataclasses.dataclass(frozen=frozen, kw_only=kw_only)(cls)


if TYPE_CHECKING:
    from msgspec import Meta, Struct, field
    from msgspec.structs import replace
else:
    try:
        from msgspec import Meta, Struct, field
        from msgspec.structs import replace
    except ImportError:
        Meta, Struct = _Bounds, _Frozen
        field, replace = dataclasses.field, dataclasses.replace

__all__ = ["Field", "Meta", "Section", "field", "fields_of", "replace"]


class Section(Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """Base of all sections: unknown keys are errors."""


@lru_cache(maxsize=64)
def fields_of(section: type[Section]) -> tuple[Field, ...]:
    """The keys of a section, in the order of the file's documentation."""
    if dataclasses.is_dataclass(section):
        hints = get_type_hints(section, include_extras=True)
        missing = dataclasses.MISSING
        return tuple(
            Field(f.name, hints[f.name], f.default is missing and f.default_factory is missing)
            for f in dataclasses.fields(section)
        )
    from msgspec import structs

    return tuple(Field(f.name, f.type, f.required) for f in structs.fields(section))

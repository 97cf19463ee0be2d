"""Writes what follows from the table of all messages (tools/wire_table.py): the functions that write and read them,
and their layouts on the page and in the dissector.

    python -m tools.generate_wire
"""

from __future__ import annotations

import re
import struct
import subprocess
import sys
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

from rass_mav.core.messages import DeletionEntry, Receipt, ReceiptEntry, SequenceMark
from tools.pages import ROOT, filled, write
from tools.wire_table import (
    BLOCKS,
    KEYED,
    MESSAGES,
    MORE,
    TO,
    VERSION,
    Age,
    Bitmap,
    Blocks,
    Bytes,
    Field,
    Layout,
    Packed,
    Part,
    Record,
    Rows,
    When,
    in_words,
)

_CODES = {"8": "B", "16": "H", "32": "I", "64": "Q"}


def code(field: Field) -> str:
    """Of a field, for `struct`."""
    return f"{field.type[:-6]}s" if field.type.endswith(" bytes") else _CODES[field.type[1:]]


def fixed(parts: Sequence[Part]) -> str:
    """The codes of the fields up to the first part whose size is not fixed."""
    found = ""
    for part in parts:
        if isinstance(part, Record):
            found += fixed(part.parts)
            if is_variable(part.parts):
                break
        elif isinstance(part, Field | Age):
            found += "I" if isinstance(part, Age) else code(part)
        else:
            break
    return found


def fields_of(record: type) -> tuple[str, ...]:
    """The fields of a NamedTuple."""
    names: tuple[str, ...] = record._fields  # type: ignore[attr-defined]
    return names


def constant(name: str) -> str:
    """`DeletionReport` as `DELETION_REPORT`."""
    return in_words(name).upper().replace(" ", "_")


class Structs:
    """The structs that the generated functions use, by name."""

    def __init__(self) -> None:
        self.formats: dict[str, str] = {}

    def named(self, name: str, codes: str) -> str:
        """The name of a struct with these codes."""
        wanted, number = f"{name}_FIELDS", 2
        while self.formats.get(wanted, codes) != codes:
            wanted, number = f"{name}_FIELDS_{number}", number + 1
        self.formats[wanted] = codes
        return wanted


def call(record: type, values: Mapping[str, str]) -> str:
    """The record with these values for its fields; fields at its end that have none keep their defaults."""
    names = fields_of(record)
    while names[-1] not in values:
        names = names[:-1]
    return f"{record.__name__}({', '.join(values[name] for name in names)})"


def is_plain(parts: Sequence[Part]) -> bool:
    """Whether all of them are fields that stand as such in their record."""
    return all(isinstance(part, Field) and not own_flags(part) and not part.counts for part in parts)


def own_flags(field: Field) -> list[tuple[str, int]]:
    """The flags that the record has beside the number: the others are only shown."""
    return [(name, bit) for name, bit in field.flags if "." not in name]


class Reading:
    """The lines of a function that reads parts from `p`, from `at` on."""

    def __init__(self, structs: Structs, name: str, at: int | None, indent: str) -> None:
        self.lines: list[str] = []
        self._structs, self._name, self._indent = structs, name, indent
        self._at = at
        self._codes, self._names = "", list[str]()
        self._checks: list[str] = []
        self._counts: dict[str, str] = {}
        self._flagged: dict[str, str] = {}
        self.crc: int | None = None
        self._ends = ""
        self.known: set[str] = set()

    def read(self, parts: Sequence[Part], record: type, given: Mapping[str, str]) -> dict[str, str]:
        """Reads all of the parts; returns the values of the record's fields."""
        values = self.parts(parts, record, given)
        self.flush()
        return values

    @property
    def at(self) -> str:
        """Where the next part begins."""
        return "at" if self._at is None else str(self._at)

    def head(self, number: int) -> None:
        """Skips the first byte, or the first two."""
        self._codes, self._names = ("B", ["_"]) if number < MORE else ("BB", ["_", "_"])

    def add(self, line: str) -> None:
        self.lines.append(self._indent + line)

    def flush(self) -> None:
        """Reads the fields that have been named."""
        if self._codes:
            name = self._structs.named(self._name, self._codes)
            names = ", ".join(self._names) if len(self._names) > 1 else f"({self._names[0]},)"
            self.add(f"{names} = {name}.unpack_from(p{'' if self.at == '0' else ', ' + self.at})")
            size = struct.calcsize(f"<{self._codes}")
            self.known |= set(self._names)
            if self._at is None:
                self.add(f"at += {name}.size")
            else:
                self._at += size
            self._codes, self._names = "", []
        for check in self._checks:
            self.add(check)
        self._checks = []

    def parts(self, parts: Sequence[Part], record: type, given: Mapping[str, str]) -> dict[str, str]:
        """Reads parts; returns the values of the record's fields."""
        values = dict(given)
        for part in parts:
            if isinstance(part, Field):
                self._field(part, values)
            elif isinstance(part, Age):
                self._codes += "I"
                self._names.append("age")
                values |= {"created": "now - (age & OLDEST) / 1000.0", "at_least": "age >= OLDEST"}
            elif isinstance(part, Record):
                values[part.name] = call(part.record, self.parts(part.parts, part.record, {}))
            elif isinstance(part, Bytes):
                self._bytes(part, values)
            elif isinstance(part, Bitmap):
                self._bitmap(part, values)
            elif isinstance(part, Rows):
                self._rows(part, values)
            else:
                break
        return values

    def _field(self, field: Field, values: dict[str, str]) -> None:
        if field.crc:
            self.crc = (self._at or 0) + struct.calcsize(f"<{self._codes}")
        name = field.name
        self._codes += code(field)
        self._names.append(name)
        mask = sum(bit for _, bit in own_flags(field))
        value = f"{name} & {(1 << int(field.type[1:])) - 1 - mask:#x}" if mask else name
        if field.counts:
            self._counts[field.counts] = value
        values[name] = value
        values |= {flag: f"bool({name} & {bit:#x})" for flag, bit in own_flags(field)}
        if field.counts and mask:
            self._flagged[field.counts] = f"{name} & {mask:#x}"
        wrong = f"not {field.least} <= {name} <= {field.most}" if field.most else f"{name} < {field.least}"
        if field.most or field.least:
            self._checks += [f"if {wrong}:", f'    raise MalformedError(f"{field.name} is {{{name}}}")']

    def _variable(self, size: str) -> None:
        """What was read last has a size that varies."""
        if self._at is None:
            self.add(f"at += {size}")
        else:
            self.add(f"at = {self._at} + {size}")
            self._at = None

    def _bytes(self, part: Bytes, values: dict[str, str]) -> None:
        self.flush()
        values[part.name] = part.name
        if part.to_the_end:
            values[part.name] = f"p[{self.at}:]"
            return
        size = self._counts[part.name]
        self.add(f"{part.name} = p[{self.at} : {self.at} + {size}]")
        self.add(f"if len({part.name}) != {size} or not {size}:")
        self.add(f'    raise MalformedError("truncated {part.name}")')
        self._variable(size)

    def _bitmap(self, part: Bitmap, values: dict[str, str]) -> None:
        self._codes += "B"
        self._names.append("size")
        self.flush()
        self.add(f"{part.name} = read_bitmap(p, {self.at}, size, {part.bits})")
        self._variable("size")
        values[part.name] = part.name

    def _rows(self, rows: Rows, values: dict[str, str]) -> None:
        self.flush()
        count = self._counts[rows.name]
        if rows.most:
            self.add(f"if {count} > {rows.most}:")
            self.add(f'    raise MalformedError(f"{{{count}}} {rows.name}")')
        self._ends = ""
        if rows.optional:
            self.add(f"if {self._flagged[rows.name]}:")
            self._loop(rows, (*rows.parts, rows.optional), count, "    ")
            self.add("else:")
            self._loop(rows, rows.parts, count, "    ")
        else:
            self._loop(rows, rows.parts, count, "")
        if self._ends and not rows.optional:
            self.add(f"at = {self._ends}")
        values[rows.name] = f"tuple({rows.name})"
        self._at = None

    def _loop(self, rows: Rows, parts: Sequence[Part], count: str, indent: str) -> None:
        if rows.hook or is_variable(parts):
            now = ", now" if has_age(parts) else ""
            if self._at is not None:
                self.add(f"at = {self._at}")
            self.add(f"{rows.name} = []")
            self.add(f"for _ in range({count}):")
            self.add(f"    row, at = read_{rows.hook or snake(row_name(rows))}(p, at{now})")
            self.add(f"    {rows.name}.append(row)")
            return
        inner = Reading(self._structs, constant(row_name(rows)), None, "")
        values = inner.parts(parts, rows.record or tuple, {})
        fields = self._structs.named(constant(row_name(rows)), fixed(parts))
        unpacked, names = f"{fields}.unpack_from(p, at)", ", ".join(inner._names)
        span = f"range({self.at}, {self.at} + {parenthesised(count)} * {fields}.size, {fields}.size)"
        each = plain_row(rows, parts, unpacked)
        if each:
            self.add(f"{indent}{rows.name} = [{each} for at in {span}]")
            self._ends = f"{self.at} + {parenthesised(count)} * {fields}.size"
            return
        assert not set(inner._names) & self.known, "a row's field is named like one of its message"
        self.add(f"{indent}{rows.name} = []")
        self.add(f"{indent}for at in {span}:")
        self.add(f"{indent}    {names} = {unpacked}")
        self.add(f"{indent}    {rows.name}.append({row_of(rows, parts, values)})")
        self._ends = f"{self.at} + {parenthesised(count)} * {fields}.size"


def snake(name: str) -> str:
    """`DeletionReport` as `deletion_report`."""
    return in_words(name).lower().replace(" ", "_")


def row_name(rows: Rows) -> str:
    """What its rows are called in the code."""
    if rows.record:
        return rows.record.__name__
    return rows.parts[0].record.__name__ if isinstance(rows.parts[0], Record) else rows.title


def has_age(parts: Sequence[Part]) -> bool:
    """Whether there is an age in them."""
    return any(isinstance(part, Age) or (isinstance(part, Record) and has_age(part.parts)) for part in parts)


def parenthesised(expression: str) -> str:
    """The same as one operand."""
    return f"({expression})" if " " in expression else expression


def is_variable(parts: Sequence[Part]) -> bool:
    """Whether the size of parts varies."""
    return any(
        isinstance(part, Bytes | Bitmap | Rows) or (isinstance(part, Record) and is_variable(part.parts))
        for part in parts
    )


def row_of(rows: Rows, parts: Sequence[Part], values: Mapping[str, str]) -> str:
    """A row, made of the values of its parts."""
    if rows.record:
        return call(rows.record, values)
    made = [values[part.name] for part in parts if isinstance(part, Field | Record)]
    return made[0] if len(made) == 1 else f"({', '.join(made)})"


def plain_row(rows: Rows, parts: Sequence[Part], unpacked: str) -> str:
    """A row where it is the tuple that `struct` gives, or a record of just this; empty: it is not so."""
    if len(parts) == 1 and isinstance(parts[0], Record) and not rows.record and is_plain(parts[0].parts):
        return f"{parts[0].record.__name__}._make({unpacked})"
    if not is_plain(parts):
        return ""
    if rows.record:
        return f"{rows.record.__name__}._make({unpacked})"
    return f"{unpacked}[0]" if len(parts) == 1 else unpacked


class Writing:
    """The lines of a function that writes parts, and the bytes that it makes."""

    def __init__(self, structs: Structs, name: str) -> None:
        self.lines: list[str] = []
        self.pieces: list[str] = []
        self.rows = self._flag = ""
        self._structs, self._name = structs, name
        self._codes, self._values = "", list[str]()

    def head(self, number: int) -> None:
        """The first byte, or the first two."""
        first = VERSION << 4 | min(number, MORE)
        self._codes, self._values = (
            ("B", [f"{first:#04x}"]) if number < MORE else ("BB", [f"{first:#04x}", f"{number}"])
        )

    def flush(self) -> None:
        if self._codes:
            self.pieces.append(f"{self._structs.named(self._name, self._codes)}.pack({', '.join(self._values)})")
        self._codes, self._values = "", []

    def parts(self, parts: Sequence[Part], record: type | None) -> None:
        for part in parts:
            if isinstance(part, Field):
                self._field(part, record)
            elif isinstance(part, Age):
                self._codes += "I"
                self._values.append("age(created, now, at_least)")
            elif isinstance(part, Record) and is_plain(part.parts):
                self._codes += fixed(part.parts)
                self._values.append(f"*{part.name}")
            elif isinstance(part, Record):
                self.lines.append(f"{', '.join(fields_of(part.record))} = {part.name}")
                self.parts(part.parts, part.record)
            elif isinstance(part, Bytes):
                self.flush()
                self.pieces.append(part.name)
            elif isinstance(part, Bitmap):
                self.lines.append(f"packed = bitmap_bytes({part.name}, {part.bits})")
                self._codes += "B"
                self._values.append("len(packed)")
                self.flush()
                self.pieces.append("packed")
            elif isinstance(part, Rows):
                self._rows(part)
            else:
                break

    def _field(self, field: Field, record: type | None) -> None:
        value = f"len({field.counts})" if field.counts else field.name
        for flag, bit in own_flags(field):
            if not field.counts:
                self.lines += [f"if {value} >= {bit:#x}:", f'    raise ValueError(f"{field.name} is {{{value}}}")']
            else:
                self._flag = flag
            if record is None or flag in fields_of(record) or field.counts:
                value = f"{value} | ({bit:#x} if {flag} else 0)"
        if field.least and field.counts:
            self.lines += [f"if not {field.least} <= {value} <= {field.most}:"]
            self.lines += [f'    raise ValueError(f"{{{value}}} {field.counts}")']
        self._codes += code(field)
        self._values.append(value)

    def _rows(self, rows: Rows) -> None:
        if rows.most:
            self.lines += [f"if len({rows.name}) > {rows.most}:"]
            self.lines += [f'    raise ValueError(f"{{len({rows.name})}} {rows.name}")']
        self.flush()
        if rows.hook or is_variable(rows.parts):
            now = ", now" if has_age(rows.parts) else ""
            made = f"[{rows.hook or snake(row_name(rows))}_bytes(row{now}) for row in {rows.name}]"
        elif rows.optional:
            self.lines.append(f"{self._flag} = any(row.{rows.optional.name} for row in {rows.name})")
            less, more = (self._row(rows, parts) for parts in (rows.parts, (*rows.parts, rows.optional)))
            made = f"[{more} if {self._flag} else {less} for {row_names(rows)} in {rows.name}]"
        else:
            made = f"[{self._row(rows, rows.parts)} for {row_names(rows)} in {rows.name}]"
        self.pieces.append(f'b"".join({made})')
        self.rows = made

    def _row(self, rows: Rows, parts: Sequence[Part]) -> str:
        inner = Writing(self._structs, constant(row_name(rows)))
        inner.parts(parts, rows.record)
        inner.flush()
        [piece] = inner.pieces
        return piece


def row_names(rows: Rows) -> str:
    """The names of what is in a row."""
    if rows.record:
        return ", ".join(fields_of(rows.record))
    names = [part.name for part in rows.parts if isinstance(part, Field | Record)]
    return ", ".join(names)


# -- generated.py ------------------------------------------------------------------------------------------------------


def reader(layout: Layout, structs: Structs) -> list[str]:
    """The function that reads a message."""
    name, kind = snake(layout.record.__name__), layout.record.__name__
    reading = Reading(structs, constant(kind), 0, "    ")
    reading.head(layout.number)
    values = reading.read(unsigned(layout), layout.record, layout.not_sent)
    if reading.crc is not None:
        first, behind = (1 if layout.number < MORE else 2), reading.crc + 4
        covered = f"crc32(p[{first}:{reading.crc}])"
        if reading.at != str(behind):
            covered = f"crc32(p[{behind}:{reading.at}], {covered})"
        reading.add(f"if {covered} != crc:")
        reading.add(f'    raise MalformedError("a {layout.title} with a wrong checksum")')
    ends = f", {reading.at}" if unsigned(layout) != layout.parts else ""
    if reading.lines[-1].startswith("    at ") and not ends:
        reading.lines.pop()
    head = f"def _decode_{name}(p: bytes, now: float) -> {kind}:"
    if layout in KEYED:
        head = f"def decode_{name}(p: bytes) -> {f'tuple[{kind}, int]' if ends else kind}:"
    return [head, *docstring(layout, ends), *reading.lines, f"    return {call(layout.record, values)}{ends}"]


def unsigned(layout: Layout) -> tuple[Part, ...]:
    """The parts but for the signature that a record does not have."""
    last = layout.parts[-1]
    signed = isinstance(last, Field) and last.name == "signature"
    return layout.parts[:-1] if signed else layout.parts


def docstring(layout: Layout, ends: str) -> list[str]:
    """Of a function that others call."""
    ending = ", and where its signature begins" if ends else ""
    return [f'    """{layout.title}{ending}. struct.error: it is cut off."""'] if layout in KEYED else []


def writer(layout: Layout, structs: Structs) -> list[str]:
    """The function that writes a message."""
    name, kind = snake(layout.record.__name__), layout.record.__name__
    writing = Writing(structs, constant(kind))
    writing.head(layout.number)
    writing.parts(unsigned(layout), layout.record)
    tags = ", tags: Tags | None = None" if layout.tagged else ""
    names = [f"_{name}" if name in layout.not_sent else name for name in fields_of(layout.record)]
    head = f"def _encode_{name}(m: {kind}, now: float{tags}) -> list[bytes]:"
    if layout in KEYED:
        signed = " but for its signature" if unsigned(layout) != layout.parts else ""
        about = f'"""{layout.title}{signed}. ValueError or struct.error: our bug."""'
        head = f"def encode_{name}(m: {kind}) -> bytes:\n    {about}"
    lines = [head, f"    {', '.join(names)} = m"]
    if layout.frames:
        lines += [f"    {line}" for line in writing.lines]
        head = f"{constant(kind)}_FIELDS, {VERSION << 4 | layout.number:#04x}, sender, target"
        if layout.tagged:
            lines.append(f"    return tagged_frames({head}, {writing.rows}, tags)")
        else:
            bits = [(flag, bit) for part in layout.parts if isinstance(part, Field) for flag, bit in part.flags]
            flag = "".join(f", flag={bit:#x} if {flag} else 0" for flag, bit in bits)
            lines.append(f"    return frames({head}, {writing.rows}{flag})")
        return lines
    writing.flush()
    lines += [f"    {line}" for line in writing.lines]
    whole = " + ".join(writing.pieces)
    whole = f"fitting({whole})" if is_variable(layout.parts) else whole
    return [*lines, f"    return {whole}" if layout in KEYED else f"    return [{whole}]"]


def by_hand(layout: Layout, structs: Structs) -> list[str]:
    """What functions by hand need of a message."""
    name = constant(layout.record.__name__)
    parts, lines = layout.parts, []
    named = ("crc",) if layout in KEYED else fields_of(layout.record)
    for index, part in enumerate(parts):
        if isinstance(part, When):
            inner = [rows for rows in part.parts if isinstance(rows, Rows)]
            if inner:
                structs.named(part.name.upper(), fixed(part.parts))
            for rows in inner:
                structs.named(constant(row_name(rows)), fixed(rows.parts))
        if isinstance(part, Rows):
            structs.named(constant(row_name(part)), fixed(part.parts))
        if isinstance(part, Field) and part.name == "crc" and "crc" not in named:
            lines.append(f"{name}_CRC = {struct.calcsize('<B' + fixed(parts[:index]))}")
            parts = (*parts[:index], *parts[index + 1 :])
    structs.named(name, ("B" if layout.number < MORE else "BB") + fixed(parts))
    return lines


def row_functions(rows: Rows, structs: Structs) -> list[str]:
    """The functions that write and read rows whose size varies."""
    assert rows.record
    kind, name = rows.record.__name__, snake(rows.record.__name__)
    writing, reading = Writing(structs, constant(kind)), Reading(structs, constant(kind), None, "    ")
    writing.parts(rows.parts, rows.record)
    values = reading.read(rows.parts, rows.record, {})
    now = ", now: float" if has_age(rows.parts) else ""
    return [
        "",
        "",
        f"def {name}_bytes(row: {kind}{now}) -> bytes:",
        f'    """A {in_words(kind).lower()} as it travels."""',
        f"    {row_names(rows)} = row",
        *(f"    {line}" for line in writing.lines),
        f"    return {' + '.join(writing.pieces)}",
        "",
        "",
        f"def read_{name}(p: bytes, at: int{now}) -> tuple[{kind}, int]:",
        f'    """A {in_words(kind).lower()}, and where it ends."""',
        *reading.lines,
        f"    return {call(rows.record, values)}, at",
    ]


def records(parts: Sequence[Part]) -> Iterator[type]:
    """The records that parts hold."""
    for part in parts:
        if isinstance(part, Record | Rows):
            if part.record:
                yield part.record
            yield from records(part.parts)


def imports(layouts: Sequence[Layout]) -> list[str]:
    """Of all records, also of those that no function needs: `formatted` drops these."""
    found = {record for layout in layouts for record in (layout.record, *records(layout.parts))}
    return sorted(f"from {record.__module__} import {record.__name__}" for record in found)


def listed(values: Iterable[object]) -> str:
    """As they stand in a tuple."""
    return ", ".join(map(str, values))


def generated() -> str:
    """`rass_mav/wire/generated.py`."""
    structs = Structs()
    functions: list[str] = []
    plain = [layout for layout in MESSAGES if not layout.by_hand]
    more: list[str] = []
    for layout in MESSAGES:
        if layout.by_hand:
            more += by_hand(layout, structs)
    for layout in MESSAGES:
        for part in layout.parts:
            if isinstance(part, Rows) and not (layout.by_hand or part.hook) and is_variable(part.parts):
                functions += row_functions(part, structs)
    for layout in plain:
        functions += ["", "", *writer(layout, structs), "", "", *reader(layout, structs)]
    for block in BLOCKS:
        structs.named(f"{block.name.upper()}_BLOCK", fixed(block.parts))
    names = [layout.record.__name__ for layout in MESSAGES]
    numbers = [f"{constant(layout.record.__name__)} = {layout.number}" for layout in MESSAGES]
    with_sender = [
        layout for layout in MESSAGES if isinstance(first := layout.parts[0], Field) and first.name == "sender"
    ]
    targeted = [
        layout.number
        for layout in with_sender
        if isinstance(second := layout.parts[1], Field) and second.name == "target"
    ]
    text = "\n".join(
        [
            '"""Writing and reading plain messages: generated by tools/generate_wire.py from tools/wire_table.py."""',
            "",
            "from collections.abc import Callable",
            "from struct import Struct",
            "from zlib import crc32",
            "",
            *imports(MESSAGES),
            "from rass_mav.core.messages import BROADCAST, Message",
            "from rass_mav.errors import MalformedError",
            "",
            "from .parts import (OLDEST, Tags, age, bitmap_bytes, fitting, frames, read_bitmap, read_receipt_entry, "
            "receipt_entry_bytes, tagged_frames)",
            "",
            f"VERSION, MORE = {VERSION}, {MORE}",
            "",
            *numbers,
            "NUMBERS: dict[type, int] = {",
            *(f"    {name}: {constant(name)}," for name in names),
            "}",
            "#: Types that begin with a sender, and first bytes of those in which a target follows it.",
            f"WITH_SENDER = frozenset(({listed(layout.number for layout in with_sender if layout.number < MORE)}))",
            f"TARGETED = frozenset(({listed(f'{VERSION << 4 | n:#04x}' for n in targeted if n < MORE)}))",
            "#: Second bytes of the others, behind a head of type MORE.",
            f"FURTHER_TARGETED: frozenset[int] = frozenset([{listed(n for n in targeted if n > MORE)}])",
            "",
            "# Kinds of blocks",
            *(f"{block.name.upper()} = {block.kind}" for block in BLOCKS),
            "",
            *(f'{name} = Struct("<{codes}")' for name, codes in structs.formats.items()),
            *more,
            *functions,
            "",
            "",
            "ENCODERS: dict[type, Callable[..., list[bytes]]] = {",
            *(f"    {layout.record.__name__}: _encode_{constant(layout.record.__name__).lower()}," for layout in plain),
            "}",
            "WITH_TAGS: frozenset[type] = frozenset((",
            *(f"{layout.record.__name__}," for layout in plain if layout.tagged),
            "))",
            "DECODERS: dict[type, Callable[[bytes, float], Message]] = {",
            *(f"    {layout.record.__name__}: _decode_{constant(layout.record.__name__).lower()}," for layout in plain),
            "}",
            "",
        ]
    )
    return formatted(text)


def generated_keyed() -> str:
    """`rass_mav/wire/generated_keyed.py`."""
    structs = Structs()
    functions: list[str] = []
    for layout in KEYED:
        if layout.by_hand:
            by_hand(layout, structs)
        else:
            functions += ["", "", *writer(layout, structs), "", "", *reader(layout, structs)]
    lines = [
        '"""Writing and reading what is no message: generated by tools/generate_wire.py from tools/wire_table.py."""',
        "",
        "from struct import Struct",
        "",
        "from rass_mav.errors import MalformedError",
        "",
        *imports(KEYED),
        "from .parts import fitting",
        "",
        "# Types, in the second byte",
        *(f"{constant(layout.record.__name__)} = {layout.number}" for layout in KEYED),
        "",
        *(f'{name} = Struct("<{codes}")' for name, codes in structs.formats.items()),
        *functions,
        "",
    ]
    return formatted("\n".join(lines))


def layouts() -> str:
    """`rass_mav/core/news/layouts.py`: what the checksums of relayed messages cover."""
    codes = {layout.record: fixed(without_crc(layout.parts)) for layout in MESSAGES}
    rows = {rows.record: rows for layout in MESSAGES for rows in layout.parts if isinstance(rows, Rows)}
    codes[ReceiptEntry] = fixed(rows[ReceiptEntry].parts)
    # But for the number of the hand-over.
    codes[DeletionEntry] = fixed(without_crc(rows[DeletionEntry].parts[1:]))
    kinds = (Receipt, ReceiptEntry, SequenceMark, DeletionEntry)
    lines = [f'{constant(kind.__name__)} = Struct("<{codes[kind]}")' for kind in kinds]
    title = '"""What checksums cover: generated by tools/generate_wire.py from tools/wire_table.py."""'
    return formatted("\n".join([title, "", "from struct import Struct", "", *lines, ""]))


def without_crc(parts: Sequence[Part]) -> list[Part]:
    """The same but for the checksum."""
    return [part for part in parts if not isinstance(part, Field) or part.name != "crc"]


def formatted(text: str) -> str:
    """As ruff formats it, and without imports that nothing needs."""
    for command in (["check", "--fix", "--quiet", "--select", "F401,I"], ["format", "--quiet"]):
        arguments = [sys.executable, "-m", "ruff", *command, "--stdin-filename", "rass_mav/x.py", "-"]
        text = subprocess.run(arguments, input=text, capture_output=True, text=True, check=True, cwd=ROOT).stdout
    return text


# -- docs/protocol*.md -------------------------------------------------------------------------------------------------

_TABLE = ["| offset | type | field | unit, range |", "|---|---|---|---|"]
PAGES = ("docs/reference/protocol.md", "docs/reference/protocol-keys.md", "docs/explanation/policies.md")


class Page:
    """The rows of a layout's table on the page, and the tables of the rows in it."""

    def __init__(self, at: int = 0) -> None:
        self.rows: list[str] = []
        self.below: list[str] = []
        self._at: int | None = at

    def row(self, type_: str, title: str, about: str, size: int | None) -> None:
        """A row; `size`: None: it varies."""
        self.rows.append(
            re.sub("  +", " ", f"| {'then' if self._at is None else self._at} | {type_} | {title} | {about} |")
        )
        self._at = None if self._at is None or size is None else self._at + size

    def parts(self, parts: Sequence[Part]) -> Page:
        """The rows of parts."""
        for part in parts:
            if isinstance(part, Field):
                size = struct.calcsize(f"<{code(part)}")
                self.row(part.type.replace("x", "u"), title_of(part), part.about, size)
            elif isinstance(part, Age):
                self.row("u32", "age", "milliseconds; bit 31: at least", 4)
            elif isinstance(part, Record) and is_plain(part.parts):
                size = struct.calcsize(f"<{fixed(part.parts)}")
                self.row(f"{size} bytes", in_words(part.record.__name__).lower(), part.about, size)
            elif isinstance(part, Record):
                self.parts(part.parts)
            elif isinstance(part, Bytes):
                self.row("bytes", part.name, part.about, None)
            elif isinstance(part, Bitmap):
                self.row("u8", "size", f"bytes of bitmap, 0..{part.bits // 8}", 1)
                self.row("bytes", part.name, part.about, None)
            elif isinstance(part, Rows):
                self._rows(part)
            elif isinstance(part, When):
                self._when(part)
            elif isinstance(part, Blocks):
                self.row("", "[blocks](#blocks)", "up to the end", None)
            elif isinstance(part, Packed):
                self.row("", title_of(part), part.about, None)
        return self

    def _when(self, when: When) -> None:
        at, self._at = self._at, None
        inner = Page().parts(when.parts).rows
        for index, row in enumerate(inner):
            _, _, type_, title, about, _ = (cell.strip() for cell in row.split("|"))
            self._at = at if not index else None
            self.row(type_, title, f"{when.about}: {about}" if about else when.about, None)

    def _rows(self, rows: Rows) -> None:
        parts = (*rows.parts, rows.optional) if rows.optional else rows.parts
        varies = is_variable(parts) or rows.optional or any(isinstance(part, Packed) for part in parts)
        type_ = "" if varies else f"{struct.calcsize('<' + fixed(parts))} bytes each"
        if len(parts) == 1 or rows.about:
            self.row(type_, rows.name, rows.about, None)
            return
        self.row(type_, rows.name, rows.about or "below", None)
        self.below += ["", f"Each {rows.title.lower()}:", "", *_TABLE, *Page().parts(parts).rows]


def title_of(part: Field | Packed) -> str:
    """On the page."""
    return (isinstance(part, Field) and part.title) or part.name.replace("_", " ")


def pages() -> dict[str, str]:
    """The pages of the protocol with the layouts that the table gives, by path. The first two say once with what all
    messages begin."""
    return {path: filled(path, _tables(whole=path not in PAGES[:2])) for path in PAGES}


def _tables(*, whole: bool) -> dict[str, list[str]]:
    """The layouts by title, with the bytes that all messages begin with, or without."""
    found = {layout.title: on_page(layout, whole=whole) for layout in (*MESSAGES, *KEYED)}
    for block in BLOCKS:
        found[f"block {block.kind}"] = [*_TABLE, *Page().parts(block.parts).rows]
    return found


def on_page(layout: Layout, *, whole: bool) -> list[str]:
    """The tables of a layout."""
    page = Page()
    page.row("u8", "head", f"{VERSION << 4 | min(layout.number, MORE):#04x}", 1)
    if layout.number > MORE:
        page.row("u8", "type", f"{layout.number}", 1)
    page.parts(layout.parts)
    # Behind a type in the second byte, sender and target are not where they are in all others.
    known = 1 + len(TO) if layout.number < MORE and layout.parts[: len(TO)] == TO else 1
    return [*_TABLE, *page.rows[0 if whole else known :], *page.below]


# -- tools/rass.lua ----------------------------------------------------------------------------------------------------

SCRIPT = "tools/rass.lua"
#: Names of values that are written in the script by hand.
_VALUES = {"target": "TARGETS", "kind": "KINDS", "reason": "REASONS", "status": "STATUSES", "update.flags": "UPDATES"}
_AGE = Field("age", "u32", "ms", flags=(("at_least", 1 << 31),))


class Shown:
    """The fields of the dissector, by the name in it."""

    def __init__(self) -> None:
        self.fields: dict[str, Field] = {}
        self.flags: dict[str, tuple[str, int, int]] = {}

    def named(self, field: Field, hidden: int) -> str:
        """The name of a field without these bits."""
        key = name = field.key or field.name
        shown = replace(field, name=key, key=f"{hidden:#x}", title=title_of(field), flags=(), counts="")
        number = 2
        while name in self.fields and not alike(self.fields[name], shown):
            name, number = f"{key}_{number}", number + 1
        known = self.fields.setdefault(name, shown)
        if known.about != shown.about:
            # What it says in one message only does not go for all.
            self.fields[name] = replace(known, about="")
        return name

    def lines(self) -> list[str]:
        """Their declarations."""
        found = []
        for name, field in self.fields.items():
            about = field.about if len(field.about) < 50 and "below" not in field.about else ""
            label = title_of(field)
            label = label[0].upper() + label[1:] + (f": {about}" if about else "")
            if code(field).endswith("s"):
                found.append(f'field("{name}", ProtoField.bytes, "rass.{field.name}", "{label}")')
                continue
            hidden, size = int(field.key, 16), int(field.type[1:])
            more = [f"base.{'HEX' if field.type[0] == 'x' else 'DEC'}", _VALUES.get(field.name, "nil")]
            more.append(f"{(1 << size) - 1 - hidden:#x}" if hidden else "nil")
            while more[-1] == "nil":
                more.pop()
            shown = f", {', '.join(more)}" if more != ["base.DEC"] else ""
            found.append(f'field("{name}", ProtoField.uint{size}, "rass.{field.name}", "{label}"{shown})')
        for name, (label, size, bit) in self.flags.items():
            found.append(f'field("{name}", ProtoField.bool, "rass.{name}", "{label}", {size}, nil, {bit:#x})')
        return found


def alike(one: Field, other: Field) -> bool:
    """Whether one field of the dissector does for both."""
    return (one.type, one.key) == (other.type, other.key)


def steps(parts: Sequence[Part], shown: Shown, counts: dict[str, str] | None = None) -> list[str]:
    """The parts as the dissector reads them. `counts`: the fields around them that say how many rows there are."""
    found: list[str] = []
    here = {part.counts or part.name: part.name for part in parts if isinstance(part, Field)}
    counts = {**(counts or {}), **here}
    for part in parts:
        if isinstance(part, Field | Age):
            found.append(step(_AGE if isinstance(part, Age) else part, shown))
        elif isinstance(part, Record):
            found += steps(part.parts, shown)
        elif isinstance(part, Bytes) and part.to_the_end:
            name = shown.named(Field(part.name, "0 bytes"), 0)
            found.append(f'{{ "{name}", rest = true }}')
        elif isinstance(part, Bitmap):
            found.append(f"{{ bitmap = {part.bits // 8} }}")
        elif isinstance(part, Rows):
            inner = ", ".join(steps(part.parts, shown))
            last = ""
            if part.optional:
                [flag] = [name for one in parts if isinstance(one, Field) for name, _ in one.flags]
                last = f', flag = "{flag}", last = {step(part.optional, shown)}'
            most = f", most = {part.most}" if part.most else ""
            found.append(f'{{ rows = "{counts[part.name]}", title = "{part.title}", {{ {inner} }}{most}{last} }}')
        elif isinstance(part, When):
            unless = ", unless = true" if part.unless else ""
            found.append(f'{{ when = "{part.name}", {{ {", ".join(steps(part.parts, shown, counts))} }}{unless} }}')
        elif isinstance(part, Bytes | Packed | Blocks):
            hook = "blocks" if isinstance(part, Blocks) else part.hook if isinstance(part, Bytes) else part.name
            found.append(f'{{ hook = "{hook}" }}')
    return found


def step(field: Field, shown: Shown) -> str:
    """A field as the dissector reads it."""
    size = struct.calcsize(f"<{code(field)}")
    key = field.key or field.name
    hidden = sum(bit for flag, bit in field.flags if not flag.startswith(f"{key}."))
    name = shown.named(field, hidden)
    more = [f'"{name}", {size}']
    if field.name != name:
        more.append(f'name = "{field.name}"')
    if field.least:
        more.append(f"least = {field.least}")
    if field.most:
        more.append(f"most = {field.most}")
    for flag, bit in field.flags:
        label = in_words(flag.rpartition(".")[2])
        shown.flags[flag] = (label, 8 * size, bit)
    if code(field).endswith("s"):
        more.append("bytes = true")
    if field.flags:
        more.append(f"flags = {{ {', '.join(f'{chr(34)}{flag}{chr(34)}, {bit:#x}' for flag, bit in field.flags)} }}")
    if hidden:
        more.append(f"hidden = {hidden:#x}")
    return f"{{ {', '.join(more)} }}"


def script() -> str:
    """`tools/rass.lua` with the fields and layouts that the table gives."""
    shown = Shown()
    layouts, blocks = [], []
    for layout in (*MESSAGES, *KEYED):
        layouts.append(f"LAYOUTS[{layout.number}] = {{ {', '.join(steps(layout.parts, shown))} }}")
    for block in BLOCKS:
        again = ", again = true" if block.again else ""
        size = struct.calcsize(f"<{fixed(block.parts)}")
        inner = ", ".join(steps(block.parts, shown))
        blocks.append(f"BLOCKS[{block.kind}] = {{ least = {size}{again}, {{ {inner} }} }}")
    types = [f'[{layout.number}] = "{layout.title}"' for layout in (*MESSAGES, *KEYED)]
    names = [f'[{block.kind}] = "{block.title}"' for block in BLOCKS]
    text = (ROOT / SCRIPT).read_text(encoding="utf-8")
    for name, lines in {
        "names": [
            f"local TYPES = {{ {', '.join(types)} }}",
            f"local BLOCK_KINDS = {{ {', '.join(names)} }}",
            f"local VERSION, MORE = {VERSION}, {MORE}",
        ],
        "fields": shown.lines(),
        "layouts": [*layouts, *blocks],
    }.items():
        first, last = f"-- {name}: from the table of messages, by tools/generate_wire.py\n", f"-- end of {name}\n"
        before, rest = text.split(first)
        wrapped = "\n".join(wrap(line) for line in lines)
        text = f"{before}{first}{wrapped}\n{last}{rest.split(last)[1]}"
    return text


def wrap(line: str) -> str:
    """The same in lines of at most 120 characters; what stands in the innermost braces is not parted."""
    whole = re.sub(r'"[^"]*"|\{[^{}]*\},?', lambda found: found[0].replace(" ", "\0"), line)
    return "\n    ".join(textwrap.wrap(whole, 116, break_long_words=False, break_on_hyphens=False)).replace("\0", " ")


def files() -> dict[str, str]:
    """The files that follow from the table, and what is in them."""
    return {
        "rass_mav/core/news/layouts.py": layouts(),
        "rass_mav/wire/generated.py": generated(),
        "rass_mav/wire/generated_keyed.py": generated_keyed(),
        **pages(),
        SCRIPT: script(),
    }


def main() -> None:
    """Writes them, unless two kinds have one number."""
    known: dict[int, Layout] = {}
    for layout in (*MESSAGES, *KEYED):
        if (other := known.setdefault(layout.number, layout)) is not layout:
            sys.exit(
                f"tools/wire_table.py: {other.record.__name__} and {layout.record.__name__} have the same number, "
                f"{layout.number}"
            )
    write(files())


if __name__ == "__main__":
    main()

"""What follows from the table of messages is committed as the table gives it: `python -m tools.generate_wire`."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from rass_mav.errors import MalformedError
from rass_mav.wire import generated
from tools import generate_wire
from tools.generate_wire import Page, Shown, Structs, files, on_page, reader, steps, writer
from tools.wire_table import MESSAGES, TO, Field, Layout, Rows, count

ROOT = Path(__file__).parents[2]
FILES = files()


@pytest.mark.parametrize("name", FILES)
def test_it_is_what_the_table_gives(name: str) -> None:
    assert (ROOT / name).read_text(encoding="utf-8") == FILES[name], "run: python -m tools.generate_wire"


def test_a_number_stands_once(monkeypatch: pytest.MonkeyPatch) -> None:
    written: list[object] = []
    monkeypatch.setattr(generate_wire, "write", written.append)
    monkeypatch.setattr(generate_wire, "MESSAGES", (*MESSAGES, Layout(254, Wish, TO)))
    with pytest.raises(SystemExit, match=r"^tools/wire_table\.py: Wish and Introduction have the same number, 254$"):
        generate_wire.main()
    assert written == []


class Wish(NamedTuple):
    sender: int
    target: int
    flags: int
    urgent: bool
    rows: tuple[tuple[int, bytes], ...]


ROWS = Rows("rows", "Row", (Field("kind", "u8"), Field("hash", "4 bytes")), most=3)
FLAGS = Field("flags", "u8", flags=(("urgent", 0x80),), most=0x8F)
WISH = Layout(17, Wish, (*TO, FLAGS, count("rows", "so many"), ROWS))


def test_a_new_message_is_one_declaration() -> None:
    structs = Structs()
    source = "\n".join([*writer(WISH, structs), *reader(WISH, structs)])
    made: dict[str, Any] = {**vars(generated), "Wish": Wish}
    made |= {name: struct.Struct(f"<{codes}") for name, codes in structs.formats.items()}
    exec(source, made)
    wish = Wish(3, 2, 1, True, ((4, b"four"), (5, b"five")))
    [payload] = made["_encode_wish"](wish, 0.0)
    assert payload == b"\x4f\x11\x03\x00\x02\x00\x81\x02\x04four\x05five"
    assert made["_decode_wish"](payload, 0.0) == wish
    with pytest.raises(struct.error):
        made["_decode_wish"](payload[:-1], 0.0)
    for at, bad in ((6, 0x90), (7, 4)):
        with pytest.raises(MalformedError):
            made["_decode_wish"](payload[:at] + bytes([bad]) + payload[at + 1 :].ljust(60), 0.0)
    with pytest.raises(ValueError, match="4 rows"):
        made["_encode_wish"](wish._replace(rows=wish.rows * 2), 0.0)
    assert Page(2).parts(WISH.parts).rows[2:] == [
        "| 6 | u8 | flags | |", "| 7 | u8 | count | so many |", "| 8 | 5 bytes each | rows | below |",
    ]  # fmt: skip
    assert steps(WISH.parts, Shown())[2:4] == [
        '{ "flags", 1, most = 143, flags = { "urgent", 0x80 }, hidden = 0x80 }', '{ "count", 1 }',
    ]  # fmt: skip


def test_a_page_shows_the_sender_and_the_target_where_the_type_is_in_the_second_byte() -> None:
    """There they are not at the offsets that docs/reference/protocol.md gives once for all."""
    to = ["| 2 | u16 | sender | |", "| 4 | u16 | target | |", "| 6 | u8 | flags | |"]
    assert on_page(WISH, whole=False)[2:6] == ["| 1 | u8 | type | 17 |", *to]
    assert on_page(replace(WISH, number=12), whole=False)[2] == "| 5 | u8 | flags | |"

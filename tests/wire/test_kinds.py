"""Every kind of message is known to everybody who has to know it: whoever adds one is told here what is missing."""

from __future__ import annotations

import re
import typing
from pathlib import Path

import pytest

from rass_mav.app import linkqueue as link_queue
from rass_mav.core import node, stigmergy
from rass_mav.core.datum import Kind
from rass_mav.core.messages import KINDS, CopyStatus, Message, Target, Urgency
from rass_mav.lab.fleet.air_server import AirOrder, MockAir
from rass_mav.lab.swarm.scenario import Scenario
from rass_mav.link.budget import MAX_WAITING
from rass_mav.mavlink.frames import FrameWriter
from rass_mav.wire import encode
from rass_mav.wire.codec import MORE, MORE_HEAD, NUMBERS
from tests.core.build import make_node, make_stigmergy_node
from tools import explain_frame

from .kinds import beside, blocks, examples, modules, page, type_of
from .samples import HELLO, NOW, SAMPLES, SEALED_READING, SEALED_TERMS, by_type

ROOT = Path(__file__).parents[2]
UNION = set(typing.get_args(Message))
TITLES = {number: re.sub(r"(?<=[a-z])([A-Z])", r" \1", kind.__name__).capitalize() for kind, number in NUMBERS.items()}
BESIDE = beside()
#: Of a message that older programs send and this one ignores.
NOT_USED = 12
EVERYONE = pytest.mark.parametrize("name", SAMPLES)


def test_every_kind_says_what_it_is_and_how_it_travels() -> None:
    assert KINDS.keys() == UNION
    assert NUMBERS.keys() == UNION
    assert sorted([*TITLES, NOT_USED, MORE]) == list(range(1, len(UNION) + 3)), "each given once"


def test_every_kind_has_a_sample_and_can_be_drawn() -> None:
    assert {type(message) for message in SAMPLES.values()} == UNION
    assert by_type.keys() == UNION


@EVERYONE
def test_the_target_is_where_the_kind_says(name: str) -> None:
    message = SAMPLES[name]
    target = KINDS[type(message)].target
    assert hasattr(message, "target") == (target is not Target.EVERYBODY)
    if target is Target.NAMED:
        [payload] = encode(message, NOW)
        at = 3 if NUMBERS[type(message)] < MORE else 4
        assert int.from_bytes(payload[at : at + 2], "little") == message.target  # type: ignore[union-attr]


def test_every_participant_takes_every_kind_in() -> None:
    assert node.HANDLERS.keys() == stigmergy.HANDLERS.keys() == UNION


@pytest.mark.no_cover
@pytest.mark.parametrize("options", [{}, {"base": True}, {"mirror": True}, {"mirror": False, "receipts": False}])
@EVERYONE
def test_every_node_hears_every_kind(name: str, options: dict[str, typing.Any]) -> None:
    for participant in (make_node(2, **options), make_stigmergy_node(2)):
        for answer in participant.receive(SAMPLES[name], NOW):
            assert type(answer) in UNION


@EVERYONE
def test_what_is_counted_on_the_air_knows_every_kind(name: str) -> None:
    [payload] = encode(SAMPLES[name], NOW)
    air = MockAir(AirOrder(Scenario(nodes=2)))
    try:
        air._count(FrameWriter(7, 191).tunnel(payload, payload_type=33200))
    finally:
        air.close()
    assert air.counted.malformed == 0
    carries = any(part in payload for part in (HELLO.payload, SEALED_READING.payload, SEALED_TERMS.payload, b"chunk"))
    assert (air.counted.data_sent > 0) == carries


def test_what_a_link_counts_and_keeps_has_a_place_for_every_urgency() -> None:
    assert {about.urgency for about in KINDS.values()} | {Urgency.VEHICLE} == set(Urgency)
    assert len(MAX_WAITING) == len(link_queue._KINDS) == len(Urgency)


@EVERYONE
def test_the_explainer_knows_every_kind_and_status(name: str) -> None:
    [payload] = encode(SAMPLES[name], NOW)
    first, *_ = explain_frame.explain_payload(payload)
    number = NUMBERS[type(SAMPLES[name])]
    assert first.startswith(f"{TITLES[number]} (type {number}, ")
    assert explain_frame._COPY_STATUSES.keys() == set(CopyStatus)


def test_the_page_and_the_code_have_the_same_kinds_of_payloads_and_blocks() -> None:
    on_the_page = {int(number) for number in re.findall(r"^\| 1 \| u8 \| type \| (\d+) \|$", page(), re.M)}
    assert on_the_page == BESIDE.keys() | {number for number in TITLES if number > 15}
    # Whatever a module of the wire takes for its own.
    doors = [getattr(module, name) for module in modules() for name in vars(module) if name.startswith("is_")]
    taken = {second for second in range(256) if any(door(MORE_HEAD + bytes((second, *bytes(126)))) for door in doors)}
    assert taken == BESIDE.keys()
    shown = {type_of(payload) for payload in examples().values()}
    assert shown == BESIDE.keys() | TITLES.keys()
    [table] = re.findall(r"^\| kind \| content \| after \|\n(.*?)\n\n", page(), re.M | re.S)
    assert set(re.findall(r"^\| (\d) \|", table, re.M)) == {str(number) for number in blocks()}


def test_the_explainer_knows_all_that_travels() -> None:
    assert explain_frame._READERS.keys() == BESIDE.keys()
    assert explain_frame._CONTENTS.keys() == {Kind.MEASUREMENT, Kind.STATUS}


def test_the_dissector_knows_what_the_table_does_not_give() -> None:
    text = (ROOT / "tools" / "rass.lua").read_text(encoding="utf-8")
    [statuses] = re.findall(r"local STATUSES = \{(.*?)\}", text)
    assert dict(re.findall(r'\[(\d)\] = "(\w+)"', statuses)) == {str(int(one)): one.name.lower() for one in CopyStatus}


def rests(message: Message) -> str:
    """In the words of the page."""
    data = KINDS[type(message)].rests(message)
    return "all changes" if data is None else "its data" if list(data) else "nothing"


def test_the_page_says_of_every_kind_what_the_code_says() -> None:
    text = page().split("## Messages")[1]
    rows = re.findall(r"^\| (\d+) \| ([\w ]+) \| (\w+) \| (\w+) \| ([\w ]+) \| .+ \|$", text, re.M)
    assert {int(number): title for number, title in re.findall(r"^### (\d+) ([\w ]*\w)", text, re.M)} == TITLES
    assert {int(number): title for number, title, *_ in rows} == TITLES
    said = {int(number): cells for number, _, *cells in rows}
    for kind, (target, urgency, _) in KINDS.items():
        to, haste, on = said[NUMBERS[kind]]
        assert to == {Target.NAMED: "target"}.get(target, target.name.lower())
        assert haste == urgency.name.lower()
        assert set(on.split(" or ")) == {rests(message) for message in SAMPLES.values() if type(message) is kind}

"""What goes to the ground is paced, fair and bounded; texts are few enough to be read."""

from __future__ import annotations

import math
from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from rass_mav.agent.outgoing import Way
from rass_mav.mavlink.frames import FrameReader, FrameWriter
from rass_mav.mavlink.messages import NAMED_VALUE_FLOAT, STATUSTEXT
from rass_mav.station.outbox import GAP_S, MAX_ANSWERS, Outbox
from rass_mav.station.texts import BURST, EVERY_S, MAX_WAITING, REPEAT_S, Text, Texts
from tests.some import some

SIZE = 5
ANSWER, SAID, LISTED = STATUSTEXT, NAMED_VALUE_FLOAT, 22

WRITER = FrameWriter(7, 191)


def outbox() -> Outbox:
    return Outbox(Way.VEHICLE, lambda index: (LISTED, bytes([index + 1])), SIZE)


def drain(box: Outbox, now: float = 0.0) -> list[tuple[float, int, bytes]]:
    """All that leaves, and when: woken up exactly when the box asks for it."""
    reader = FrameReader()
    out = []
    while (due := box.due()) < math.inf:
        now = max(now, due)
        outgoing = box.take(now, WRITER)
        assert outgoing is not None, "it asked for this moment"
        [frame] = reader.feed(outgoing.frame)
        out.append((now, frame.message_id, frame.payload.rstrip(b"\0")))
    return out


@given(st.lists(st.sampled_from(["answer", "say", "list"]), max_size=60))
def test_frames_leave_one_by_one_and_nothing_is_said_twice(asked: list[str]) -> None:
    box = outbox()
    for number, what in enumerate(asked, 1):
        if what == "list":
            box.list_all()
        else:
            getattr(box, what)(ANSWER if what == "answer" else SAID, bytes([number]))
    out = drain(box)
    assert all(later - before >= GAP_S - 1e-9 for (before, _, _), (later, _, _) in pairwise(out))
    kept = {what: asked.count(what) for what in ("answer", "say")}
    assert sum(m == ANSWER for _, m, _ in out) == min(kept["answer"], MAX_ANSWERS)
    assert len(out) + box.dropped == kept["answer"] + kept["say"] + SIZE * ("list" in asked)
    assert [p[0] for _, m, p in out if m == LISTED] == list(range(1, SIZE + 1)) * ("list" in asked)


def test_a_question_that_comes_doubled_is_answered_once() -> None:
    box = outbox()
    for _ in range(10):
        box.answer(ANSWER, b"\x01")
    assert len(drain(box)) == 1
    box.answer(ANSWER, b"\x01")
    assert len(drain(box)) == 1, "but again when it is asked later"


def test_a_listing_asked_for_again_and_again_comes_to_its_end() -> None:
    box = outbox()
    listed = []
    for turn in range(2 * SIZE):
        if turn < SIZE:
            box.list_all()
        outgoing = box.take(turn * GAP_S, WRITER)
        if outgoing is not None:
            listed.append(FrameReader().feed(outgoing.frame)[0].payload[0])
    assert listed == [1, 2, 3, 4, 5, 1, 2, 3, 4]


def test_questions_cannot_silence_what_is_said() -> None:
    box = outbox()
    box.list_all()
    box.say(SAID, b"\x01")
    first = []
    for turn in range(6):
        for number in range(MAX_ANSWERS):
            box.answer(ANSWER, bytes([turn, number + 1]))
        outgoing = some(box.take(turn * GAP_S, WRITER))
        first.append(FrameReader().feed(outgoing.frame)[0].message_id)
    assert SAID in first
    assert LISTED in first


def said(texts: Texts, until: float) -> list[tuple[float, Text]]:
    out = []
    now = 0.0
    while now <= until:
        text = texts.take(now)
        if text is not None:
            out.append((now, text))
            continue
        now = max(texts.due(), now + 0.01)
    return out


@given(st.lists(st.tuples(st.integers(0, 7), st.sampled_from("abcdefghijklmnop")), max_size=50))
def test_texts_come_at_a_rate_that_can_be_read_and_the_gravest_stay(added: list[tuple[int, str]]) -> None:
    texts = Texts()
    for severity, text in added:
        texts.add(severity, text)
    out = said(texts, MAX_WAITING * EVERY_S + 1)
    for now, _ in out:
        assert sum(now <= at < now + EVERY_S for at, _ in out) <= BURST + 1
    assert len(out) == min(len(set(added)), MAX_WAITING)
    assert texts.dropped == len(added) - len(out)
    severities = sorted(severity for severity, _ in set(added))[: len(out)]
    assert [text.severity for _, text in out] == severities


def test_the_same_text_is_repeated_after_a_while_only() -> None:
    texts = Texts()
    for now, expected in ((0.0, 1), (REPEAT_S / 2, 0), (REPEAT_S + 1, 1)):
        texts.add(2, "disk full")
        assert sum(texts.take(now) is not None for _ in range(3)) == expected


@given(st.lists(st.floats(0.0, 10.0), min_size=BURST, max_size=MAX_WAITING), st.floats(0.0, 1e6))
def test_a_text_is_there_at_the_time_at_which_it_is_due(pauses: list[float], now: float) -> None:
    texts = Texts()
    for number, pause in enumerate(pauses):
        texts.add(6, str(number))
        while texts.take(now) is not None:
            pass
        assert texts.due() > now, "or it would be asked for ever"
        now += pause
    while (due := texts.due()) != math.inf:
        assert texts.take(due) is not None

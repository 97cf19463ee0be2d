"""What counters say, and what is made of it: whole, byte by byte, and when it is garbage."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pkgutil import resolve_name

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.errors import MalformedError
from rass_mav.sensor.bgeigie import Bgeigie, decode_record, fields_of, rate_of
from rass_mav.sensor.gmc import MAX_ANSWER, POLL_S, QUIET_S, Gmc, decode_cpm, decode_version
from rass_mav.sensor.kinds import KINDS
from rass_mav.sensor.mightyohm import MightyOhm, decode_line
from rass_mav.sensor.protocol import MAX_LINE, Lines, Protocol, Sample
from rass_mav.sensor.radpro import RadPro, decode_answer

from .sentences import sentence

#: What each decoder takes for good, as seeds for the fuzzer.
DECODERS: dict[str, tuple[Callable[[bytes], object], bytes]] = {
    "mightyohm": (decode_line, b"CPS, 0, CPM, 13, uSv/hr, 0.07, SLOW"),
    "gmc version": (decode_version, b"GMC-300Re 4.20"),
    "gmc 2": (lambda data: decode_cpm(data, 2), b"\x00\x1c"),
    "gmc 4": (lambda data: decode_cpm(data, 4), b"\x00\x00\x00\x1c"),
    "radpro": (decode_answer, b"OK 142.857"),
    "bgeigie fields": (lambda data: rate_of(fields_of(data) or [b""] * 7), sentence()),
    "bgeigie": (decode_record, sentence()),
}


@pytest.mark.no_cover
@pytest.mark.parametrize("name", DECODERS)
@given(st.data())
def test_any_bytes_decode_or_raise_the_one_error(name: str, data: st.DataObject) -> None:
    decode, good = DECODERS[name]
    decode(good)
    changed = bytearray(good)
    for place, value in data.draw(st.lists(st.tuples(st.integers(0, len(good) - 1), st.integers(0, 255)), max_size=4)):
        changed[place] = value
    for raw in (data.draw(st.binary(max_size=300)), bytes(changed), good[: data.draw(st.integers(0, len(good)))]):
        try:
            decode(raw)
        except MalformedError as error:
            assert "\n" not in str(error)  # noqa: PT017


def weight(reader: object) -> int:
    """Bytes of all that it remembers."""
    return len(pickle.dumps(reader))


def talk(protocol: Protocol, chunks: list[bytes]) -> list[Sample]:
    """All chunks within an instant, and then time to think."""
    protocol.ask(5.0)
    samples = [sample for chunk in chunks for sample in protocol.feed(chunk, 5.0)]
    return samples + protocol.feed(b"", 5.0 + 2 * QUIET_S)


@pytest.mark.parametrize("protocol", [kind.protocol for kind in KINDS.values() if kind.protocol])
@given(st.binary(max_size=600), st.data())
def test_a_stream_is_the_same_whole_and_byte_by_byte(protocol: str, garbage: bytes, data: st.DataObject) -> None:
    good = data.draw(st.sampled_from([b"", b"OK 1.5\r\n", b"GMC-500+Re 1.18", sentence() + b"\r\n",
                                      b"CPS, 1, CPM, 60, uSv/hr, 0.34, FAST\r\n"]))  # fmt: skip
    stream = data.draw(st.sampled_from([garbage + b"\n" + good, good + garbage, good + good]))
    whole, parted = resolve_name(protocol)(), resolve_name(protocol)()
    samples = talk(whole, [stream])
    assert samples == talk(parted, [bytes([byte]) for byte in stream])
    assert (whole.heard, whole.malformed, whole.trouble) == (parted.heard, parted.malformed, parted.trouble)
    assert all(sample.cpm >= 0.0 for sample in samples)


@given(st.lists(st.binary(max_size=700), max_size=8))
def test_lines_hold_little_whatever_comes(chunks: list[bytes]) -> None:
    lines = Lines()
    found = [line for chunk in chunks for line in lines.feed(chunk)]
    assert weight(lines) <= weight(Lines()) + MAX_LINE + 8
    stream = b"".join(chunks)
    complete = stream.split(b"\n")[:-1]
    assert found == [line.strip() for line in complete if line.strip() and len(line) <= MAX_LINE]
    assert lines.overlong == sum(len(line) > MAX_LINE for line in stream.split(b"\n"))


# -- MightyOhm ---------------------------------------------------------------------------------------------------------


def test_mightyohm_says_its_counts_a_minute() -> None:
    protocol = MightyOhm()
    assert protocol.ask(0.0) == b""
    # The port was opened in the middle of a line.
    said = (
        b"uSv/hr, 0.07, SLOW\r\nCPS, 0, CPM, 13, uSv/hr, 0.07, SLOW\r\nCPS, 300, CPM, 18000, uSv/hr, 102.60, INST\r\n"
    )
    assert protocol.feed(said, 7.0) == [Sample(13.0, 7.0), Sample(18000.0, 7.0)]
    assert (protocol.heard, protocol.malformed, protocol.trouble) == (2, 1, "")


@pytest.mark.parametrize(
    "line",
    [b"CPS, 0, CPM, , uSv/hr, 0.07, SLOW", b"CPS, 0, CPM, -13, uSv/hr, 0.07, SLOW", b"CPS, 0, CPM, 13, uSv/hr, 0.07",
     b"CPS, 0, CPM, 1e3, uSv/hr, 0.07, SLOW", b"CPS, 0, CPM, 13, uSv/hr, 0.07, SLOWCPS, 0", "CPM, ٣".encode()],
)  # fmt: skip
def test_mightyohm_lines_that_are_none(line: bytes) -> None:
    with pytest.raises(MalformedError, match="expected 'CPS"):
        decode_line(line)


# -- GQ GMC ------------------------------------------------------------------------------------------------------------


def known_gmc(version: bytes) -> Gmc:
    """A counter that has said who it is, by t = 1."""
    gmc = Gmc()
    assert gmc.ask(0.0) == b"<HEARTBEAT0>><GETVER>>"
    gmc.feed(version, 0.1)
    assert gmc.feed(b"", 0.5) == []
    assert gmc.heard == 1
    assert gmc.ask(1.0) == b"<GETCPM>>"
    return gmc


@pytest.mark.parametrize(
    ("version", "answer", "cpm"),
    [(b"GMC-280Re 2.0x", b"\x00\x1c", 28.0), (b"GMC-300Re 4.20", b"\x01\x00", 256.0),
     (b"GMC-320Re 4.19", b"\xff\xff", 65535.0), (b"GMC-500+Re 1.18", b"\x00\x00\x00\x1c", 28.0),
     (b"GMC-600+Re 2.22", b"\x00\x01\x00\x00", 65536.0)],
)  # fmt: skip
def test_gmc_answers_have_the_length_of_their_model(version: bytes, answer: bytes, cpm: float) -> None:
    gmc = known_gmc(version)
    assert gmc.feed(answer, 1.1) == []
    assert gmc.feed(b"", 1.2) == [], "perhaps something follows"
    assert gmc.feed(b"", 1.4) == [Sample(cpm, 1.1)]


def test_gmc_answers_of_another_length_are_not_read() -> None:
    # Read as two bytes, this would be a rate of 0.
    gmc = known_gmc(b"GMC-300Re 4.20")
    gmc.feed(b"\x00\x00\x10\x00", 1.1)
    assert gmc.feed(b"", 2.0) == []
    assert (gmc.malformed, gmc.trouble) == (1, r"expected 2 bytes, got 4: '\x00\x00\x10\x00'")
    assert gmc.ask(1.0 + POLL_S) == b"<GETCPM>>"


def test_gmc_late_bytes_do_not_become_the_next_answer() -> None:
    gmc = known_gmc(b"GMC-300Re 4.20")
    assert gmc.feed(b"\x00", 1.99) == []
    assert gmc.ask(2.0) == b"<GETCPM>>"
    assert gmc.malformed == 1
    gmc.feed(b"\x1c", 2.01)
    gmc.feed(b"\x00\x1c", 2.05)
    assert gmc.feed(b"", 2.5) == []
    assert gmc.malformed == 2
    gmc.ask(3.0)
    gmc.feed(b"\x00\x1c", 3.05)
    assert gmc.feed(b"", 3.5) == [Sample(28.0, 3.05)]


def test_gmc_is_asked_who_it_is_until_it_says_so() -> None:
    gmc = Gmc()
    asked = [gmc.ask(t) for t in (0.0, 0.5, 1.0, 2.0)]
    assert asked == [b"<HEARTBEAT0>><GETVER>>", b"", b"<GETVER>>", b"<GETVER>>"]
    gmc.feed(b"GMC-999", 2.1)
    assert gmc.feed(b"", 2.5) == []
    assert gmc.malformed == 1
    assert gmc.ask(3.0) == b"<GETVER>>"


def test_gmc_that_never_stops_talking_fills_no_memory() -> None:
    gmc = known_gmc(b"GMC-500+Re 1.18")
    for n in range(1000):
        assert gmc.feed(b"\x00\x07" * 50, 1.0 + n / 2000) == []
    assert weight(gmc) <= weight(Gmc()) + MAX_ANSWER + 32
    gmc.ask(2.0)
    assert gmc.trouble.startswith("an answer without an end")


# -- Rad Pro -----------------------------------------------------------------------------------------------------------


def test_radpro_is_asked_for_its_sensitivity_and_then_for_its_rate() -> None:
    radpro = RadPro()
    assert radpro.ask(0.0) == b"GET tubeSensitivity\r\n"
    assert radpro.feed(b"OK 153.800\r\n", 0.1) == []
    assert radpro.ask(0.1) == b"GET tubeRate\r\n"
    assert radpro.ask(0.2) == b""
    assert radpro.feed(b"OK 142.857\r\n", 0.2) == [Sample(142.857, 0.2, 153.8)]
    assert radpro.ask(1.2) == b"GET tubeRate\r\n"


def test_radpro_that_does_not_know_its_sensitivity() -> None:
    radpro = RadPro()
    radpro.ask(0.0)
    assert radpro.feed(b"ERROR\r\n", 0.1) == []
    assert radpro.malformed == 0
    radpro.ask(0.2)
    assert radpro.feed(b"OK 20\r\n", 0.3) == [Sample(20.0, 0.3, None)]


def test_radpro_late_answers_are_not_taken_for_the_next_question() -> None:
    radpro = RadPro()
    assert radpro.ask(0.0) == b"GET tubeSensitivity\r\n"
    assert radpro.ask(1.0) == b"", "a second of silence"
    # The sensitivity, too late: it must not become a rate of 153.8 counts.
    assert radpro.feed(b"OK 153.800\r\n", 1.1) == []
    assert radpro.malformed == 1
    assert radpro.ask(2.0) == b"GET tubeSensitivity\r\n"
    radpro.feed(b"OK 153.800\r\n", 2.1)
    assert radpro.ask(2.2) == b"GET tubeRate\r\n"
    assert radpro.feed(b"ERROR\r\n", 2.3) == []
    assert radpro.trouble == "the counter answered ERROR when asked for the rate"


@pytest.mark.parametrize("line", [b"OK", b"OK -1", b"OK nan", b"OK 1e9", b"ok 1", b"OK 1 2", b"OK 1.", b""])
def test_radpro_answers_that_are_none(line: bytes) -> None:
    with pytest.raises(MalformedError, match="expected 'OK value'"):
        decode_answer(line)


# -- bGeigie, live -----------------------------------------------------------------------------------------------------


def test_bgeigie_tells_its_rate_once_its_first_minute_is_over() -> None:
    bgeigie = Bgeigie()
    assert bgeigie.feed(b"# NEW LOG\r\n" + sentence(valid=b"V") + b"\r\n", 1.0) == []
    assert (bgeigie.heard, bgeigie.malformed) == (2, 0), "it lives"
    assert bgeigie.feed(sentence(cpm=42) + b"\r\n", 6.0) == [Sample(42.0, 6.0)]


def test_bgeigie_needs_no_place_and_no_time_when_it_is_live() -> None:
    said = sentence(cpm=7, time=b"2012-00-00T00:00:00Z", latitude=b"", longitude=b"-07355.3663", fix=b"V")
    assert Bgeigie().feed(said + b"\r\n", 1.0) == [Sample(7.0, 1.0)]

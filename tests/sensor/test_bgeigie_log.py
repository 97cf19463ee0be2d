"""bGeigie logs: every header and firmware, and every kind of damage."""

from __future__ import annotations

import io
from datetime import datetime, timezone
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.errors import ConfigError, LogError, MalformedError
from rass_mav.sensor.bgeigie import HEADERS, Place, Record, decode_record
from rass_mav.sensor.bgeigie_log import BgeigieLog, load_bgeigie, read_bgeigie
from rass_mav.sensor.protocol import MAX_LINE
from tests.some import some

from .sentences import checked, sentence

SAMPLES = Path(__file__).parents[3] / "shared" / "data" / "bgeigie"
TIME_US = int(datetime(2012, 9, 20, 15, 13, 40, tzinfo=timezone.utc).timestamp()) * 1_000_000


def read(*lines: bytes, end: bytes = b"\r\n") -> BgeigieLog:
    log = read_bgeigie(io.BytesIO(end.join(lines) + end))
    assert log.read == len(log.records) + log.rejected
    assert bool(log.rejected) == bool(log.trouble)
    return log


def at(second: int) -> bytes:
    return b"2012-09-20T15:%02d:%02dZ" % divmod(13 * 60 + 40 + second, 60)


def test_a_sentence_in_full() -> None:
    record = some(decode_record(b"$BNRDD,204,2012-09-20T15:13:40Z,11,2,11,V,5218.7185,N,445.6503,E,4.80,A,132,6*64"))
    assert record.place == pytest.approx(Place(52.311975, 4.760838333, 4.8))
    assert record[:3] == (204, TIME_US, None)


def test_south_and_west_are_negative() -> None:
    record = some(decode_record(sentence(ns=b"S", ew=b"W", longitude=b"00445.6503", altitude=b"-12.5")))
    assert record.place == pytest.approx(Place(-52.311975, -4.760838333, -12.5))
    assert record.cpm == 30.0


@pytest.mark.parametrize("header", sorted(HEADERS))
@pytest.mark.parametrize("rest", [b"132,6", b"6,1.32", b"0.0,0", b"1", b"6,1.32,more,fields"])
def test_any_header_and_any_order_of_the_last_fields(header: bytes, rest: bytes) -> None:
    assert decode_record(sentence(header=header, rest=rest)) == decode_record(sentence())


def test_without_a_fix_there_is_no_place_whatever_is_written() -> None:
    for latitude in (b"5218.7185", b"", b"-07355.3663", b"nonsense"):
        record = decode_record(sentence(latitude=latitude, fix=b"V"))
        assert record == Record(204, TIME_US, 30.0, None)


def signed(plain: bytes, at: bytes) -> bytes:
    """With a minus in front of a coordinate; the checksum stays as it was."""
    assert plain.count(at) == 1
    return plain.replace(at, b"-" + at)


def test_a_sign_that_came_after_the_checksum_says_what_the_letter_says() -> None:
    south_west = sentence(latitude=b"3355.1000", ns=b"S", longitude=b"07355.3663", ew=b"W")
    for said in (signed(south_west, b"07355"), signed(south_west, b"3355.1"),
                 signed(signed(south_west, b"07355"), b"3355.1")):  # fmt: skip
        assert decode_record(said) == decode_record(south_west)
    north_east = sentence(latitude=b"3355.1000", longitude=b"07355.3663")
    for said in (signed(north_east, b"07355"), signed(north_east, b"3355.1"), signed(south_west, b"30,2")):
        with pytest.raises(MalformedError, match="wrong checksum"):
            decode_record(said)


@pytest.mark.parametrize(
    ("damaged", "why"),
    [
        (sentence()[:-2] + b"00", "wrong checksum"),
        (sentence()[:-3], r"expected \$...\*XX"),
        (sentence() + b"*", "expected"),
        (checked(b"BNRDD,204,2012-09-20T15:13:40Z,11"), "at least 13 fields"),
        # What a Nano of 2012 wrote: decimal degrees, no letters.
        (checked(b"BNRDD,1,2012-06-05T07:57:26Z,0,0,0,V,35.622318,139.749220,0.10,0.13,A,3,525"), "expected A or V"),
        (sentence(time=b"2012-00-00T00:00:00Z"), "month"),
        (sentence(time=b"2012-09-20T15:13:61Z"), "second"),
        (sentence(time=b"2012-09-20 15:13:40"), "expected a time"),
        (sentence(cpm=b"-3"), "expected counts"),
        (sentence(cpm=b""), "expected counts"),
        (sentence(cpm=b"1e3"), "expected counts"),
        (sentence(cpm=b"9999999999"), "expected counts"),
        (sentence(valid=b"X"), "expected A or V for the CPM"),
        (sentence(fix=b""), "expected A or V for the fix"),
        (sentence(longitude=b"-07355.3663", ew=b"W"), "expected dddmm.mmmm"),
        (sentence(latitude=b""), "expected dddmm.mmmm"),
        (sentence(latitude=b"5260.0000"), "not a place on Earth"),
        (sentence(latitude=b"9000.0001"), "not a place on Earth"),
        (sentence(longitude=b"18000.1"), "not a place on Earth"),
        (sentence(ns=b"E"), "expected dddmm.mmmm"),
        (sentence(ns=b"NS"), "expected dddmm.mmmm"),
        (sentence(ns=b""), "expected dddmm.mmmm"),
        (sentence(altitude=b"nan"), "expected an altitude"),
        (sentence(altitude=b"1e9"), "expected an altitude"),
    ],
)
def test_damage_is_rejected_with_its_reason_and_the_rest_is_read(damaged: bytes, why: str) -> None:
    with pytest.raises(MalformedError, match=why):
        decode_record(damaged)
    log = read(sentence(), damaged, sentence(time=at(5)))
    assert [record.time_us for record in log.records] == [TIME_US, TIME_US + 5_000_000]
    assert (log.read, log.rejected) == (3, 1)
    assert log.trouble.startswith("line 2: ")


def test_comments_blank_lines_and_status_sentences_are_no_records() -> None:
    log = read(b"# NEW LOG", b"# format=1.0.0nano", b"", checked(b"BNXSTS,204,more"), sentence(), end=b"\n")
    assert (log.read, log.rejected, len(log.records)) == (1, 0, 1)


def test_a_sentence_that_was_cut_off_by_the_next_one() -> None:
    log = read(sentence()[:30] + sentence(time=at(5)))
    assert (log.read, log.rejected) == (2, 1)
    assert [record.time_us for record in log.records] == [TIME_US + 5_000_000]


def test_what_is_longer_than_any_line_is_rejected_once() -> None:
    log = read(b"x" * MAX_LINE * 20, sentence(), bytes(MAX_LINE))
    assert (log.read, log.rejected, len(log.records)) == (3, 2, 1)


def test_a_lower_case_checksum_and_no_end_of_line() -> None:
    body, checksum = sentence().split(b"*")
    assert len(read_bgeigie(io.BytesIO(body + b"*" + checksum.lower())).records) == 1


def test_records_are_sorted_by_time() -> None:
    log = read(sentence(time=at(10)), sentence(time=at(0)), sentence(time=at(5)))
    assert [record.time_us - TIME_US for record in log.records] == [0, 5_000_000, 10_000_000]


def test_a_clock_that_was_never_set_is_not_believed() -> None:
    unset = sentence(time=b"2000-01-01T00:00:05Z", fix=b"V")
    log = read(unset, unset, sentence(time=at(0), fix=b"V"), sentence(time=at(5)))
    assert (log.read, log.rejected) == (4, 2)
    assert log.records[0].time_us == TIME_US
    # If no record has a fix, there is nothing to doubt them by.
    assert read(unset, unset).rejected == 0


@given(st.lists(st.one_of(st.binary(max_size=300), st.just(sentence()), st.just(sentence()[:40])), max_size=12))
def test_whatever_the_bytes_nothing_is_raised(lines: list[bytes]) -> None:
    log = read(*lines)
    # Garbage cannot hide a sentence on the next line. A sentence that garbage holds by chance would count, too.
    assert len(log.records) >= sum(line == sentence() for line in lines)


@given(st.lists(st.tuples(st.integers(0, 2000), st.integers(0, 255)), max_size=10))
def test_changed_bytes_cost_no_more_than_their_lines(changes: list[tuple[int, int]]) -> None:
    lines = [sentence(time=at(5 * n), cpm=n) for n in range(20)]
    data = bytearray(b"\n".join(lines) + b"\n")
    for place, value in changes:
        data[place % len(data)] = value
    log = read_bgeigie(io.BytesIO(bytes(data)))
    # A change of the line's end concerns two lines. The checksum has 8 bits and sees any change of one byte.
    assert len(log.records) >= len(lines) - 2 * len(changes)


def test_files_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.LOG: no such file or directory$"):
        load_bgeigie(str(tmp_path / "none.LOG"))
    path = tmp_path / "empty.LOG"
    path.write_bytes(b"# NEW LOG\n")
    with pytest.raises(LogError, match=r"empty\.LOG: no valid bGeigie record$"):
        load_bgeigie(str(path))
    path.write_bytes(b"# NEW LOG\n" + sentence()[:-1] + b"\n")
    with pytest.raises(LogError, match=r"no valid bGeigie record \(1 rejected; line 2: expected"):
        load_bgeigie(str(path))


@pytest.mark.skipif(not SAMPLES.exists(), reason="needs ../shared/data/bgeigie, which is not part of the repository")
@pytest.mark.parametrize(
    ("name", "read", "used", "without_rate", "without_place"),
    [("flight-204-part1.LOG", 3998, 3998, 8, 0), ("bgeigie.log", 23, 23, 11, 23)],
)
def test_real_logs(name: str, read: int, used: int, without_rate: int, without_place: int) -> None:
    log = load_bgeigie(str(SAMPLES / name))
    assert (log.read, len(log.records)) == (read, used)
    assert sum(record.cpm is None for record in log.records) == without_rate
    assert sum(record.place is None for record in log.records) == without_place


@pytest.mark.skipif(not SAMPLES.exists(), reason="needs ../shared/data/bgeigie, which is not part of the repository")
def test_a_real_log_with_signs_before_its_coordinates() -> None:
    log = load_bgeigie(str(SAMPLES / "bgeigie_with_tinygps_bug.log"))
    assert (log.read, len(log.records)) == (29, 29)
    places = [record.place for record in log.records if record.place is not None]
    assert len(places) == 21
    # Safecast's own import has this one at -73.92259666666666: west, as letter and sign say.
    assert places[12].longitude == pytest.approx(-73.92259666666666, abs=1e-9)
    assert {round(place.latitude) for place in places} == {42}

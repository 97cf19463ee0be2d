"""The checksum: the check value of the catalogue, pymavlink's two implementations, and the compiled one."""

from hypothesis import given
from hypothesis import strategies as st
from pymavlink.generator.mavcrc import x25crc_slow

from rass_mav.mavlink.crc import crc16, crc16_fallback

# The catalogues of CRCs give each algorithm's checksum of these nine digits.
CHECK_INPUT, CHECK_VALUE = b"123456789", 0x6F91


def test_check_value_of_crc16_mcrf4xx() -> None:
    assert crc16(CHECK_INPUT) == CHECK_VALUE
    assert crc16_fallback(CHECK_INPUT) == CHECK_VALUE


def test_nothing_leaves_the_start_value() -> None:
    assert crc16_fallback(b"") == 0xFFFF
    assert crc16_fallback(b"", 0x1234) == 0x1234


@given(data=st.binary(max_size=300), start=st.integers(0, 0xFFFF))
def test_equals_pymavlink_for_any_bytes_and_start(data: bytes, start: int) -> None:
    slow = x25crc_slow()
    slow.crc = start
    slow.accumulate(data)
    assert crc16_fallback(data, start) == crc16(data, start) == slow.crc


@given(first=st.binary(max_size=100), second=st.binary(max_size=100))
def test_goes_on_where_it_stopped(first: bytes, second: bytes) -> None:
    assert crc16_fallback(second, crc16_fallback(first)) == crc16_fallback(first + second)

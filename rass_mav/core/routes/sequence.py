"""Serial number arithmetic on 16 bits (RFC 1982)."""


def newer(a: int, b: int) -> bool:
    """Whether 16-bit number `a` is newer than `b`. Numbers half the circle apart count as not newer, both ways."""
    return 0 < ((a - b) & 0xFFFF) < 0x8000


def following(a: int) -> int:
    """The number after `a`."""
    return (a + 1) & 0xFFFF

"""The checksum of MAVLink frames: CRC-16/MCRF4XX (polynomial 0x1021 reflected, start 0xFFFF, no final XOR).

Source: https://mavlink.io/en/guide/serialization.html#checksum (there under its older name X.25). `fastcrc` computes it
where it is installed. `fastcrc` is compiled and not available for every board, so there is a fallback that needs only
the standard library.
"""

from __future__ import annotations

import binascii
from collections.abc import Callable

#: Each byte with its bits in reverse order.
_REVERSED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))


def crc16_fallback(data: bytes, crc: int = 0xFFFF) -> int:
    """CRC-16/MCRF4XX of `data`, at C speed without compiled dependencies.

    `binascii.crc_hqx` has the same polynomial but takes the bits of each byte from the other end. So each byte is
    mirrored before it goes in, and the 16-bit register is mirrored before and after.

    :param data: bytes or bytearray of any length.
    :param crc: start value, 0..0xFFFF; to continue an earlier call, its result.
    :returns: 0..0xFFFF.
    """
    mirrored = binascii.crc_hqx(data.translate(_REVERSED), _REVERSED[crc & 0xFF] << 8 | _REVERSED[crc >> 8])
    return _REVERSED[mirrored & 0xFF] << 8 | _REVERSED[mirrored >> 8]


#: The fastest CRC-16/MCRF4XX available; same arguments and result as `crc16_fallback`.
crc16: Callable[..., int]
#: Whether `crc16` is the compiled one.
HAVE_FASTCRC: bool
try:
    from fastcrc.crc16 import mcrf4xx
except ImportError:
    crc16, HAVE_FASTCRC = crc16_fallback, False
else:
    crc16, HAVE_FASTCRC = mcrf4xx, True

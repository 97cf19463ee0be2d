"""How fast TUNNEL frames are written and read, against pymavlink, with and without the compiled CRC.

    python -m benchmarks.frames            a table
    python -m benchmarks.frames --json     one JSON object

Each pair is measured in one process, in turns. Other load on the machine affects both alike, so the ratio is steadier
than the times. The numbers without fastcrc come from a second process, in which neither side can import it.
"""

from __future__ import annotations

import argparse
import json
import random
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from benchmarks.tables import ratios, spread, table

PAYLOAD_TYPE = 33200
KEY = bytes(range(32))
DATA_SIZES = (0, 1, 20, 45, 60, 100, 127, 128, 128, 128)

Work = Callable[[], object]


def _work() -> dict[str, tuple[int, Work, Work]]:
    """Name -> (frames in one call, our way, pymavlink's way)."""
    generator = random.Random(1)
    data = [generator.randbytes(size) for size in DATA_SIZES]
    return {**_encoding(data), **_decoding(data)}


def _encoding(data: Sequence[bytes]) -> dict[str, tuple[int, Work, Work]]:
    from pymavlink.dialects.v20 import common

    from rass_mav.mavlink.frames import FrameWriter
    from rass_mav.mavlink.signing import Signer

    def ours(writer: FrameWriter) -> Work:
        return lambda: [writer.tunnel(one, payload_type=PAYLOAD_TYPE) for one in data]

    def theirs(mav: Any) -> Work:
        def work() -> None:
            for one in data:
                message = common.MAVLink_tunnel_message(0, 0, PAYLOAD_TYPE, len(one), one.ljust(128, b"\0"))
                message.pack(mav)
                mav.seq = (mav.seq + 1) % 256

        return work

    mav, signed_mav = common.MAVLink(None, 1, 191), common.MAVLink(None, 1, 191)
    signed_mav.signing.secret_key, signed_mav.signing.sign_outgoing = KEY, True
    return {
        "write": (len(data), ours(FrameWriter(1, 191)), theirs(mav)),
        "write and sign": (len(data), ours(FrameWriter(1, 191, Signer(KEY, 0, 1))), theirs(signed_mav)),
    }


def _decoding(data: Sequence[bytes]) -> dict[str, tuple[int, Work, Work]]:
    from pymavlink.dialects.v20 import common

    from rass_mav.mavlink.frames import FrameReader, FrameWriter
    from rass_mav.mavlink.signing import SignatureCheck, Signer, SigningKey
    from rass_mav.mavlink.tunnel import decode_tunnel, tunnel_from_datagram

    def written(signer: Signer | None = None) -> list[bytes]:
        writer = FrameWriter(1, 191, signer)
        return [writer.tunnel(one, payload_type=PAYLOAD_TYPE) for one in data]

    def ours(pieces: Sequence[bytes], key: bytes) -> Work:
        def work() -> None:
            reader = FrameReader(SignatureCheck(SigningKey(key), lambda _: True))
            for piece in pieces:
                for one in reader.datagram(piece):
                    decode_tunnel(one.payload)

        return work

    def theirs(pieces: Sequence[bytes], key: bytes | None = None) -> Work:
        def work() -> None:
            receiver = common.MAVLink(None)
            receiver.signing.secret_key = key
            for piece in pieces:
                for one in receiver.parse_buffer(piece) or ():
                    bytes(one.payload[: one.payload_length])

        return work

    # The datagram path: one frame in each call, as from a socket.
    def datagrams() -> None:
        for frame in frames:
            tunnel_from_datagram(frame)

    frames, signed = written(), written(Signer(KEY, 0, 1))
    count = len(data)
    return {
        "read": (count, datagrams, theirs(frames)),
        "read and verify": (count, ours(signed, KEY), theirs(signed, KEY)),
    }


def _time(work: Work, repeat: int) -> float:
    begin = time.perf_counter()
    for _ in range(repeat):
        work()
    return (time.perf_counter() - begin) / repeat


def measure(rounds: int) -> dict[str, dict[str, list[float]]]:
    """By the name of the work: microseconds a frame in each round, ours and pymavlink's."""
    results = {}
    for name, (count, ours, theirs) in _work().items():
        ways = {"ours": ours, "pymavlink": theirs}
        # About 10 ms a measurement.
        repeats = {way: max(1, int(0.01 / _time(work, 2))) for way, work in ways.items()}
        times: dict[str, list[float]] = {way: [] for way in ways}
        for _ in range(rounds):
            for way, work in ways.items():
                times[way].append(round(_time(work, repeats[way]) / count * 1e6, 4))
        results[name] = times
    return results


def measure_without_fastcrc(rounds: int) -> dict[str, dict[str, list[float]]]:
    """The same in a process in which neither side can import fastcrc."""
    # None in sys.modules makes every import of it fail, in pymavlink too.
    code = (
        "import sys, json; sys.modules['fastcrc'] = None; sys.modules['fastcrc.crc16'] = None\n"
        "from benchmarks.frames import measure\n"
        f"print(json.dumps(measure({rounds})))"
    )
    root = Path(__file__).resolve().parent.parent
    done = subprocess.run([sys.executable, "-c", code], cwd=root, check=True, capture_output=True, text=True)
    results: dict[str, dict[str, list[float]]] = json.loads(done.stdout)
    return results


def measure_both(rounds: int) -> dict[str, dict[str, dict[str, list[float]]]]:
    """With the compiled CRC, where it is installed, and without it."""
    from rass_mav.mavlink.crc import HAVE_FASTCRC

    compiled = {"with fastcrc": measure(rounds)} if HAVE_FASTCRC else {}
    return {**compiled, "without fastcrc": measure_without_fastcrc(rounds)}


def show(results: dict[str, dict[str, dict[str, list[float]]]]) -> str:
    """The table."""
    rows = [
        [f"{name}, {crc}", spread(times["ours"], 2), spread(times["pymavlink"], 2),
         spread(ratios(times["ours"], times["pymavlink"]), 3)]
        for crc, measured in results.items()
        for name, times in measured.items()
    ]  # fmt: skip
    return table(["a frame", "here, us", "pymavlink, us", "ratio"], rows)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--rounds", type=int, default=7, help="measurements of each pair (default: 7)")
    options = parser.parse_args(arguments)
    results = measure_both(options.rounds)
    print(json.dumps(results) if options.json else show(results))


if __name__ == "__main__":
    main()

"""How fast TUNNEL frames are written and read, against pymavlink, with and without the compiled CRC.

    python -m benchmarks.frames            a table
    python -m benchmarks.frames --json     one JSON object

Each pair is measured in one process, in turns, and the result is the median of the rounds. Other load on the machine
affects both alike, so the ratio is steadier than the times. The numbers without fastcrc come from a second process in
which neither side can import it.
"""

from __future__ import annotations

import argparse
import json
import random
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

PAYLOAD_TYPE = 33200
KEY = bytes(range(32))
DATA_SIZES = (0, 1, 20, 45, 60, 100, 127, 128, 128, 128)

Work = Callable[[], object]


def _work() -> dict[str, tuple[int, Work, Work | None]]:
    """Name -> (frames in one call, our way, pymavlink's way if there is one to compare with)."""
    generator = random.Random(1)
    data = [generator.randbytes(size) for size in DATA_SIZES]
    return {**_encoding(data), **_decoding(data), **_telemetry(len(data))}


def _encoding(data: Sequence[bytes]) -> dict[str, tuple[int, Work, Work | None]]:
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
        "tunnel_encode": (len(data), ours(FrameWriter(1, 191)), theirs(mav)),
        "tunnel_encode_signed": (len(data), ours(FrameWriter(1, 191, Signer(KEY, 0, 1))), theirs(signed_mav)),
    }


def _decoding(data: Sequence[bytes]) -> dict[str, tuple[int, Work, Work | None]]:
    from pymavlink.dialects.v20 import common

    from rass_mav.mavlink.frames import FrameReader, FrameWriter
    from rass_mav.mavlink.signing import SignatureCheck, Signer, SigningKey
    from rass_mav.mavlink.tunnel import decode_tunnel, tunnel_from_datagram

    def written(signer: Signer | None = None) -> list[bytes]:
        writer = FrameWriter(1, 191, signer)
        return [writer.tunnel(one, payload_type=PAYLOAD_TYPE) for one in data]

    def ours(pieces: Sequence[bytes], key: bytes | None = None, *, stream: bool = False) -> Work:
        def work() -> None:
            reader = FrameReader(SignatureCheck(SigningKey(key), lambda _: True) if key else None)
            take = reader.feed if stream else reader.datagram
            for piece in pieces:
                for one in take(piece):
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
    stream = b"".join(frames)
    single = [bytes([byte]) for byte in stream]
    count = len(data)
    return {
        "tunnel_decode": (count, datagrams, theirs(frames)),
        "reader_datagrams": (count, ours(frames), theirs(frames)),
        "reader_stream": (count, ours([stream], stream=True), theirs([stream])),
        "reader_bytewise": (count, ours(single, stream=True), theirs(single)),
        "reader_verified": (count, ours(signed, KEY), theirs(signed, KEY)),
    }


def _telemetry(count: int) -> dict[str, tuple[int, Work, Work | None]]:
    from rass_mav.lab.swarm import autopilot
    from rass_mav.mavlink import messages
    from rass_mav.mavlink.frames import Frame, FrameReader, FrameWriter
    from rass_mav.mavlink.telemetry import Telemetry

    writer, reader, telemetry = FrameWriter(1, 191), FrameReader(), Telemetry(1, 191)
    place = autopilot.global_position_int_payload(-35.4, 149.2, 590.0, 6.0, 12345)
    position = writer.frame(messages.GLOBAL_POSITION_INT, place)
    value = messages.named_value_float_payload("RAD", 12.5, 12345)
    reading = writer.frame(messages.NAMED_VALUE_FLOAT, value)
    [position_frame], [reading_frame] = reader.feed(position), reader.feed(reading)

    def handle(frame: Frame) -> Work:
        def work() -> None:
            for _ in range(count):
                telemetry.handle(frame, 1.0)

        return work

    def from_bytes() -> None:
        for _ in range(count):
            for data in (position, reading):
                for one in reader.feed(data):
                    telemetry.handle(one, 1.0)

    def encode() -> None:
        for _ in range(count):
            writer.frame(33, autopilot.global_position_int_payload(-35.4, 149.2, 590.0, 6.0, 12345))
            writer.frame(251, messages.named_value_float_payload("RAD", 12.5, 12345))

    return {
        "telemetry_position": (count, handle(position_frame), None),
        "telemetry_reading": (count, handle(reading_frame), None),
        "telemetry_from_bytes": (2 * count, from_bytes, None),
        "telemetry_encode": (2 * count, encode, None),
    }


def _time(work: Work, repeat: int) -> float:
    begin = time.perf_counter()
    for _ in range(repeat):
        work()
    return (time.perf_counter() - begin) / repeat


def measure(rounds: int) -> dict[str, dict[str, float]]:
    """Microseconds a frame for ours and pymavlink's, and the median of the rounds' ratios."""
    results = {}
    for name, (count, ours, theirs) in _work().items():
        pairs = [work for work in (ours, theirs) if work is not None]
        # About 10 ms a measurement.
        repeats = [max(1, int(0.01 / _time(work, 2))) for work in pairs]
        times = [[_time(work, repeat) for work, repeat in zip(pairs, repeats, strict=True)] for _ in range(rounds)]
        result = {"us": statistics.median(one[0] for one in times) / count * 1e6}
        if theirs is not None:
            result["pymavlink_us"] = statistics.median(one[1] for one in times) / count * 1e6
            result["ratio"] = statistics.median(one[0] / one[1] for one in times)
        results[name] = {key: round(value, 4) for key, value in result.items()}
    return results


def measure_without_fastcrc(rounds: int) -> dict[str, dict[str, float]]:
    """The same in a process in which neither side can import fastcrc."""
    # None in sys.modules makes every import of it fail, in pymavlink too.
    code = (
        "import sys, json; sys.modules['fastcrc'] = None; sys.modules['fastcrc.crc16'] = None\n"
        "from benchmarks.frames import measure\n"
        f"print(json.dumps(measure({rounds})))"
    )
    root = Path(__file__).resolve().parent.parent
    done = subprocess.run([sys.executable, "-c", code], cwd=root, check=True, capture_output=True, text=True)
    results: dict[str, dict[str, float]] = json.loads(done.stdout)
    return results


def show(results: dict[str, dict[str, dict[str, float]]]) -> None:
    """Print the table."""
    for crc, measured in results.items():
        print(f"CRC: {crc:<24} {'us a frame':>10} {'pymavlink':>10} {'ratio':>7}")
        for name, result in measured.items():
            line = f"  {name:<27} {result['us']:>10.2f}"
            if "ratio" in result:
                line += f" {result['pymavlink_us']:>10.2f} {result['ratio']:>7.3f}"
            print(line)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--rounds", type=int, default=7, help="measurements of each pair (default: 7)")
    options = parser.parse_args(arguments)
    from rass_mav.mavlink.crc import HAVE_FASTCRC

    results = {"fastcrc": measure(options.rounds)} if HAVE_FASTCRC else {}
    results["fallback"] = measure_without_fastcrc(options.rounds)
    if options.json:
        print(json.dumps(results))
        return
    show(results)


if __name__ == "__main__":
    # As a script, the top of the checkout is not on the path.
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
    main()

"""The process that the air of a flown swarm lives in.

Started with the name of an `AirOrder` file (JSON). Says its ports (`AirPorts`) in one line on stdout, obeys orders on
stdin, a line each, and says its figures (`AirFigures`) in the last line. It ends when stdin does: it never outlives its
parent.

    off NODE        this node's process is dead: it hears nothing until it speaks again
    stop            say the figures and end
"""

from __future__ import annotations

import contextlib
import os
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import IO, Any, BinaryIO, TextIO, cast

import msgspec

from rass_mav.errors import ConfigError, RassError
from rass_mav.mavlink.tlog import TlogWriter
from rass_mav.swarm.sitl.air import Air, AirOrder

#: Between two looks at where the vehicles are, seconds.
TURN_S = 0.1
_MAX_ORDER = 4096


class _Orders:
    """The lines on stdin."""

    def __init__(self, air: Air, file: int) -> None:
        self._air = air
        self._file = file
        self._rest = b""
        self.stopped = False
        self.orphaned = False

    def read(self) -> None:
        data = os.read(self._file, _MAX_ORDER)
        if not data:
            self.orphaned = True
            return
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            match line.decode("ascii").split():
                case ["off", node]:
                    self._air.off(int(node))
                case ["stop"]:
                    self.stopped = True
                case words:
                    raise ValueError(f"not an order: {words}")


def serve(air: Air, step_s: float, orders: int) -> bool:
    """Run in real time until the file descriptor `orders` says stop. False: the parent is gone."""
    told = _Orders(air, orders)
    air.watch(orders, told.read)
    boot = time.monotonic()
    step, turn = 1, 0.0
    while not (told.stopped or told.orphaned):
        air.poll(min(step * step_s, turn) - (time.monotonic() - boot))
        now = time.monotonic() - boot
        if now >= turn:
            air.turn(now)
            turn = now + TURN_S
        while step * step_s <= now:
            air.late_steps += (step + 1) * step_s <= now
            air.step()
            step += 1
    return not told.orphaned


def main(arguments: Iterable[str]) -> int:
    """The process: 0 when it was told to stop, 1 when its parent has gone or a port is in use."""
    (path,) = arguments
    order = msgspec.json.decode(Path(path).read_bytes(), type=AirOrder)
    try:
        with contextlib.ExitStack() as stack:
            record = None
            if order.record is not None:
                tape = TlogWriter(cast(BinaryIO, stack.enter_context(_opened(order.record, "wb"))))
                record = lambda frame, step: tape.record(frame, time.time())  # noqa: E731
            air = Air(order, track=cast(TextIO, stack.enter_context(_opened(order.track, "w"))), record=record)
            stack.callback(air.close)
            _say(air.ports)
            if not serve(air, order.scenario.node.step_s, sys.stdin.fileno()):
                return 1
            _say(air.figures())
    except RassError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    return 0


def _opened(path: str, mode: str) -> IO[Any]:
    try:
        return Path(path).open(mode)
    except OSError as error:
        raise ConfigError(f"{path}: {(error.strerror or str(error)).lower()}") from None


def _say(struct: msgspec.Struct) -> None:
    sys.stdout.buffer.write(msgspec.json.encode(struct) + b"\n")
    sys.stdout.buffer.flush()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

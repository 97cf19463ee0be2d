"""The benchmark of large data over thin links: its emulated link, its arithmetic, and a small transfer through it."""

from __future__ import annotations

import itertools
import json
import random
import socket
from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.relay import Line, LineSettings, frames
from benchmarks.transfer import CELLS, Cell, Run, cell, drops, emulated, figures, main
from rass_mav.mavlink.frames import FrameWriter
from rass_mav.mavlink.signing import Signer
from tests.patience import PATIENCE_S


def carried(line: Line, sent: Sequence[tuple[float, bytes]]) -> list[tuple[float, bytes]]:
    """What arrives of frames sent at such times, and when."""
    out: list[tuple[float, bytes]] = []
    for at, frame in [*sent, (float("inf"), b"")]:
        while (due := line.next_at) is not None and due <= at:
            out += [(due, arrived) for arrived in line.arrived(due)]
        if frame:
            line.send(frame, at)
    return out


gaps = st.lists(st.tuples(st.floats(0.0, 0.2), st.integers(1, 280)), min_size=1, max_size=80)


@given(gaps, st.floats(100.0, 1e6), st.floats(0.0, 0.5))
def test_a_line_keeps_its_rate_and_its_delay(traffic: list[tuple[float, int]], bytes_s: float, delay_s: float) -> None:
    line = Line(LineSettings(bytes_s, delay_s, queue_bytes=1 << 20), random.Random(1))
    sent, now = [], 0.0
    for number, (gap, size) in enumerate(traffic):
        now += gap
        sent.append((now, bytes([number]) * size))
    out = carried(line, sent)
    assert [frame for _, frame in out] == [frame for _, frame in sent]
    free = 0.0
    for (came, frame), (at, arrived) in zip(sent, out, strict=True):
        assert arrived == frame
        free = max(free, came) + len(frame) / bytes_s
        assert at == pytest.approx(free + delay_s)
    assert line.counters() == {
        "frames": len(sent), "bytes": sum(len(frame) for _, frame in sent), "lost": 0, "dropped": 0,
    }  # fmt: skip


def test_a_line_that_is_looked_at_late_has_gone_on_meanwhile() -> None:
    line = Line(LineSettings(1000.0, 0.02), random.Random(1))
    for number in range(10):
        line.send(bytes([number]) * 100, 0.1 * number)
    assert len(list(line.arrived(100.0))) == 10
    assert line.next_at is None
    line.send(b"x" * 100, 0.95)
    # The tenth had left at 1.0, whenever anybody looked.
    assert line.next_at == pytest.approx(1.0 + 0.1 + 0.02)


def test_the_queue_is_bounded_in_bytes() -> None:
    line = Line(LineSettings(1000.0, 0.0, queue_bytes=1000), random.Random(1))
    for _ in range(30):
        line.send(bytes(100), 0.0)
    assert (line.frames, line.dropped) == (10, 20)
    line.send(bytes(100), 0.05)
    assert line.dropped == 21, "half a frame has left, so there is space for half a frame"
    line.send(bytes(100), 0.1)
    assert (line.frames, line.dropped) == (11, 21)


@pytest.mark.no_cover
@pytest.mark.parametrize("loss", [0.0, 0.05, 0.2, 1.0])
def test_frames_are_lost_independently_with_the_stated_probability(loss: float) -> None:
    def lost(seed: int) -> list[bool]:
        line = Line(LineSettings(1e6, 0.0, loss), random.Random(seed))
        gone = []
        for n in range(20_000):
            before = line.lost
            line.send(bytes(100), float(n))
            gone.append(line.lost > before)
            list(line.arrived(n + 0.5))
        # A lost frame takes its time too.
        assert line.bytes == 2_000_000
        return gone

    gone = lost(1)
    share = sum(gone) / len(gone)
    assert share == pytest.approx(loss, abs=0.01)
    pairs = sum(a and b for a, b in itertools.pairwise(gone)) / (len(gone) - 1)
    assert pairs == pytest.approx(loss * loss, abs=0.01)
    assert lost(1) == gone
    assert (lost(2) == gone) == (loss in (0.0, 1.0))


def test_frames_of_one_datagram_are_told_apart() -> None:
    plain, signed = FrameWriter(7, 191), FrameWriter(7, 191, signer=Signer(bytes(32), 1, 5))
    made = [
        plain.tunnel(b"one", payload_type=33200),
        signed.tunnel(b"two" * 40, payload_type=33200),
        b"\xfe\x01" + bytes(7),
    ]
    assert list(frames(b"".join(made))) == made
    assert list(frames(b"something else")) == [b"something else"]
    assert list(frames(b"\xfd\xff")) == [b"\xfd\xff"]
    assert list(frames(b"")) == []


@given(st.binary(max_size=2000))
def test_no_byte_of_a_datagram_is_lost_between_frames(datagram: bytes) -> None:
    assert b"".join(frames(datagram)) == datagram


def test_a_relay_passes_frames_both_ways_and_counts_them() -> None:
    with (
        emulated(Cell(8_000_000, 0.0), "1", 1 << 16) as link,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as left,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as right,
    ):
        for sock in (left, right):
            sock.settimeout(PATIENCE_S)
        # An end is known when it has sent something: this one comes from nowhere, and goes nowhere.
        right.sendto(b"here", link.right)
        while not link.counters()["leftward"]["frames"]:
            pass
        left.sendto(b"\xfd" + bytes(99), link.left)
        assert right.recv(1000) + right.recv(1000) == b"\xfd" + bytes(99)
        right.sendto(b"answer", link.right)
        assert left.recv(1000) in (b"here", b"answer")
        assert link.counters()["rightward"]["bytes"] == link.sent() == 100


# -- arithmetic --------------------------------------------------------------------------------------------------------


def test_the_six_cells() -> None:
    assert [cell(name) for name in CELLS] == [
        Cell(rate, loss) for rate in (57600, 1_000_000) for loss in (0.0, 0.05, 0.2)
    ]
    assert cell("57600/0").bytes_s == 5760.0
    assert cell("1000000/5").bytes_s == 125_000.0
    assert cell("57600/20").bound() == pytest.approx(0.8 * 123 / 145)
    assert cell("57600/0").bound(signed=True) == pytest.approx(0.7785, abs=1e-4)
    for wrong in ("57600/100", "-1/0"):
        with pytest.raises(ValueError, match="expected BIT_S/PERCENT"):
            cell(wrong)


def test_what_runs_amount_to() -> None:
    one = Cell(57600, 0.0)
    chunks = 1000
    size = chunks * 123
    # As fast as the bound: nothing but full chunks, one after the other.
    best = figures(one, [Run(size, chunks * 145 / 5760.0, chunks * 145, chunks)])
    assert best["goodput"] == pytest.approx(123 / 145)
    assert best["of_bound"] == pytest.approx(1.0)
    assert best["bytes"] == pytest.approx(1.0)
    assert best["chunks"] == 1.0
    # Where a fifth is lost, five quarters of it are needed.
    lossy = figures(one._replace(loss=0.2), [Run(size, chunks * 145 / 5760.0 / 0.8, chunks * 145 * 5 // 4, 1250)])
    assert lossy["of_bound"] == pytest.approx(1.0)
    assert lossy["bytes"] == pytest.approx(1.0)
    assert lossy["chunks"] == 1.25
    signed = figures(one, [Run(size, chunks * 158 / 5760.0, chunks * 158, chunks)], signed=True)
    assert (signed["of_bound"], signed["bytes"]) == (pytest.approx(1.0), pytest.approx(1.0))


def test_a_run_that_failed_is_the_slowest() -> None:
    one = Cell(57600, 0.0)
    found = figures(one, [Run(5760, 1.0), Run(5760, None, trouble="given up"), Run(5760, 2.0)], ours=False)
    assert found["goodput"] == 0.5
    assert found["goodputs"] == [1.0, 0.0, 0.5]
    assert found["failed"] == ["given up"]
    with pytest.raises(ValueError, match="no runs"):
        figures(one, [])


# -- whole -------------------------------------------------------------------------------------------------------------


def test_a_small_transfer_ends_whole(capsys: pytest.CaptureFixture[str]) -> None:
    """The command compares what has arrived, and fails if it is something else."""
    arguments = ["--cells", "1000000/5", "--size", "3000", "--skip-ftp", "--json", "--set", "node.step_s=0.1"]
    main(arguments)
    found = json.loads(capsys.readouterr().out)
    assert list(found) == ["1000000/5"]
    row = found["1000000/5"]["ours"]
    assert row["failed"] == []
    assert 0.0 < row["of_bound"] < 1.0
    assert row["chunks"] >= 1.0
    assert row["bytes"] > 0.9


def test_datagrams_that_find_a_full_buffer_are_counted() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        sock.bind(("127.0.0.1", 0))
        port = sock.getsockname()[1]
        assert drops(port) == 0
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
            for _ in range(100):
                other.sendto(bytes(1000), ("127.0.0.1", port))
        assert drops(port) > 0

"""Large data over thin links: how fast a file goes from a drone to its base, and how fast MAVLink FTP fetches one.

    python -m benchmarks.transfer                            six cells, ours and MAVLink FTP in turns
    python -m benchmarks.transfer --cells 57600/0 1000000/20 --rounds 3 --skip-ftp
    python -m benchmarks.transfer --signed --skip-ftp        nodes with keys
    python -m benchmarks.transfer --busy                     no limit of rate, while four processes load the processors

A cell is a bit rate and a percentage of frames that are lost (`--cells`). Both ends are real programs, and each run has
a new link from `benchmarks.relay` between them. Ours: two `rass-mav run`, and a file that does not compress. The time
runs from the request to the drone until the base has the whole file on its disk; then it is compared. FTP: MAVSDK's
server on the drone's side, and two clients, one after the other: pymavlink's (bursts of `--read-size` bytes) and
MAVSDK's own.

- goodput: bytes of the file a second, over the bytes a second that the link carries.
- of bound: goodput over 123/145 x (1 - loss), what chunks in full TUNNEL frames can reach (signed: 123/158).
- bytes: what the link was given in the direction of the file, over what that bound needs.
- chunks: chunks sent, over those of the file.

Several rounds: medians.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import multiprocessing
import os
import random
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from benchmarks.relay import DELAY_S
from benchmarks.tables import spread, table
from rass_mav.app.payloads import MOST_SMALL, pack_file
from rass_mav.app.staging import Staging, in_pieces
from rass_mav.core.datum import Kind
from rass_mav.link.sockets import udp_table
from tests.app.app_nodes import ROOT, RunningNode, free_ports, process
from tests.environment import environment

#: Rate of the link by bit rate, bytes/s. On a serial line a byte has a start and a stop bit.
BYTES_S = {57600: 5760.0, 1_000_000: 125_000.0}
CELLS = tuple(f"{rate}/{loss}" for rate in BYTES_S for loss in (0, 5, 20))
#: Bytes of the file: to cut and to offer it takes a tenth of a second, which must not count for much on a fast link.
SIZES = {57600: 256 * 1024, 1_000_000: 1024 * 1024}
#: Seconds between two beacons: a slow radio needs long steps (docs/evaluation/air.md).
STEPS_S = {57600: 5.0, 1_000_000: 1.0}
BUSY_SIZE = 256 * 1024
#: Payload of a chunk, and what a full TUNNEL frame takes on the link, without and with a signature, bytes.
CHUNK_BYTES, FRAME_BYTES, SIGNED_BYTES = 123, 145, 158
BASE_ID, DRONE_ID = 1, 7
#: The most that MAVLink FTP carries in a frame.
READ_SIZE = 239
_POLL_S = 0.01
_START_S = 120.0
#: A transfer is given up after this many times the time that the bound needs, and a minute.
_PATIENCE = 30.0
_BUSY_PROCESSES = 4
_MAVSDK_SYSTEM = 3


class Cell(NamedTuple):
    """An emulated link."""

    bit_rate: int
    loss: float
    """Share of the frames that are lost, 0..1."""

    @property
    def bytes_s(self) -> float:
        """What it carries in each direction, bytes/s."""
        return BYTES_S.get(self.bit_rate, self.bit_rate / 8)

    @property
    def size(self) -> int:
        """Bytes of the file."""
        return SIZES.get(self.bit_rate, BUSY_SIZE)

    @property
    def step_s(self) -> float:
        """Of the nodes' steps, seconds."""
        return STEPS_S.get(self.bit_rate, 1.0)

    def bound(self, *, signed: bool = False) -> float:
        """The best goodput of chunks over capacity."""
        return CHUNK_BYTES / (SIGNED_BYTES if signed else FRAME_BYTES) * (1.0 - self.loss)

    def patience_s(self, size: int) -> float:
        """After how long a transfer is given up, seconds."""
        return 60.0 + _PATIENCE * size / (self.bytes_s * self.bound())


def cell(name: str) -> Cell:
    """A cell by its name: bit/s, and percent of frames lost. Raises `ValueError`."""
    rate, _, loss = name.partition("/")
    if not 0.0 <= float(loss) < 100.0 or int(rate) <= 0:
        raise ValueError(f"expected BIT_S/PERCENT, got {name!r}")
    return Cell(int(rate), float(loss) / 100.0)


class Run(NamedTuple):
    """One transfer."""

    size: int
    """Bytes of the file."""
    seconds: float | None
    """None: it failed, or was given up."""
    bytes: int = 0
    """Given to the link in the direction of the file."""
    chunks: int = 0
    """Data and chunks sent; 0: not counted."""
    trouble: str = ""


def figures(cell: Cell, runs: Sequence[Run], *, signed: bool = False, ours: bool = True) -> dict[str, Any]:
    """What runs of one program in one cell amount to: medians, with a failed run as the slowest."""
    if not runs:
        raise ValueError("no runs")
    size = runs[0].size
    bound = cell.bound(signed=signed)
    goodputs = [0.0 if run.seconds is None else size / run.seconds / cell.bytes_s for run in runs]
    goodput = statistics.median(goodputs)
    found: dict[str, Any] = {
        "goodput": goodput,
        "goodputs": goodputs,
        "bytes_s": goodput * cell.bytes_s,
        "bytes": statistics.median(run.bytes for run in runs) / (size / bound),
        "failed": [run.trouble for run in runs if run.seconds is None],
    }
    if ours:
        found["of_bound"] = goodput / bound
        found["chunks"] = statistics.median(run.chunks for run in runs) / -(-size // CHUNK_BYTES)
    return found


# -- the link ----------------------------------------------------------------------------------------------------------


class Emulated:
    """A `benchmarks.relay` process. The drone's side is left, the other one right."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self._process = process
        sides = self._answer()
        self.left, self.right = ((str(host), int(port)) for host, port in (sides["left"], sides["right"]))

    def _answer(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        answer: dict[str, Any] = json.loads(self._process.stdout.readline())
        return answer

    def counters(self) -> dict[str, dict[str, int]]:
        """What it has counted: `rightward`, `leftward`."""
        assert self._process.stdin is not None
        self._process.stdin.write(b"\n")
        self._process.stdin.flush()
        return self._answer()

    def sent(self) -> int:
        """Bytes that it was given to the right."""
        return self.counters()["rightward"]["bytes"]


@contextmanager
def emulated(cell: Cell, seed: str, queue: int) -> Iterator[Emulated]:
    """A link of this cell."""
    number = random.Random(seed).getrandbits(31)
    command = [
        *(sys.executable, "-m", "benchmarks.relay", "--bytes-s", str(cell.bytes_s), "--loss", str(cell.loss)),
        *("--delay", str(DELAY_S), "--queue", str(queue), "--seed", str(number)),
    ]
    relay = subprocess.Popen(command, cwd=ROOT, env=environment(), stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    try:
        yield Emulated(relay)
    finally:
        relay.communicate()


# -- ours --------------------------------------------------------------------------------------------------------------


def _url(address: tuple[str, int]) -> str:
    return f"{address[0]}:{address[1]}"


def _put_in(plain: dict[str, Any], key: str, value: Any) -> None:
    """Set a key with dots. `links.` stands for the only link."""
    *way, last = key.split(".")
    section: Any = plain
    for name in way:
        section = section.setdefault(name, {})
        if isinstance(section, list):
            section = section[0]
    section[last] = value


def airtime(bytes_s: float) -> dict[str, Any]:
    """The settings with which a node may use all of a link, and no more."""
    # A late timer must cost nothing: what it missed may leave at once, up to a tenth of a second.
    return {"bytes_s": bytes_s, "duty": 1.0, "beacons": 0.1, "burst_bytes": max(512, int(bytes_s / 10)),
            "burst_frames": 100, "frames_s": 100_000.0}  # fmt: skip


@contextmanager
def nodes(
    directory: Path, ends: dict[int, tuple[tuple[str, int], int]], cell: Cell | None, signed: bool,
    settings: dict[str, Any],
) -> Iterator[tuple[RunningNode, RunningNode]]:  # fmt: skip
    """A drone and a base that have met. `ends`: by node id, the address to send to, and the own port. `cell`: the link
    between them; None: one without a limit."""
    if signed:
        for arguments in (("new", "mission"), ("drone", str(DRONE_ID), "-d", "mission")):
            process(directory, "keys", *arguments).check_returncode()
    made = []
    for id, file in ((DRONE_ID, f"drone-{DRONE_ID}.keys"), (BASE_ID, "ground.keys")):
        address, port = ends[id]
        other = BASE_ID if id == DRONE_ID else DRONE_ID
        link: dict[str, Any] = {
            "listen": f"127.0.0.1:{port}", "peers": [{"address": _url(address), "id": other}],
            **({} if cell is None else {"airtime": airtime(cell.bytes_s)}),
        }  # fmt: skip
        plain: dict[str, Any] = {
            "node": {"role": "base" if id == BASE_ID else "drone", "step_s": 1.0 if cell is None else cell.step_s},
            "links": [link],
            **({"keys": {"file": str(directory / "mission" / file)}} if signed else {}),
        }
        for key, value in settings.items():
            _put_in(plain, key, value)
        made.append(RunningNode(directory, id, **plain))
    drone, base = made
    try:
        for node in made:
            node.start()
        _wait(lambda: drone.status()["hop_count"] == 1 and bool(base.status()["neighbours"]), _START_S, [drone, base])
        yield drone, base
    finally:
        for node in made:
            node.end()


def _wait(condition: Callable[[], bool], seconds: float, running: Sequence[RunningNode]) -> None:
    """Ask again and again until it is so. Raises `TimeoutError`, and `RuntimeError` if a node has ended."""
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            raise TimeoutError(f"not in {seconds:.0f} s")
        for node in running:
            if node.process is None or node.process.poll() is not None:
                raise RuntimeError(f"{node.name} has ended: {node.log()}")
        time.sleep(_POLL_S)


def put(drone: RunningNode, path: Path) -> tuple[str, int]:
    """Put a file as `rass-mav put` does, without the time to start it. Returns its id, and how many data it is."""
    with drone.client() as client, Staging(path) as staging:
        if staging.size <= MOST_SMALL:
            payload = pack_file(path.name, staging.whole())
            return str(client.ask("put", payload=payload, kind=int(Kind.FILE))["id"]), 1
        about = staging.look()
        client.ask(
            "file", name=about.name, size=about.size, digest=about.digest.hex(), packing=about.packing,
            length=about.length, time=about.time,
        )  # fmt: skip
        for piece in in_pieces(staging.packed(about)):
            client.ask("piece", payload=piece)
        done = client.ask("done")
        return str(done["id"]), 1 + int(done["parts"])


def hand_over(drone: RunningNode, base: RunningNode, payload: bytes, patience_s: float) -> float:
    """Give a file to the drone, and wait until the base has it on its disk. Returns the time for that, seconds.

    Raises `TimeoutError`, and `RuntimeError` if the base has something else.
    """
    path = drone.directory / "file.bin"
    path.write_bytes(payload)
    begun = time.monotonic()
    id, data = put(drone, path)
    with base.client() as client:
        _wait(lambda: client.ask("status")["status"]["store"]["items"] >= data, patience_s, [drone, base])
    _wait(lambda: len(base.listing()) >= data, _START_S, [drone, base])
    seconds = time.monotonic() - begun
    if process(base.directory, "get", "-c", base.config, id).stdout != payload:
        raise RuntimeError("the base has other bytes")
    return seconds


def ours(
    cell: Cell, size: int, seed: str, *, signed: bool = False, settings: dict[str, Any] | None = None,
    queue: int,
) -> Run:  # fmt: skip
    """One transfer between two of our nodes."""
    payload = random.Random(f"{seed}:file").randbytes(size)
    port, base_port = free_ports(2)
    with tempfile.TemporaryDirectory(prefix="rass-mav-") as name, emulated(cell, seed, queue) as link:
        ends = {DRONE_ID: (link.left, port), BASE_ID: (link.right, base_port)}
        with nodes(Path(name), ends, cell, signed, settings or {}) as (drone, base):
            before, chunks = link.sent(), int(drone.status()["ledger"]["sent_data"])
            try:
                seconds = hand_over(drone, base, payload, cell.patience_s(size))
            except TimeoutError as error:
                return Run(size, None, trouble=str(error))
            return Run(size, seconds, link.sent() - before, int(drone.status()["ledger"]["sent_data"]) - chunks)


# -- without a limit, on busy processors -------------------------------------------------------------------------------


def _load() -> None:
    while True:
        pass


@contextmanager
def loaded(processes: int) -> Iterator[None]:
    """While so many processes keep the processors busy."""
    context = multiprocessing.get_context("spawn")
    running = [context.Process(target=_load, daemon=True) for _ in range(processes)]
    for one in running:
        one.start()
    try:
        yield
    finally:
        for one in running:
            one.kill()
            one.join()


def drops(port: int) -> int:
    """Datagrams that found the buffer of the socket at this port full, as the kernel counts them."""
    return sum(entry.drops for entry in udp_table() if entry.port == port)


def busy(size: int, seed: str, *, signed: bool, settings: dict[str, Any], processes: int) -> dict[str, Any]:
    """One transfer over loopback, while processes load the processors."""
    payload = random.Random(f"{seed}:file").randbytes(size)
    port, base_port = free_ports(2)
    ends = {DRONE_ID: (("127.0.0.1", base_port), port), BASE_ID: (("127.0.0.1", port), base_port)}
    with (
        tempfile.TemporaryDirectory(prefix="rass-mav-") as name,
        loaded(processes),
        nodes(Path(name), ends, None, signed, settings) as (drone, base),
    ):
        before, lost = int(drone.status()["ledger"]["sent_data"]), drops(base_port)
        seconds = hand_over(drone, base, payload, 60.0 + size / 1000.0)
        return {
            "seconds": seconds,
            "bytes_s": size / seconds,
            "chunks": (int(drone.status()["ledger"]["sent_data"]) - before) / -(-size // CHUNK_BYTES),
            "dropped": drops(base_port) - lost,
        }


# -- MAVLink FTP -------------------------------------------------------------------------------------------------------


def _serve(url: str, directory: str, ready: Any) -> None:
    """MAVSDK's FTP server, in a process of its own."""
    from mavsdk.asyncio.mavsdk import Mavsdk
    from mavsdk.asyncio.plugins.ftp_server.ftp_server import FtpServerAsync
    from mavsdk.mavsdk import Configuration

    async def run() -> None:
        sdk = Mavsdk(Configuration.create_manual(_MAVSDK_SYSTEM, 1, True))
        server = FtpServerAsync(await sdk.server_component())
        await server.set_root_dir(directory)
        await sdk.add_any_connection(url)
        ready.set()
        await asyncio.Event().wait()

    _silent()
    asyncio.run(run())


def _silent() -> None:
    """MAVSDK logs to the standard output."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    os.dup2(null, 2)


def _fetch_with_pymavlink(address: str, name: str, into: str, size: int, read_size: int, told: Any) -> None:
    """pymavlink's client: tells how long it took, and what was wrong."""
    _silent()
    from pymavlink import mavftp, mavutil

    ended: list[float] = []

    class Client(mavftp.MAVFTP):  # type: ignore[misc]
        def _MAVFTP__terminate_session(self) -> None:
            # It has all, and closes the session.
            ended.append(time.monotonic())
            super()._MAVFTP__terminate_session()

    connection = mavutil.mavlink_connection(f"udpout:{address}", source_system=245, source_component=190)
    connection.mav.heartbeat_send(6, 8, 0, 0, 0)
    connection.wait_heartbeat()
    client = Client(connection, _MAVSDK_SYSTEM, 1)
    client.ftp_settings.burst_read_size = read_size
    begun = time.monotonic()
    # `cmd_get` gives up when it has sent nothing for 3.7 s, so in a long burst. `read` has no such limit. It also gives
    # up at times; then its user would try again.
    while (content := client.read(name, size)) is None:
        pass
    Path(into).write_bytes(content)
    told.send((ended[-1] - begun, ""))


def _fetch_with_mavsdk(address: str, name: str, into: str, size: int, read_size: int, told: Any) -> None:
    """MAVSDK's client, which chooses the size of its bursts."""
    _silent()
    from mavsdk.asyncio.mavsdk import Mavsdk
    from mavsdk.asyncio.plugins.ftp.ftp import FtpAsync
    from mavsdk.component_type import ComponentType
    from mavsdk.mavsdk import Configuration
    from mavsdk.plugins.ftp.ftp import FtpError

    async def run() -> tuple[float | None, str]:
        sdk = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
        await sdk.add_any_connection(f"udpout://{address}")
        while not (systems := await sdk.get_systems()):
            await asyncio.sleep(0.05)
        ftp = FtpAsync(systems[0])
        begun = time.monotonic()
        try:
            async for _ in ftp.download(name, os.path.dirname(into), True):
                pass
        except FtpError as error:
            return None, str(error)
        return time.monotonic() - begun, ""

    told.send(asyncio.run(run()))


CLIENTS: dict[str, Callable[..., None]] = {"pymavlink": _fetch_with_pymavlink, "MAVSDK": _fetch_with_mavsdk}


def ftp(client: str, cell: Cell, size: int, seed: str, *, read_size: int = READ_SIZE, queue: int) -> Run:
    """One file that a client of MAVLink FTP fetches."""
    payload = random.Random(f"{seed}:file").randbytes(size)
    context = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory(prefix="rass-mav-") as name, emulated(cell, seed, queue) as link:
        root, own = Path(name, "root"), Path(name, "own")
        root.mkdir()
        own.mkdir()
        (root / "file.bin").write_bytes(payload)
        ready = context.Event()
        hears, tells = context.Pipe(duplex=False)
        server = context.Process(target=_serve, args=(f"udpout://{_url(link.left)}", str(root), ready), daemon=True)
        fetch = context.Process(
            target=CLIENTS[client],
            args=(_url(link.right), "file.bin", str(own / "file.bin"), size, read_size, tells),
            daemon=True,
        )
        try:
            server.start()
            if not ready.wait(_START_S):
                raise RuntimeError("MAVSDK's server did not start")
            fetch.start()
            before = link.sent()
            told = hears.poll(_START_S + cell.patience_s(size))
            seconds, trouble = hears.recv() if told else (None, "given up")
            sent = link.sent() - before
        finally:
            for one in (fetch, server):
                if one.pid is not None:
                    one.kill()
                    one.join()
        if seconds is not None and (own / "file.bin").read_bytes() != payload:
            seconds, trouble = None, "other bytes"
        return Run(size, seconds, sent, trouble=str(trouble))


# -- all of it ---------------------------------------------------------------------------------------------------------


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """All cells: by cell and program, the figures of `figures`."""
    found: dict[str, Any] = {}
    for name in options.cells:
        one = cell(name)
        size = options.size or one.size
        # MAVSDK's server sends the whole file in one burst.
        queue = options.queue or 2 * size
        runs: dict[str, list[Run]] = {}
        # In turns, so that other load on the machine affects all alike.
        for round in range(options.rounds):
            seed = f"{options.seed}:{name}:{round}"
            runs.setdefault("ours", []).append(
                ours(one, size, seed, signed=options.signed, settings=options.set, queue=queue)
            )
            for client in () if options.skip_ftp else CLIENTS:
                runs.setdefault(client, []).append(
                    ftp(client, one, size, seed, read_size=options.read_size, queue=queue)
                )
        found[name] = {
            who: figures(one, made, signed=options.signed and who == "ours", ours=who == "ours")
            for who, made in runs.items()
        }
        if not options.json:
            show(name, found[name])
    return found


def measure_ours(cells: Sequence[str], rounds: int) -> dict[str, Any]:
    """The same of these cells, without MAVLink FTP."""
    arguments = ["--cells", *cells, "--rounds", str(rounds), "--skip-ftp", "--json"]
    found = measure(parser().parse_args(arguments))
    return {name: {**rows["ours"], "bound": cell(name).bound()} for name, rows in found.items()}


def table_of(results: dict[str, Any]) -> str:
    """A table of what `measure_ours` has found."""
    rows = []
    for name, row in results.items():
        rate, _, loss = name.partition("/")
        shares = [goodput / row["bound"] for goodput in row["goodputs"]]
        rows.append([f"{int(rate):,}, {loss} %", spread(row["goodputs"], 3), spread(shares, 3), f"{row['chunks']:.3f}"])
    return table(["bit/s, loss", "goodput", "of the bound", "chunks sent for each one"], rows)


def show(name: str, rows: dict[str, Any]) -> None:
    """Print the figures of a cell."""
    for who, row in rows.items():
        more = f"{row['of_bound']:9.3f} {row['bytes']:7.3f} {row['chunks']:7.3f}" if "of_bound" in row else ""
        runs = spread(row["goodputs"], 3) if len(row["goodputs"]) > 1 else ""
        print(f"{name:>12} {who:>10} {row['goodput']:8.3f} {more:27} {runs}", flush=True)
        for trouble in row["failed"]:
            print(f"{'':23} failed: {trouble}")


def _setting(text: str) -> tuple[str, Any]:
    key, found, value = text.partition("=")
    if not found:
        raise argparse.ArgumentTypeError(f"expected KEY=VALUE, got {text!r}")
    return key, yaml.safe_load(value)


def parser() -> argparse.ArgumentParser:
    """Of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", nargs="+", default=list(CELLS), metavar="BIT_S/PERCENT")
    parser.add_argument("--size", type=int, help="bytes of the file (256 KiB; at 1 Mbit/s 1 MiB)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--queue", type=int, help="bytes that may wait in the link (twice the file)")
    parser.add_argument("--read-size", type=int, default=READ_SIZE, help="of pymavlink's bursts (%(default)s)")
    parser.add_argument("--set", type=_setting, nargs="+", default=[], action="extend", metavar="KEY=VALUE",
                        help="a key of both nodes' configuration; links.airtime.duty is of the link")  # fmt: skip
    parser.add_argument("--signed", action="store_true", help="nodes with keys: signed frames, sealed data")
    parser.add_argument("--busy", action="store_true", help="loopback instead of the cells, on loaded processors")
    parser.add_argument("--processes", type=int, default=_BUSY_PROCESSES, help="that load them (%(default)s)")
    parser.add_argument("--skip-ftp", action="store_true")
    parser.add_argument("--json", action="store_true", help="print a JSON object")
    return parser


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    options = parser().parse_args(arguments)
    options.set = dict(options.set)
    if options.busy:
        runs = [
            busy(options.size or BUSY_SIZE, f"{options.seed}:{round}", signed=options.signed, settings=options.set,
                 processes=options.processes)
            for round in range(options.rounds)
        ]  # fmt: skip
        if options.json:
            print(json.dumps({"busy": runs}))
            return
        for run in runs:
            print(f"{run['bytes_s'] / 1e6:.2f} MB/s, {run['chunks']:.4f} chunks sent per chunk, "
                  f"{run['dropped']} datagrams dropped by the kernel")  # fmt: skip
        return
    if not options.json:
        print(f"{'bit/s / loss':>12} {'':>10} {'goodput':>8} {'of bound':>9} {'bytes':>7} {'chunks':>7}")
    found = measure(options)
    if options.json:
        print(json.dumps(found))


if __name__ == "__main__":
    main()

"""Cells, in the guest: lab.py CELLS.json. Radios, one per network namespace, and a node on each.

A cell: name, place (line, grid, fly), nodes (the base, which is the first, and the drones), loss, mac (broadcast,
unicast, batman), mcast (Mbit/s), every (s between two data of a drone; 0: none), bytes, set (KEY=VALUE, for each node),
warm, window, drain (s), seed. pictures: which nodes create one of 24,000 bytes every picture_s. grid: width. fly: side,
range, speed, walk_seed, from (s of the flight at the start of the window).

/share/results/NAME.json has its data: drone, number, s of the window, delay or null, hops, bytes, and the delay by the
ages on the way.
"""

from __future__ import annotations

import base64
import contextlib
import ctypes
import heapq
import importlib
import json
import math
import os
import random
import shutil
import signal
import socket
import struct
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

WORK = Path(os.environ["WORK"])
RUN, SHARE = Path("/mnt/wifi"), Path("/share")
PICTURE, PIECES, BSSID = 24_000, 18, "02:ca:ff:ee:ba:be"
Cell = dict[str, Any]
Spot = tuple[float, float]
_libc = ctypes.CDLL(None, use_errno=True)


def sh(command: str) -> None:
    """Run a line of shell, or give up."""
    done = subprocess.run(command, shell=True, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{command}: {done.stdout}{done.stderr}")


def enter(i: int | None) -> None:
    """Enter the namespace of node i; None: the first one."""
    fd = os.open("/proc/1/ns/net" if i is None else f"/run/netns/n{i}", os.O_RDONLY)
    if _libc.setns(fd, 0):
        raise OSError(ctypes.get_errno(), "setns")
    os.close(fd)


class Place:
    """Who hears whom."""

    def __init__(self, cell: Cell) -> None:
        self.cell, self.n = cell, cell["nodes"]
        # Random waypoints; the base stays in a corner.
        self.legs = {i: self._walk(i) for i in range(1, self.n)} if cell["place"] == "fly" else {}

    def _walk(self, i: int, until: float = 400) -> list[tuple[float, float, Spot, Spot]]:
        rng, side, t = random.Random(1000 * self.cell["walk_seed"] + i), self.cell["side"], 0.0
        a, legs = (rng.uniform(0, side), rng.uniform(0, side)), []
        while t < until:
            b = rng.uniform(0, side), rng.uniform(0, side)
            end = t + math.dist(a, b) / self.cell["speed"]
            legs.append((t, end, a, b))
            a, t = b, end
        return legs

    def at(self, i: int, t: float) -> Spot:
        if i == 0:
            return 0.0, 0.0
        start, end, a, b = next(leg for leg in self.legs[i] if t < leg[1])
        share = (max(t, 0) - start) / (end - start)
        return a[0] + (b[0] - a[0]) * share, a[1] + (b[1] - a[1]) * share

    def pairs(self, t: float) -> list[tuple[int, int]]:
        if self.cell["place"] == "line":
            return [(i, i + 1) for i in range(self.n - 1)]
        if self.cell["place"] == "grid":
            w = self.cell["width"]
            across = [(i, i + 1) for i in range(self.n - 1) if (i + 1) % w]
            return across + [(i, i + w) for i in range(self.n - w)]
        spots = [self.at(i, t) for i in range(self.n)]
        return [(i, j) for i in range(self.n) for j in range(i) if math.dist(spots[i], spots[j]) <= self.cell["range"]]

    def hops(self, t: float = 0) -> dict[int, int]:
        """Hops to the base; a node without a way to it is left out."""
        near: dict[int, list[int]] = {i: [] for i in range(self.n)}
        for i, j in self.pairs(t):
            near[i].append(j)
            near[j].append(i)
        hops, queue = {0: 0}, [0]
        for i in queue:
            for j in near[i]:
                if j not in hops:
                    hops[j] = hops[i] + 1
                    queue.append(j)
        return hops


class Air:
    """The program medium.c."""

    def __init__(self, cell: Cell, place: Place) -> None:
        self.cell, self.place = cell, place
        self.last: list[tuple[int, int]] | None = None
        self.write(0)
        command = [str(x) for x in (WORK / "medium", RUN / "links", RUN / "air.json", cell["seed"])]
        with open(RUN / "medium.log", "w") as log:
            self.process = subprocess.Popen(
                ["nice", "-n", "-10", *command], stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT
            )
        while "registered" not in (RUN / "medium.log").read_text():
            time.sleep(0.05)

    def write(self, t: float) -> bool:
        pairs = self.place.pairs(t)
        if pairs == self.last:
            return False
        self.last = pairs
        (RUN / "links.new").write_text("".join(f"{a} {b} {self.cell['loss']}\n" for a, b in pairs))
        (RUN / "links.new").rename(RUN / "links")
        return True

    def fly(self, t: float) -> None:
        if self.place.legs and self.write(t):
            self.process.send_signal(signal.SIGHUP)

    @staticmethod
    def totals() -> dict[str, int]:
        totals: dict[str, int] = json.loads((RUN / "air.json").read_text())
        return totals


def radios(cell: Cell) -> None:
    """Set up a namespace with a radio for each node."""
    n, batman = cell["nodes"], cell["mac"] == "batman"
    phys = sorted(os.listdir("/sys/class/ieee80211"), key=lambda name: int(name[3:]))
    for i in range(n):
        sh(f"ip netns add n{i}; iw phy {phys[i]} set netns name n{i}")
        steps = ["ip link set lo up", *([f"ip link set wlan{i} name wlan0"] if i else []), "iw dev wlan0 set type ibss",
                 *(["ip link set wlan0 mtu 1532"] if batman else []), "ip link set wlan0 up",
                 f"iw dev wlan0 ibss join rass 2412 NOHT fixed-freq {BSSID} mcast-rate {cell['mcast']}"]  # fmt: skip
        if batman:
            steps += ["ip link add bat0 type batadv", "ip link set wlan0 master bat0", "ip link set bat0 up"]
        steps += [f"ip addr add 192.168.4.{i + 1}/24 brd + dev {'bat0' if batman else 'wlan0'}"]
        script = " && ".join(steps)
        sh(f"nsenter --net=/run/netns/n{i} sh -c '{script}'")


def load() -> None:
    """Load the modules of a node, for all forks, and note the time of each creation in a file."""
    from rass_mav.app.light import load_without_openssl

    load_without_openssl()
    for name in ("app.run", "commands.node", "ground.commands.data", "link.udp"):
        importlib.import_module(f"rass_mav.{name}")
    from rass_mav.core.datum import DatumId
    from rass_mav.core.participant import Participant

    put = Participant.put

    # Ages on the way leave out what frames wait in the kernel.
    def noted(self: Participant, payload: bytes, *args: Any, **kwargs: Any) -> DatumId:
        at, id = time.time(), put(self, payload, *args, **kwargs)
        with open(RUN / "made", "a") as made:
            made.write(f"{id[0]} {id[2]} {at:.6f} {len(payload)}\n")
        return id

    Participant.put = noted  # type: ignore[method-assign]


def command(arguments: Sequence[str], out: Path) -> int:
    """Run `rass-mav ...` in a child that has its modules already; returns its process id."""
    sys.stdout.flush()
    if pid := os.fork():
        return pid
    fd = os.open(out, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(fd, 1), os.dup2(fd, 2)
    from rass_mav.cli import main

    code = 1
    try:
        code = main(arguments)
    except BaseException:  # noqa: BLE001  The log has it.
        traceback.print_exc()
    sys.stdout.flush()
    os._exit(code)


class Senders:
    """What creates the data."""

    def __init__(self, cell: Cell) -> None:
        self.cell = cell
        self.sockets: dict[int, socket.socket] = {}
        self.due: list[tuple[float, int, int, float, bool]] = []

    def send(self, i: int, number: int, picture: bool) -> None:
        raise NotImplementedError

    def wait(self, seconds: float) -> None:
        raise NotImplementedError

    def schedule(self) -> None:
        """Plan the data from now on."""
        rng, now = random.Random(self.cell["seed"]), time.time()
        for i in range(1, self.cell["nodes"]):
            if self.cell["every"]:
                self.due.append((now + rng.uniform(0, self.cell["every"]), i, 0, self.cell["every"], False))
            if i in self.cell.get("pictures", ()):
                every = self.cell["picture_s"]
                self.due.append((now + rng.uniform(0, every), i, 1 << 20, every, True))
        heapq.heapify(self.due)

    def work(self, seconds: float, tick: Callable[[], None]) -> None:
        end, next_tick = time.time() + seconds, 0.0
        while (now := time.time()) < end:
            if now >= next_tick:
                tick()
                next_tick = now + 0.5
            while self.due and self.due[0][0] <= now:
                at, i, number, every, picture = heapq.heappop(self.due)
                heapq.heappush(self.due, (at + every, i, number + 1, every, picture))
                self.send(i, number, picture)
            self.wait(min(end, next_tick, self.due[0][0] if self.due else end) - time.time())


class Nodes(Senders):
    """`rass-mav run`, one in each namespace."""

    def __init__(self, cell: Cell) -> None:
        super().__init__(cell)
        self.pids: dict[int, int] = {}

    def start(self) -> None:
        for i in range(self.cell["nodes"]):
            path = RUN / f"n{i + 1}.yaml"
            path.write_text(
                f"node: {{id: {i + 1}, role: {'drone' if i else 'base'}, step_s: 1}}\nautopilot: {{url: null}}\n"
                'links:\n  - {type: udp, listen: "0.0.0.0:14600", broadcast: "192.168.4.255:14600", '
                f"data: {self.cell['mac']}}}\n"
                f"store: {{path: {RUN}/n{i + 1}.db}}\nmavlink: {{system_id: {i + 1}}}\nlog: {{level: info}}\n"
                "data: {interval_steps: 0}\n"
            )
            options = [word for value in self.cell["set"] for word in ("--set", value)]
            enter(i)
            self.pids[i] = command(["run", str(path), *options], RUN / f"n{i + 1}.log")
            enter(None)
            time.sleep(random.Random(self.cell["seed"] * 100 + i).uniform(0.1, 0.5))
        while not all((RUN / f"n{i + 1}.sock").exists() for i in self.pids):
            time.sleep(0.2)

    def status(self, i: int) -> Any:
        with socket.socket(socket.AF_UNIX) as s:
            s.settimeout(30)
            s.connect(str(RUN / f"n{i + 1}.sock"))
            s.sendall(b'{"command": "status"}\n')
            return json.loads(s.makefile("rb").readline())["status"]

    def busy(self) -> float:
        """Seconds of processor that all nodes have used."""
        tasks = [task for pid in self.pids.values() for task in Path(f"/proc/{pid}/task").iterdir()]
        return sum(int((task / "schedstat").read_text().split()[0]) for task in tasks) / 1e9

    def send(self, i: int, number: int, picture: bool) -> None:
        if i not in self.sockets:
            self.sockets[i] = socket.socket(socket.AF_UNIX)
            self.sockets[i].connect(str(RUN / f"n{i + 1}.sock"))
        with contextlib.suppress(BlockingIOError):
            self.sockets[i].recv(9999, socket.MSG_DONTWAIT)
        payload = base64.b64encode(random.randbytes(PICTURE if picture else self.cell["bytes"])).decode()
        self.sockets[i].sendall(json.dumps({"command": "put", "payload": payload}).encode() + b"\n")

    def wait(self, seconds: float) -> None:
        time.sleep(max(0, seconds))

    def data(self, t0: float, t1: float) -> list[list[Any]]:
        """What was created from t0 to t1."""
        os.waitpid(command(["ls", str(RUN / "n1.yaml"), "--json"], RUN / "ls"), 0)
        listed = json.loads((RUN / "ls").read_text())["data"]
        came = {tuple(int(x) for x in d["id"].split("-")[::2]): d for d in listed}
        out: list[list[Any]] = []
        for line in (RUN / "made").read_text().splitlines():
            words = line.split()
            drone, number, at, size = int(words[0]), int(words[1]), float(words[2]), int(words[3])
            if t0 <= at < t1 and drone != 1:
                d = came.get((drone, number))
                late = (None, None, None) if d is None else (d["arrived"] - at, d["hops"], d["arrived"] - d["created"])
                out.append([drone, number, at - t0, *late[:2], size, late[2]])
        return out

    def end(self, missing: bool) -> dict[str, Any]:
        out: dict[str, Any] = {"status": {i + 1: self.status(i) for i in self.pids}}
        for pid in self.pids.values():
            os.kill(pid, signal.SIGTERM)
        for pid in self.pids.values():
            os.waitpid(pid, 0)
        logs = {i + 1: (RUN / f"n{i + 1}.log").read_text().splitlines() for i in self.pids}
        out["logs"] = {i: [x for x in log if missing or "WARN" in x or "ERROR" in x][-60:] for i, log in logs.items()}
        return out


class Datagrams(Senders):
    """Numbered datagrams to the base, each sent once, through batman-adv."""

    def __init__(self, cell: Cell) -> None:
        super().__init__(cell)
        self.sent: dict[tuple[int, int], tuple[float, bool]] = {}
        self.came: dict[tuple[int, int], dict[int, float]] = {}

    def start(self) -> None:
        for i in range(self.cell["nodes"]):
            enter(i)
            self.sockets[i] = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self.sockets[i].bind(("0.0.0.0", 14600))
            enter(None)

    def send(self, i: int, number: int, picture: bool) -> None:
        self.sent[i, number] = time.time(), picture
        for piece in range(PIECES if picture else 1):
            content = struct.pack("!HIB", i, number, piece)
            try:
                size = math.ceil(PICTURE / PIECES) if picture else self.cell["bytes"]
                self.sockets[i].sendto(content.ljust(size, b"x"), ("192.168.4.1", 14600))
            except OSError as error:
                print(i, error)

    def wait(self, seconds: float) -> None:
        self.sockets[0].settimeout(max(seconds, 0.0001))
        with contextlib.suppress(TimeoutError):
            i, number, piece = struct.unpack_from("!HIB", self.sockets[0].recv(2000))
            self.came.setdefault((i, number), {}).setdefault(piece, time.time())

    def data(self, t0: float, t1: float) -> list[list[Any]]:
        out: list[list[Any]] = []
        for (i, number), (at, picture) in sorted(self.sent.items()):
            if t0 <= at < t1:
                pieces = self.came.get((i, number), {})
                late = max(pieces.values()) - at if len(pieces) == (PIECES if picture else 1) else None
                out.append([i + 1, number, at - t0, late, None, PICTURE if picture else self.cell["bytes"], None])
        return out

    def busy(self) -> float:
        return 0.0

    def end(self, missing: bool) -> dict[str, Any]:
        return {}


def cpu() -> list[int]:
    """The processor's times so far, by what it did."""
    return [int(x) for x in Path("/proc/stat").read_text().splitlines()[0].split()[1:9]]


def run(cell: Cell) -> None:
    """Run one cell and write its result."""
    RUN.mkdir(parents=True)
    place = Place(cell)
    # Without the program all radios would hear each other, and stations that vanish are taken leave of a minute later.
    sh(f"modprobe mac80211_hwsim radios={cell['nodes']}" + ("; modprobe batman-adv" if cell["mac"] == "batman" else ""))
    air = Air(cell, place)
    radios(cell)
    senders: Datagrams | Nodes = Datagrams(cell) if cell["mac"] == "batman" else Nodes(cell)
    senders.start()
    t0 = time.time() + cell["warm"]

    def tick() -> None:
        air.fly(cell.get("from", 0) + time.time() - t0)

    senders.work(cell["warm"], tick)
    before, c, busy, t0 = air.totals(), cpu(), senders.busy(), time.time()
    senders.schedule()
    senders.work(cell["window"], tick)
    senders.due.clear()
    t1, d, busy = time.time(), cpu(), senders.busy() - busy
    senders.work(cell["drain"], tick)
    after = air.totals()
    data = senders.data(t0, t1)
    times = [cell.get("from", 0) + s / 2 for s in range(2 * cell["window"])]
    reached = [place.hops(t) for t in times] if place.legs else []
    result = {
        "cell": cell, "data": data, "s": (after["us"] - before["us"]) / 1e6, "window": t1 - t0,
        "air": {k: after[k] - before[k] for k in after}, "nodes_busy": busy / (t1 - t0),
        "busy": 1 - (d[3] - c[3]) / (sum(d) - sum(c)), "hops": {i + 1: h for i, h in place.hops().items()},
        "without_way": [sum(i not in hops for hops in reached) / 2 for i in range(cell["nodes"])],
        **senders.end(any(x[3] is None for x in data)),
    }  # fmt: skip
    new = SHARE / "results" / "new"
    new.write_text(json.dumps(result))
    new.rename(SHARE / "results" / f"{cell['name']}.json")
    air.process.terminate()


def main() -> None:
    """Run each cell in a child."""
    cells = json.loads(Path(sys.argv[1]).read_text())
    if any(cell["mac"] != "batman" for cell in cells):
        load()
    for cell in cells:
        if not (pid := os.fork()):
            run(cell)
            os._exit(0)
        if os.waitpid(pid, 0)[1]:
            sys.exit(1)
        sh("ip -all netns delete; sleep 1; rmmod mac80211_hwsim")
        shutil.rmtree(RUN)


if __name__ == "__main__":
    main()

"""Installs the drone's part into emulated ARM Debians, and runs a node there.

    sudo .venv/bin/python -m tools.emulated_pi                 all of them, some minutes each
    sudo .venv/bin/python -m tools.emulated_pi armel --keep DIR

Each system is unpacked from Debian's own packages, and QEMU's user emulation runs its Python. Nothing is mounted,
registered or booted. The program is installed as docs/how-to/install.md describes. Then a mock vehicle sends
readings to
a node over a serial port, and the node hands a datum over to a base that runs here, on another processor. Packages
come from the sources that apt and pip use on this computer. This needs a Debian with debootstrap and
qemu-user-static, and root for debootstrap. The exit code is 1 if any of the systems fails.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import platform
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from tests.mock_vehicle import MockVehicle
from tests.ptys import SerialDevice

ROOT = Path(__file__).resolve().parents[1]
#: Longest that a node may take for its datum, seconds: an emulated one is slow.
PATIENCE_S = 180.0
READING = 42.0
_WAIT = "print('{}', flush=True); input()"


class Board(NamedTuple):
    """A kind of Raspberry Pi, as far as it can be emulated."""

    qemu: str
    cpu: str
    compiled: bool
    """Whether the package index has all that is compiled; else it comes from Debian, or not at all."""
    what: str


BOARDS = {
    "arm64": Board("qemu-aarch64-static", "cortex-a53", True, "Zero 2, Pi 3 and newer, 64-bit system"),
    "armhf": Board("qemu-arm-static", "cortex-a7", False, "Pi 2 and newer, 32-bit system"),
    "armel": Board(
        "qemu-arm-static", "arm1176", False, "Zero and Pi 1: their processor, with Debian's soft-float system"
    ),
}


class FailedError(Exception):
    """Something did not work there."""


def run(*command: str, **environment: str) -> str:
    """Run a program; returns what it prints. Raises `FailedError` with the last line of its errors."""
    done = subprocess.run(command, env={**clean(), **environment}, capture_output=True, text=True, check=False)
    if done.returncode:
        raise FailedError(f"{' '.join(command[:4])} ...: {(done.stderr.strip() or done.stdout.strip())[-400:]}")
    return done.stdout


def clean() -> dict[str, str]:
    """The environment without what leads a Python to the packages of this one."""
    return {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}


class System:
    """A Debian of another architecture below a folder."""

    def __init__(self, arch: str, folder: Path) -> None:
        self.board = BOARDS[arch]
        self.arch = arch
        self.root = folder / arch
        self.environment = self.root / "opt" / "rass-mav"

    def unpack(self) -> None:
        """Fetch the packages and unpack them. They are not set up: Python does not need that."""
        packages = ["python3", "python3-venv", "python3-pip"]
        packages += [] if self.board.compiled else ["python3-lxml", "python3-serial", "python3-yaml"]
        release = platform.freedesktop_os_release()["VERSION_CODENAME"]
        (mirror, *_) = run("apt-get", "indextargets", "--format", "$(REPO_URI)", "Created-By: Packages").split()
        options = ["--download-only", "--variant=minbase", f"--include={','.join(packages)}"]
        run("debootstrap", f"--arch={self.arch}", *options, release, str(self.root), mirror)
        for package in sorted(self.root.glob("var/cache/apt/archives/*.deb")):
            run("dpkg-deb", "-x", str(package), str(self.root))
            package.unlink()

    def python(self, *arguments: str, path: str = "opt/rass-mav/bin/python3") -> list[str]:
        """The command that runs its Python with these arguments."""
        emulator = [self.board.qemu, "-cpu", self.board.cpu, "-L", str(self.root)]
        return [*emulator, str(self.root / path), "-I", *arguments]

    def install(self, wheels: Path) -> None:
        """Install the drone's part, as docs/how-to/install.md says."""
        # What `venv` would start to get pip could not run: this system knows no emulator. Its own pip is used.
        run(
            *self.python(
                "-m", "venv", "--without-pip", "--system-site-packages", str(self.environment), path="usr/bin/python3"
            )
        )
        pip = self.python("-m", "pip", "install", "-q", "--only-binary", ":all:")
        (program,) = wheels.glob("rass_mav-*.whl")
        if self.board.compiled:
            run(*pip, f"{program}[drone]")
        else:
            run(*pip, "--no-index", "--no-deps", *map(str, wheels.glob("*.whl")))

    def missing(self) -> str:
        """What pip misses there."""
        done = subprocess.run(
            self.python("-m", "pip", "check"), env=clean(), capture_output=True, text=True, check=False
        )
        return "; ".join(done.stdout.splitlines()) if done.returncode else "nothing"


def make_wheels(folder: Path) -> Path:
    """The program, and what else is pure Python if it is told to be."""
    source, wheels = folder / "source", folder / "wheels"
    source.mkdir()
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    for name in ("rass_mav", "firmware_params"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    pip = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", str(wheels)]
    run(*pip, "--no-build-isolation", str(source))
    run(*pip, "--no-binary", "pymavlink", "pymavlink", "termcolor", PYMAVLINK_FAST_INDEX="0")
    return wheels


def memory_mib(pid: int) -> float:
    """Resident memory of an emulated process, without the emulator's program, its heap and the code it translated."""
    kib, counts = 0, False
    for line in Path(f"/proc/{pid}/smaps").read_text().splitlines():
        words = line.split()
        if "-" in words[0] and not words[0].endswith(":"):
            counts = "x" not in words[1] and not words[-1].startswith(("[", "/usr/bin/qemu"))
        elif words[0] == "Rss:" and counts:
            kib += int(words[1])
    return kib / 1024


@contextlib.contextmanager
def started(command: Sequence[str], folder: Path) -> Iterator[tuple[subprocess.Popen[str], float]]:
    """A process that has said its first line, and how many seconds that took. It is stopped, and must end well."""
    begin = time.monotonic()
    pipe = subprocess.PIPE
    with subprocess.Popen(command, cwd=folder, env=clean(), stdin=pipe, stdout=pipe, stderr=pipe, text=True) as process:
        assert process.stdout is not None
        try:
            first = process.stdout.readline()
            yield process, time.monotonic() - begin
            process.send_signal(signal.SIGTERM)
            _, errors = process.communicate(timeout=PATIENCE_S)
        finally:
            process.kill()
    if not first or process.returncode not in (0, -signal.SIGTERM):
        raise FailedError(f"exit code {process.returncode}: {errors.strip()[-400:]}")


def configure(folder: Path, port: SerialDevice) -> None:
    """A drone at the serial port and a base, each the other's neighbour on this computer."""
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(2)]
        for each in sockets:
            each.bind(("127.0.0.1", 0))
        drone, base = (f"127.0.0.1:{each.getsockname()[1]}" for each in sockets)
    sections: dict[str, dict[str, Any]] = {
        "drone": {
            "node": {"id": 7},
            "autopilot": {"url": f"serial:{port.path}:57600"},
            "links": [{"listen": drone, "peers": [{"address": base, "id": 1}]}],
            "risk": {"low": 0.5, "high": 300},
        },
        "base": {
            "node": {"id": 1, "role": "base"},
            "links": [{"listen": base, "peers": [{"address": drone, "id": 7}]}],
        },
    }
    for name, section in sections.items():
        section["store"] = {"path": str(folder / f"{name}.db")}
        # JSON is YAML too.
        (folder / f"{name}.yaml").write_text(json.dumps(section))


def fly(system: System, folder: Path) -> dict[str, Any]:
    """Run a node there until its datum is at the base. Raises `FailedError`."""
    folder.mkdir()
    port = SerialDevice(folder / "serial0").plug()
    configure(folder, port)
    here = [sys.executable, "-I", "-m", "rass_mav"]
    vehicle = MockVehicle(7)
    vehicle.reading = READING
    bare = system.python("-c", _WAIT.format("ready"))
    dialect = system.python("-c", "from pymavlink.dialects.v20 import common; " + _WAIT.format("ready"))
    memory = {}
    for name, command in (("bare", bare), ("dialect", dialect)):
        with started(command, folder) as (process, _):
            memory[name] = memory_mib(process.pid)
    with (
        vehicle.on_pty(port.far),
        started([*here, "run", "base.yaml", "--json"], folder),
        started(system.python("-m", "rass_mav", "run", "drone.yaml", "--json"), folder) as (node, start_s),
    ):
        deadline = time.monotonic() + PATIENCE_S
        while not (data := json.loads(run(*here, "ls", str(folder / "base.yaml"), "--json"))["data"]):
            if time.monotonic() > deadline or node.poll() is not None:
                raise FailedError("no datum came to the base")
            time.sleep(1)
        memory["node"] = memory_mib(node.pid)
        status = json.loads(run(*system.python("-m", "rass_mav", "status", str(folder / "drone.yaml"), "--json")))
    port.unplug()
    if data[0]["measurement"]["reading"] != READING or status["hop_count"] != 1:
        raise FailedError(f"not what was measured: {data[0]}")
    return {"start_s": start_s, **memory}


def check(arch: str, folder: Path, wheels: Path) -> str:
    """What one system shows, in words. Raises `FailedError`."""
    system = System(arch, folder)
    begin = time.monotonic()
    system.unpack()
    unpacked = time.monotonic()
    system.install(wheels)
    installed = time.monotonic()
    machine, version = run(*system.python("-c", "import platform as p; print(p.machine(), p.python_version())")).split()
    missing = system.missing()
    found = fly(system, folder / f"{arch}-node")
    bare, dialect, node = (f"{found[name]:.1f}" for name in ("bare", "dialect", "node"))
    return (
        f"{arch} ({system.board.what}): {machine}, {system.board.cpu}, Python {version}\n"
        f"  Debian's packages {unpacked - begin:.0f} s, the program {installed - unpacked:.0f} s (emulated)\n"
        f"  missing for pip: {missing}\n"
        f"  MiB of memory: Python {bare}, with the dialect {dialect}, node {node}\n"
        f"  node ready after {found['start_s']:.1f} s (emulated); its datum came to a base on {platform.machine()}"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Check the systems asked for."""
    parser = argparse.ArgumentParser(
        description="Installs the drone's part into emulated ARM Debians and runs a node there "
        "(docs/how-to/install.md).",
        epilog="example: sudo .venv/bin/python -m tools.emulated_pi armhf",
    )
    parser.add_argument("arch", nargs="*", choices=[*BOARDS, "all"], default="all", help="which systems (all)")
    parser.add_argument("--keep", metavar="DIR", type=Path, help="a new folder for the systems; else they are removed")
    options = parser.parse_args(arguments)
    arches = BOARDS if "all" in options.arch else options.arch
    needed = ["debootstrap", "dpkg-deb", "apt-get", *sorted({BOARDS[arch].qemu for arch in arches})]
    missing = [name for name in needed if shutil.which(name) is None]
    if missing or os.geteuid() != 0:
        programs = f"{', '.join(missing)} (Debian: apt install debootstrap qemu-user-static)"
        print(f"needs {programs if missing else 'root, for debootstrap'}", file=sys.stderr)
        return 2
    failed = False
    with contextlib.ExitStack() as stack:
        folder = options.keep or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="emulated-pi-")))
        folder.mkdir(parents=True, exist_ok=True)
        try:
            wheels = make_wheels(folder.resolve())
            for arch in arches:
                print(check(arch, folder.resolve(), wheels), flush=True)
        except FailedError as error:
            print(f"failed: {error}", file=sys.stderr)
            failed = True
    return int(failed)


if __name__ == "__main__":
    raise SystemExit(main())

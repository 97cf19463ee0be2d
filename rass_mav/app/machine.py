"""The state of the computer, as Linux reports it. What cannot be read is unknown; nothing here ever fails."""

from __future__ import annotations

import os
import time
from pathlib import Path

from rass_mav.mavlink.component import ComputerStatus

_MIB = 1 << 20


class Machine:
    """Reads the state of the computer. It keeps the processor times, to compute the load since the last call."""

    def __init__(self, store: Path, root: Path = Path("/")) -> None:
        """:param store: a file on the disk to report.
        :param root: the folder with `proc` and `sys`.
        """
        self._store = store
        self._proc = root / "proc"
        self._thermal = root / "sys/class/thermal/thermal_zone0/temp"
        self._busy: list[tuple[int, int]] = []

    def status(self) -> ComputerStatus:
        """The present state. Processor load: since the last call, or since the computer was started."""
        uptime_s = time.clock_gettime(time.CLOCK_BOOTTIME)
        return ComputerStatus(uptime_s, self._cores(), self._temperature(), *self._memory(), *self._disk())

    def _cores(self) -> tuple[float, ...]:
        times = []
        for line in _read(self._proc / "stat").splitlines():
            name, *numbers = line.split()
            if name.startswith("cpu") and name != "cpu" and len(numbers) >= 5 and all(n.isdecimal() for n in numbers):
                # user nice system idle iowait irq softirq steal; user includes guests.
                values = [int(number) for number in numbers[:8]]
                times.append((sum(values) - values[3] - values[4], sum(values)))
        before = self._busy if len(self._busy) == len(times) else [(0, 0)] * len(times)
        self._busy = times
        return tuple(
            100.0 * (busy - old_busy) / max(1, total - old_total)
            for (busy, total), (old_busy, old_total) in zip(times, before, strict=True)
        )

    def _memory(self) -> tuple[float | None, float | None]:
        sizes = {}
        for line in _read(self._proc / "meminfo").splitlines():
            name, _, rest = line.partition(":")
            number = rest.split()[:1]
            if number and number[0].isdecimal():
                sizes[name] = int(number[0]) / 1024.0
        total, free = sizes.get("MemTotal"), sizes.get("MemAvailable")
        return (None if total is None or free is None else total - free), total

    def _temperature(self) -> float | None:
        try:
            return int(_read(self._thermal)) / 1000.0
        except ValueError:
            return None

    def _disk(self) -> tuple[float | None, float | None]:
        try:
            disk = os.statvfs(self._store.parent)
        except OSError:
            return None, None
        total = disk.f_blocks * disk.f_frsize / _MIB
        return total - disk.f_bavail * disk.f_frsize / _MIB, total


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="ascii", errors="replace")
    except OSError:
        return ""

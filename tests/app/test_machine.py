"""How the computer does, from files as Linux has them."""

from __future__ import annotations

from pathlib import Path

from rass_mav.app.machine import Machine

STAT = "cpu  30 0 30 140 0 0 0 0 0 0\ncpu0 {} 0 10 {} 10 0 0 0 0 0\ncpu1 10 0 10 80 0 0 0 0 0 0\nintr 5 0\n"


def files(root: Path, **contents: str) -> None:
    places = {"stat": "proc/stat", "meminfo": "proc/meminfo", "temp": "sys/class/thermal/thermal_zone0/temp"}
    for name, text in contents.items():
        path = root / places[name]
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


def test_a_computer_in_numbers(tmp_path: Path) -> None:
    meminfo = "MemTotal:         439132 kB\nMemFree: 1 kB\nMemAvailable:     302092 kB\n"
    files(tmp_path, stat=STAT.format(20, 60), meminfo=meminfo, temp="48692\n")
    machine = Machine(tmp_path / "rass-7.db", tmp_path)
    first = machine.status()
    assert first.cores_percent == (30.0, 20.0), "since it was started; waiting for a disk is no work"
    assert first.temperature_c == 48.692
    assert first.ram_total_mib == 439132 / 1024
    assert first.ram_used_mib == (439132 - 302092) / 1024
    assert first.storage_total_mib is not None
    assert first.storage_used_mib is not None
    assert 0 < first.storage_used_mib <= first.storage_total_mib
    assert first.uptime_s > 0
    files(tmp_path, stat=STAT.format(50, 130))
    assert machine.status().cores_percent == (30.0, 0.0), "since the last time"


def test_what_cannot_be_read_is_unknown(tmp_path: Path) -> None:
    status = Machine(tmp_path / "away" / "rass-7.db", tmp_path / "nothing").status()
    assert status[1:] == ((), None, None, None, None, None)
    files(tmp_path, stat="cpu0 a b c d e\ncpu1 1\n\xff", meminfo="MemTotal\nMemAvailable: x kB\n:\n", temp="hot")
    assert Machine(tmp_path / "rass-7.db", tmp_path).status()[1:5] == ((), None, None, None)


def test_this_computer_is_understood(tmp_path: Path) -> None:
    status = Machine(tmp_path / "rass-7.db").status()
    assert status.cores_percent
    assert status.ram_total_mib
    assert status.ram_used_mib
    assert status.ram_used_mib < status.ram_total_mib

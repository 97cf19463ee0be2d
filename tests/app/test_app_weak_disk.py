"""A node whose disk cannot be written, as a process on a file system that is mounted read-only."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

MOUNTED = """
import subprocess, sys
from pathlib import Path
disk = Path(sys.argv[1])

def mount(*options):
    subprocess.run(["mount", *options], check=True, capture_output=True)

try:
    mount("-t", "tmpfs", "-o", "size=512k", "tmpfs", str(disk))
except (subprocess.CalledProcessError, FileNotFoundError):
    sys.exit(77)
config = disk / "n1.yaml"
config.write_text("node: {id: 1, role: base, step_s: 0.1}\\nstore: {path: " + str(disk / "n1.db") + "}\\nlinks: []\\n")
mount("-t", "tmpfs", "-o", "remount,ro,size=512k", "tmpfs", str(disk))
command = [sys.executable, "-m", "rass_mav", "run", str(config)]
node = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
for line in node.stderr:
    print(line, end="", flush=True)
    if "cannot be queried" in line:
        break
node.terminate()
print("exit", node.wait(20))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="mounts a file system of its own")
def test_a_node_starts_on_a_read_only_disk_and_says_so(tmp_path: Path) -> None:
    command = ["unshare", "--user", "--map-root-user", "--mount"] if os.geteuid() else ["unshare", "--mount"]
    ran = subprocess.run(
        [*command, sys.executable, "-c", MOUNTED, str(tmp_path)],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    if ran.returncode in (1, 77) and "Traceback" not in ran.stderr:
        pytest.skip("may not mount here")
    assert "RASS: store cannot be written (read-only file system): relaying only, no data accepted" in ran.stdout, (
        ran.stderr
    )
    assert ran.stdout.endswith("exit 0\n"), ran.stdout

"""`rass-mav status`: what needs attention first, at a base that of all drones."""

from __future__ import annotations

import json
import re
from pathlib import Path

from tests.app.app_nodes import RunningNode, Tidy, command, line_of


def test_a_base_names_its_drones(tmp_path: Path, tidy: Tidy) -> None:
    base, far = (tidy(node) for node in line_of(tmp_path, [1, 2]))
    base.start()
    first = command(tmp_path, "status", base.config).stdout.decode().splitlines()
    assert any(line.startswith("WARNING: no drone has been heard. ") for line in first[:3])
    far.start()
    far.ask("put", payload=b"a datum")
    base.until(lambda: any(entry.id.origin == 2 for entry in base.listing().values()))
    lines = command(tmp_path, "status", base.config).stdout.decode().splitlines()
    assert not any("no drone has been heard" in line for line in lines)
    neighbours = (command(tmp_path, "status", node.config).stdout.decode() for node in (base, far))
    seen = [line for said in neighbours for line in said.splitlines() if line.startswith("  node ")]
    assert [re.sub(r"[\d.]+", "N", line) for line in seen] == [
        "  node N: N hops, risk N, cost N, heard N s ago", "  node N: N hops, base, heard N s ago",
    ], "a base without a sensor announces the worst risk, and is in no danger"  # fmt: skip
    [at] = [number for number, line in enumerate(lines) if line.startswith("node 1 (base)")]
    assert all(line.startswith(("ALARM: ", "WARNING: ", "NOTE: ")) for line in lines[:at])
    [socket] = tmp_path.glob("*1.sock")
    for words in ([base.config], ["--socket", str(socket)]):
        said = json.loads(command(tmp_path, "status", *words, "--json").stdout)
        assert said["node_id"] == 1
        assert not any(one["kind"] == "nothing" for one in said["attention"]), "it finds the store beside the socket"
    for node in (base, far):
        node.end()


def test_a_drone_names_what_it_lacks(tmp_path: Path, tidy: Tidy) -> None:
    link = {"listen": "127.0.0.1:0", "peers": [{"address": "127.0.0.1:9"}]}
    drone = tidy(RunningNode(tmp_path, 7, links=[link])).start()
    lines = command(tmp_path, "status", drone.config).stdout.decode().splitlines()
    assert "WARNING: no route to a base. Data wait there: bring a base or a relay near." in lines[:3]
    drone.end()


def test_a_base_whose_store_cannot_be_read_here_says_so(tmp_path: Path, tidy: Tidy) -> None:
    base = tidy(RunningNode(tmp_path, 1, node={"role": "base"})).start()
    [socket] = tmp_path.glob("*.sock")
    (tmp_path / "elsewhere").mkdir()
    moved = tmp_path / "elsewhere" / "node.sock"
    moved.symlink_to(socket)
    lines = command(tmp_path, "status", "--socket", str(moved)).stdout.decode().splitlines()
    assert any("nothing is known of the drones: " in line for line in lines[:3])
    base.end()

"""`rass-mav keys`, and what commands and nodes say of keys."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import signal
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest
import yaml

from rass_mav.app.config import RunConfig, load_config
from rass_mav.app.service import check_visible
from rass_mav.config.keys import in_words
from rass_mav.config.loading import to_plain
from rass_mav.doctor import watch
from rass_mav.errors import ConfigError, ServiceError
from rass_mav.trust.keys.autopilot import autopilot_key, autopilot_passphrase
from rass_mav.trust.keys.files import read_ground, read_keys
from rass_mav.trust.keys.folder import issue
from rass_mav.trust.keys.identity import NodeKeys
from rass_mav.trust.keys.secret import Secret
from tests.app.app_nodes import ROOT, RunningNode, command, free_ports, line_of

OPEN = "open: no keys, anyone can send on the link"


def keys(directory: Path, *arguments: str, code: int = 0) -> str:
    """What `rass-mav keys` says. Errors are one line."""
    done = command(directory, "keys", *arguments)
    assert done.returncode == code, done.stderr
    assert (done.stderr.count(b"\n"), done.stdout.count(b"\n") > 0) == (1 if code else 0, not code)
    return (done.stderr if code else done.stdout).decode().rstrip()


def drone(path: Path) -> NodeKeys:
    held = read_keys(path)
    assert isinstance(held, NodeKeys)
    return held


def mission(directory: Path, *drones: int) -> str:
    """A mission in `m`. Returns its name."""
    assert keys(directory, "new", "m")
    if drones:
        assert keys(directory, "drone", *map(str, drones), "-d", "m")
    return read_ground(directory / "m/ground.keys").public.mission


# -- a mission's folder ------------------------------------------------------------------------------------------------


def test_a_new_mission(tmp_path: Path) -> None:
    name = mission(tmp_path)
    assert re.fullmatch("[0-9a-f]{8}", name)
    assert [(file.name, file.stat().st_mode & 0o777) for file in (tmp_path / "m").iterdir()] == [("ground.keys", 0o600)]
    assert (tmp_path / "m").stat().st_mode & 0o777 == 0o700
    before = (tmp_path / "m/ground.keys").read_bytes()
    said = "m/ground.keys: already exists, and these keys could not be recovered; choose another folder"
    assert keys(tmp_path, "new", "m", code=2) == said
    assert (tmp_path / "m/ground.keys").read_bytes() == before
    other = json.loads(keys(tmp_path, "new", "deep/er", "--json"))
    assert other == {
        "mission": read_ground(tmp_path / "deep/er/ground.keys").public.mission,
        "file": "deep/er/ground.keys",
    }
    assert other["mission"] != name


def test_each_drone_is_issued_once(tmp_path: Path) -> None:
    name = mission(tmp_path, 7, 8)
    assert drone(tmp_path / "m/drone-7.keys").about == {"mission": name, "node_id": 7, "serial": 1, "link_key": 1}
    before = (tmp_path / "m/drone-7.keys").read_bytes()
    said = (
        "drone 7: already has keys (serial 1); --replace: for another drone in its place; --again: for the same drone"
    )
    assert keys(tmp_path, "drone", "9", "7", "-d", "m", code=2) == said
    (tmp_path / "m/drone-7.keys").unlink()
    assert keys(tmp_path, "drone", "7", "-d", "m", code=2) == said
    # Nothing was written for 9.
    assert read_ground(tmp_path / "m/ground.keys").serials == {7: 1, 8: 1}
    assert sorted(os.listdir(tmp_path / "m")) == ["drone-8.keys", "ground.keys"]
    keys(tmp_path, "drone", "7", "--again", "-d", "m")
    assert (tmp_path / "m/drone-7.keys").read_bytes() == before
    for how in ("--again", "--replace"):
        assert (
            keys(tmp_path, "drone", "9", how, "-d", "m", code=2)
            == "drone 9: has no keys yet; rass-mav keys drone 9 -d m"
        )


def test_commands_at_the_same_time_lose_no_serial(tmp_path: Path) -> None:
    name = mission(tmp_path)
    with ThreadPoolExecutor(8) as pool:
        issued = list(pool.map(lambda id: issue(tmp_path / "m", [id]), range(8)))
    assert {each.keys.ground.mission for [each] in issued} == {name}
    assert read_ground(tmp_path / "m/ground.keys").serials == dict.fromkeys(range(8), 1)


def test_a_replaced_drone_has_other_keys_and_a_higher_serial(tmp_path: Path) -> None:
    mission(tmp_path, 7, 8)
    before, eight = drone(tmp_path / "m/drone-7.keys"), (tmp_path / "m/drone-8.keys").read_bytes()
    said = json.loads(keys(tmp_path, "drone", "7", "7", "--replace", "-d", "m", "--json"))
    after = drone(tmp_path / "m/drone-7.keys")
    assert said["drones"] == [{"id": 7, "serial": 2, "file": "m/drone-7.keys"}]
    assert (before.certificate.serial, after.certificate.serial) == (1, 2)
    assert before.secret != after.secret
    assert before.ground == after.ground
    assert (tmp_path / "m/drone-8.keys").read_bytes() == eight
    assert "copy ground.keys to the bases" in keys(tmp_path, "drone", "7", "--replace", "-d", "m")
    assert read_ground(tmp_path / "m/ground.keys").serials == {7: 3, 8: 1}


def test_a_file_of_another_drone_or_mission_is_not_written_over(tmp_path: Path) -> None:
    mission(tmp_path, 7, 8)
    keys(tmp_path, "new", "other")
    path = tmp_path / "other/drone-7.keys"
    shutil.copy2(tmp_path / "m/drone-7.keys", path)
    said = "other/drone-7.keys: does not hold the keys of drone 7 of this mission; move the file away"
    assert keys(tmp_path, "drone", "7", "-d", "other", code=2) == said
    shutil.copy2(tmp_path / "m/drone-8.keys", tmp_path / "m/drone-7.keys")
    for arguments in (["drone", "7", "--again"], ["drone", "7", "--replace"], ["rotate"]):
        assert keys(tmp_path, *arguments, "-d", "m", code=2) == said.replace("other", "m")
    (tmp_path / "m/drone-7.keys").write_text("precious")
    assert keys(tmp_path, "drone", "7", "--again", "-d", "m", code=2).endswith(" or move the file away")
    assert (tmp_path / "m/drone-7.keys").read_text() == "precious"
    ground = read_ground(tmp_path / "m/ground.keys")
    assert (ground.serials, ground.number) == ({7: 1, 8: 1}, 1)


def test_the_link_key_changes(tmp_path: Path) -> None:
    name = mission(tmp_path, 7, 8)
    files = [tmp_path / f"m/drone-{id}.keys" for id in (7, 8)]
    before = drone(files[0]).link
    files[1].unlink()  # was moved to its drone
    said = json.loads(keys(tmp_path, "rotate", "-d", "m", "--json"))
    drones = [{"id": id, "serial": 1, "file": f"m/drone-{id}.keys"} for id in (7, 8)]
    assert said == {"mission": name, "link_key": 2, "revoked": [], "drones": drones}
    one, other = (drone(path).link for path in files)
    assert (before.number, one.number) == (1, 2)
    assert one == other
    assert one.key != before.key
    assert keys(tmp_path, "rotate", "-d", "m").startswith("link key 3 from now on, for 2 drones; ")
    assert read_ground(tmp_path / "m/ground.keys").number == 3
    # Whoever gets keys later gets that of the others.
    keys(tmp_path, "drone", "9", "-d", "m")
    assert drone(tmp_path / "m/drone-9.keys").link == drone(files[0]).link


def test_a_drone_is_revoked(tmp_path: Path) -> None:
    name = mission(tmp_path, 7, 8, 9)
    before = (tmp_path / "m/drone-8.keys").read_bytes()
    assert keys(tmp_path, "revoke", "8", "-d", "m").splitlines() == [
        "drone 8, serial 1: revoked",
        "link key 2 from now on, for 2 drones; their files here were rewritten",
        "a base that runs on m/ground.keys loads it within seconds and sends it to the drones over the air;",
        "copy it to the other bases and to the backup (no restart needed)",
        "rass-mav report shows the link key that each drone had in its last status",
    ]
    assert [drone(tmp_path / f"m/drone-{id}.keys").link.number for id in (7, 8, 9)] == [2, 1, 2]
    assert (tmp_path / "m/drone-8.keys").read_bytes() == before
    ground = read_ground(tmp_path / "m/ground.keys")
    assert (ground.number, ground.serials, ground.revoked) == (2, {7: 1, 8: 1, 9: 1}, frozenset({8}))
    remedy = "--replace creates new keys for another drone in its place"
    assert keys(tmp_path, "revoke", "7", "8", "-d", "m", code=2) == f"drone 8: is already revoked (serial 1); {remedy}"
    assert keys(tmp_path, "drone", "8", "--again", "-d", "m", code=2) == f"drone 8: is revoked (serial 1); {remedy}"
    said = "drone 5: has no keys to revoke; rass-mav keys show m/ground.keys"
    assert keys(tmp_path, "revoke", "5", "-d", "m", code=2) == said
    assert read_ground(tmp_path / "m/ground.keys") == ground
    assert "drones: 7 (serial 1), 8 (serial 1, revoked), 9 (serial 1)" in keys(tmp_path, "show", "m/ground.keys")
    # It stays so with the next change, until its place is given to another one.
    assert json.loads(keys(tmp_path, "revoke", "9", "9", "-d", "m", "--json")) == {
        "mission": name,
        "link_key": 3,
        "revoked": [{"id": 9, "serial": 1}],
        "drones": [{"id": 7, "serial": 1, "file": "m/drone-7.keys"}],
    }
    assert read_ground(tmp_path / "m/ground.keys").revoked == {8, 9}
    keys(tmp_path, "drone", "8", "--replace", "-d", "m")
    assert read_ground(tmp_path / "m/ground.keys").revoked == {9}
    assert drone(tmp_path / "m/drone-8.keys").link.number == 3


def test_a_damaged_mission_is_left_alone(tmp_path: Path) -> None:
    mission(tmp_path, 7)
    path = tmp_path / "m/ground.keys"
    path.write_bytes(path.read_bytes()[:-5])
    for arguments in (["drone", "8"], ["drone", "7", "--replace"], ["rotate"]):
        assert keys(tmp_path, *arguments, "-d", "m", code=2).startswith("m/ground.keys: damaged, ")
    assert sorted(os.listdir(tmp_path / "m")) == ["drone-7.keys", "ground.keys"]
    shutil.copy2(tmp_path / "m/drone-7.keys", path)
    said = "m/ground.keys: holds the keys of drone 7; use the mission's ground.keys"
    assert keys(tmp_path, "drone", "8", "-d", "m", code=2) == said
    path.unlink()
    missing = "m/ground.keys: no such file; name the mission's folder (-d DIR), or create one (rass-mav keys new DIR)"
    assert keys(tmp_path, "drone", "8", "-d", "m", code=2) == missing
    assert keys(tmp_path, "revoke", "7", "-d", "m", code=2) == missing
    remedy = "use a mission's folder that you can write to (-d DIR)"
    assert keys(tmp_path, "drone", "8", "-d", "none", code=2) == f"none: no such file or directory; {remedy}"
    assert keys(tmp_path, "new", "m/drone-7.keys", code=2) == f"m/drone-7.keys: file exists; {remedy}"


@pytest.mark.parametrize("id", ["65535", "-1", "seven", "٧"])
def test_what_is_no_node_id(id: str, tmp_path: Path) -> None:
    assert "argument ID: expected a node id, 0 to 65534" in keys(tmp_path, "drone", "-d", "m", "--", id, code=2)


def test_what_is_not_secret_is_shown(tmp_path: Path) -> None:
    name = mission(tmp_path, 7, 8)
    keys(tmp_path, "drone", "7", "--replace", "-d", "m")
    keys(tmp_path, "rotate", "-d", "m")
    assert keys(tmp_path, "show", "m/ground.keys").splitlines() == [
        f"the ground's keys of mission {name}: never copy them to a drone",
        "drones: 7 (serial 2), 8 (serial 1)",
        "link key 2",
    ]
    assert keys(tmp_path, "show", "m/drone-7.keys").splitlines() == [
        f"the keys of drone 7, serial 2, of mission {name}",
        "link key 2",
    ]
    drones = [{"id": 7, "serial": 2, "revoked": False}, {"id": 8, "serial": 1, "revoked": False}]
    plain = {"mission": name, "link_key": 2}
    assert json.loads(keys(tmp_path, "show", "m/ground.keys", "--json")) == {
        **plain,
        "holds": "ground",
        "drones": drones,
    }
    shown = json.loads(keys(tmp_path, "show", "m/drone-7.keys", "--json"))
    assert shown == {**plain, "holds": "drone", "node_id": 7, "serial": 2}


# -- nodes -------------------------------------------------------------------------------------------------------------


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    """Ends what a test has left running."""
    with ExitStack() as stack:
        yield stack


def test_five_commands_from_an_empty_folder_to_a_base_and_three_drones(tmp_path: Path, stack: ExitStack) -> None:
    """Those in docs/how-to/keys.md; scp copies to a folder here."""
    page = (ROOT / "docs/how-to/keys.md").read_text()
    (block,) = re.findall(r"## From an empty folder\n\n.*\n\n((?:    .*\n)+)", page)
    lines = [shlex.split(line) for line in block.splitlines()]
    assert len(lines) == 5
    for program, *arguments in lines:
        if program == "rass-mav":
            assert command(tmp_path, *arguments).returncode == 0
        else:
            assert (program, arguments[0], arguments[2][-1]) == ("scp", "-p", ":")
            shutil.copy2(tmp_path / arguments[1], tmp_path)
    name = read_ground(tmp_path / "mission/ground.keys").public.mission
    first, *others = line_of(tmp_path, [1, 7, 8, 9])
    for node in (first, *others):
        stack.callback(node.end)
        config = yaml.safe_load((tmp_path / node.config).read_text())
        held = "mission/ground.keys" if node is first else f"drone-{config['node']['id']}.keys"
        (tmp_path / node.config).write_text(yaml.safe_dump({**config, "keys": {"file": held}}))
        node.start()
    for node, node_id in zip((first, *others), (1, 7, 8, 9), strict=True):
        serial = 0 if node is first else 1
        about = {"mission": name, "node_id": node_id, "serial": serial, "link_key": 1}
        assert node.status()["keys"] == about
    said = command(tmp_path, "status", others[0].config).stdout.decode().splitlines()
    line = f"keys: mission {name}, drone 7, serial 1, link key 1; frames are signed, and data are sealed"
    assert line in said
    (check,) = [
        c
        for c in json.loads(command(tmp_path, "doctor", others[0].config, "--json").stdout)["checks"]
        if c["name"] == "keys"
    ]
    assert (check["level"], check["text"]) == ("pass", line.removeprefix("keys: "))
    assert all(node.signal(signal.SIGTERM) == 0 for node in (first, *others))
    log = "".join(node.log() for node in (first, *others))
    assert line in log
    secret = yaml.safe_load((tmp_path / "drone-7.keys").read_text())["secret"]
    for text in (log, *map(str, (node.about for node in (first, *others)))):
        assert secret[:8] not in text


def config(directory: Path, **sections: Any) -> str:
    port, peer = free_ports(2)
    links = [{"listen": f"127.0.0.1:{port}", "peers": [{"address": f"127.0.0.1:{peer}"}]}]
    (directory / "n.yaml").write_text(yaml.safe_dump({"node": {"id": 7}, "links": links, **sections}))
    return "n.yaml"


def test_without_keys_a_node_is_open(tmp_path: Path, stack: ExitStack, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watch, "MOST_S", 0.5)
    node = RunningNode(tmp_path, 7, links=[{"listen": "127.0.0.1:0", "peers": [{"address": "127.0.0.1:9"}]}])
    stack.callback(node.end)
    node.start()
    assert node.status()["keys"] is None
    assert OPEN in command(tmp_path, "status", node.config).stdout.decode().splitlines()
    assert f"pass  keys: {OPEN}\n" in command(tmp_path, "doctor", node.config).stdout.decode()
    assert node.signal(signal.SIGTERM) == 0
    assert OPEN in node.log()


@pytest.mark.parametrize(
    ("sections", "file", "said"),
    [
        ({}, "m/none.keys", "m/none.keys: no such file or directory; rass-mav keys writes these files "
         "(documentation: how-to/keys)"),
        ({}, "m/drone-8.keys", "m/drone-8.keys: holds the keys of drone 8, but this is node 7; use drone-7.keys "
         "(rass-mav keys drone 7)"),
        ({}, "m/ground.keys", "m/ground.keys: holds the ground's keys, which must never be on a drone; remove it from "
         "this computer, and use drone-7.keys (rass-mav keys drone 7)"),
        ({"node": {"id": 1, "role": "base"}}, "m/drone-7.keys",
         "m/drone-7.keys: holds the keys of drone 7, not the ground's; use the mission's ground.keys"),
        ({"node": {"id": 7, "role": "base"}}, "m/ground.keys",
         "m/ground.keys: node 7 is a drone of this mission; give the base another node.id"),
    ],
)  # fmt: skip
def test_a_node_does_not_start_with_keys_that_are_not_its_own(
    sections: dict[str, Any], file: str, said: str, tmp_path: Path
) -> None:
    mission(tmp_path, 7, 8)
    name = config(tmp_path, keys={"file": file}, **sections)
    done = command(tmp_path, "run", name)
    assert (done.returncode, done.stderr.decode()) == (2, f"{tmp_path}/{said}\n")
    done = command(tmp_path, "check", name)
    # A file that is not there may still come.
    code, level = (0, " warning:") if "none.keys" in file else (2, "")
    assert (done.returncode, done.stderr.decode()) == (code, f"n.yaml:{level} keys.file: {tmp_path}/{said}\n")


def test_the_doctor_finds_keys_that_are_not_the_nodes_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watch, "MOST_S", 0.5)
    mission(tmp_path, 7, 8)
    done = command(tmp_path, "doctor", config(tmp_path, keys={"file": "m/drone-8.keys"}))
    assert done.returncode == 1
    said = f"fail  keys: {tmp_path}/m/drone-8.keys: holds the keys of drone 8, but this is node 7; "
    assert said in done.stdout.decode()


def test_keys_need_pynacl(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rass_mav.config.keys.find_spec", lambda name: None)
    said = "keys: need the Python package PyNaCl; pip install -e '.[keys]' in the checkout\n"
    for arguments in (["keys", "new", "m"], ["run", config(tmp_path, keys={"file": "drone-7.keys"})]):
        done = command(tmp_path, *arguments)
        assert (done.returncode, done.stderr.decode()) == (2, said)
    assert not (tmp_path / "m").exists()
    assert load_config(tmp_path / config(tmp_path)).open_keys() is None


def test_a_configuration_shows_the_path_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mission(tmp_path, 7)
    monkeypatch.chdir(tmp_path)
    loaded = load_config(config(tmp_path, keys={"file": "m/drone-7.keys"}))
    assert loaded.open_keys() is not None
    shown = {"file": str(tmp_path / "m/drone-7.keys"), "accept_open": False}
    assert to_plain(loaded)["keys"] == shown
    secret = yaml.safe_load(Path("m/drone-7.keys").read_text())["secret"]
    assert secret[:8] not in repr(loaded)
    done = command(tmp_path, "check", "n.yaml", "--print")
    assert yaml.safe_load(done.stdout)["keys"] == shown
    assert done.stderr == b""


def test_the_passphrase_of_an_autopilot(tmp_path: Path) -> None:
    mission(tmp_path, 7, 8)
    shown = json.loads(keys(tmp_path, "autopilot", "7", "-d", "m", "--json"))
    assert (shown["id"], shown["serial"]) == (7, 1)
    assert re.fullmatch(r"(?:[a-z2-7]{5}-){4}[a-z2-7]{5}", shown["passphrase"])
    # The drone has the same, and no other drone has.
    assert keys(tmp_path, "autopilot", "m/drone-7.keys").split("\n")[0] == shown["passphrase"]
    assert keys(tmp_path, "autopilot", "8", "-d", "m").split("\n")[0] != shown["passphrase"]
    # A new link key changes nothing; another drone in its place has another one.
    keys(tmp_path, "rotate", "-d", "m")
    assert keys(tmp_path, "autopilot", "7", "-d", "m").split("\n")[0] == shown["passphrase"]
    keys(tmp_path, "drone", "7", "--replace", "-d", "m")
    assert keys(tmp_path, "autopilot", "7", "-d", "m").split("\n")[0] != shown["passphrase"]
    assert keys(tmp_path, "autopilot", "7", "--serial", "1", "-d", "m").split("\n")[0] == shown["passphrase"]
    assert shown["passphrase"] not in keys(tmp_path, "show", "m/drone-7.keys")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["9", "-d", "m"], "drone 9: has no keys yet; rass-mav keys drone 9 -d m"),
        (["7", "--serial", "2", "-d", "m"], "drone 7: its last serial is 1, not 2; choose 1 to 1"),
        (["m/drone-7.keys", "--serial", "1"], "--serial: requires a node id and the mission's folder"),
        (["m/ground.keys"],
         "m/ground.keys: holds the ground's keys; name a drone by its node id, with -d and the mission's folder"),
    ],
)  # fmt: skip
def test_an_autopilot_without_a_passphrase(arguments: list[str], said: str, tmp_path: Path) -> None:
    mission(tmp_path, 7)
    assert keys(tmp_path, "autopilot", *arguments, code=2) == said


def test_a_passphrase_follows_from_the_secret_alone() -> None:
    """What autopilots have must not change with the program. The key is what ground stations make of the passphrase."""
    secret = Secret(bytes(range(32)))
    passphrase = "duaae-7mtce-qrvmq-c3zns-ds5b5"
    assert autopilot_passphrase(secret) == passphrase
    assert autopilot_key(secret).reveal() == sha256(passphrase.encode()).digest()


def test_only_a_base_accepts_open_data(tmp_path: Path) -> None:
    path = tmp_path / config(tmp_path, keys={"file": "m/drone-7.keys", "accept_open": True})
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    assert caught.value.lines() == [f"{path}: keys.accept_open: applies to bases only"]


def test_a_service_finds_its_keys_in_its_own_folder(tmp_path: Path) -> None:
    home, etc = tmp_path / "var/lib/rass-mav", tmp_path / "etc/rass-mav"
    home.mkdir(parents=True)
    etc.mkdir(parents=True)
    (tmp_path / config(tmp_path, keys={"file": "drone-7.keys"})).rename(etc / "node.yaml")
    moved = load_config(etc / "node.yaml", root=tmp_path)
    assert moved.keys is not None
    assert moved.keys.file == str(home / "drone-7.keys")
    loaded = load_config(tmp_path / config(tmp_path, keys={"file": "/tmp/drone-7.keys"}), settle=False)
    with pytest.raises(ServiceError, match=r"^keys\.file: the service has its own /tmp"):
        check_visible(loaded, ())


def test_in_words() -> None:
    assert in_words(None) == OPEN
    said = in_words({"mission": "4f2a91c3", "node_id": 1, "serial": 0, "link_key": 2})
    assert said == "keys: mission 4f2a91c3, base 1, link key 2; frames are signed, and data are sealed"
    assert RunConfig().keys is None

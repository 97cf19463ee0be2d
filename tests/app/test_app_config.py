"""Configuration files: what is read, and what is said of those that are wrong."""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from rass_mav.app.config import RunConfig, filled_in, load_config
from rass_mav.cli import main
from rass_mav.config.loading import MAX_VALUES, convert, dump_yaml, read_yaml, set_key, to_plain
from rass_mav.core.settings import CustodySettings
from rass_mav.errors import MOST_LINES, ConfigError
from rass_mav.policy.settings import kinds as policies
from rass_mav.sensor.kinds import KINDS
from tests.extent import examples

EXAMPLES = Path(__file__).resolve().parents[2] / "docs" / "examples"
LINKS = "links: [{peers: [{address: '10.0.0.1:14600'}]}]\n"
DRONE = "node: {id: 7}\n" + LINKS


def complaint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str | bytes) -> str:
    monkeypatch.chdir(tmp_path)
    path = Path("node.yaml")
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    said = str(caught.value)
    assert "\n" not in said
    return said


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (DRONE + "policy: {alpha: ten}", "node.yaml: policy.alpha: expected a number >= 0, got 'ten'"),
        (DRONE + "policy:\n  alpha: 2,5",
         "node.yaml: policy.alpha: expected a number >= 0, got '2,5' (a number has a decimal point: 2.5)"),
        (DRONE + "policy: {alpha: 2,5}",
         "node.yaml: line 3: expected a name as key, got 5 (a number has a decimal point)"),
        (DRONE + "policy: {alpha: -1}", "node.yaml: policy.alpha: expected a number >= 0, got -1"),
        (DRONE + "policy: {alpha: .nan}", "node.yaml: policy.alpha: expected a finite number, got nan"),
        (DRONE + "policy: {alfa: 1}", "node.yaml: policy.alfa: unknown key (did you mean 'alpha'?)"),
        (DRONE + "polic: {}", "node.yaml: polic: unknown key (did you mean 'policy'?)"),
        (DRONE + "log: {zzz: 1}", "node.yaml: log.zzz: unknown key (known: level)"),
        (DRONE + "policy: 3", "node.yaml: policy: expected a section with keys name, alpha, beta, threshold, hop_cost, "
         "unknown_hops, rules, got 3"),
        ("node: {id: 7}\nlinks: [{peers: ['127.0.0.1:9']}]",
         "node.yaml: links[0].peers[0]: expected a section with keys address (optional: id), got '127.0.0.1:9'"),
        (DRONE + "policy: {name: best}",
         f"node.yaml: policy.name: expected one of {', '.join(sorted(policies()))}, got 'best'"),
        (DRONE + "policy: {name: rass, alpha: 0, beta: 0}",
         "node.yaml: policy.alpha: alpha and beta must not both be 0"),
        (DRONE + "risk: {gain: 1.5}", "node.yaml: risk.gain: expected a number > 0 and <= 1, got 1.5"),
        (DRONE + "risk: {scale: logarithmic}",
         "node.yaml: risk.low: expected a number > 0 with risk.scale logarithmic, got 0"),
        (DRONE + "sensor: {type: geiger}",
         f"node.yaml: sensor.type: expected one of {', '.join(sorted(KINDS))}, got 'geiger'"),
        (DRONE + "sensor: {type: gmc}",
         "node.yaml: sensor.port: missing, expected the counter's serial port with sensor.type gmc"),
        (DRONE + "sensor: {type: log}", "node.yaml: sensor.path: missing, expected a bGeigie log with sensor.type log"),
        (DRONE + "sensor: {port: /dev/ttyUSB0}",
         "node.yaml: sensor.port: has no effect with sensor.type autopilot, got '/dev/ttyUSB0'"),
        (DRONE + "sensor: {tube: j305}",
         "node.yaml: sensor.tube: has no effect with sensor.type autopilot, got 'j305'"),
        (DRONE + "sensor: {type: log, path: a.LOG, baud: 9600}",
         "node.yaml: sensor.baud: has no effect with sensor.type log, got 9600"),
        (DRONE + "sensor: {type: gmc, port: /dev/ttyUSB0, path: a.LOG}",
         "node.yaml: sensor.path: has no effect with sensor.type gmc, got 'a.LOG'"),
        (DRONE + "sensor: {type: gmc, port: /dev/ttyUSB0, speed: 2}",
         "node.yaml: sensor.speed: has no effect with sensor.type gmc, got 2.0"),
        (DRONE + "sensor: {unit: cpm}", "node.yaml: sensor.unit: has no effect with sensor.type autopilot, got 'cpm'"),
        (DRONE + "sensor: {type: gmc, port: /dev/ttyUSB0, tube: sbm20}",
         "node.yaml: sensor.tube: expected one of j305, lnd-7317, m4011, safecast, sbm-20, got 'sbm20'"),
        (DRONE + "sensor: {type: gmc, port: /dev/ttyUSB0, cpm_per_usvh: 0}",
         "node.yaml: sensor.cpm_per_usvh: expected a number > 0, got 0"),
        (DRONE + "sensor: {type: gmc, port: /dev/ttyUSB0, baud: fast}",
         "node.yaml: sensor.baud: expected a whole number >= 50 and <= 4000000, got 'fast'"),
        (DRONE + "risk: {unit: sievert}",
         "node.yaml: risk.unit: expected one of counts, cpm, cps, usvh, got 'sievert'"),
        (DRONE + "risk: {unit: cpm}\nsensor: {type: gmc, port: /dev/ttyUSB0}",
         "node.yaml: risk.unit: expected usvh as in sensor.unit, or null, got 'cpm'"),
        (DRONE + "risk: {unit: counts}\nsensor: {type: log, path: a.LOG, unit: cps}",
         "node.yaml: risk.unit: expected cps as in sensor.unit, or null, got 'counts'"),
        (DRONE + "risk: {low: 1, high: 1}", "node.yaml: risk.high: expected a number above risk.low (1), got 1"),
        ("node: {id: 65535}\n" + LINKS, "node.yaml: node.id: expected a whole number >= 0 and <= 65534, got 65535"),
        ("node: {id: 1, role: king}\n" + LINKS, "node.yaml: node.role: expected one of base, drone, got 'king'"),
        ("node: {id: 1, forward: later}\n" + LINKS,
         "node.yaml: node.forward: expected one of immediate, step, got 'later'"),
        (DRONE + "custody: {replicas: true, mode: none}",
         "node.yaml: custody.replicas: expected false with custody.mode none, got true"),
        (DRONE + "custody: {replicas: 2}", "node.yaml: custody.replicas: expected true or false, got 2"),
        (DRONE + "custody: {receipts: false}",
         "node.yaml: custody.receipts: no longer a setting: all nodes have it. Only a mock swarm can leave it out: "
         "without: [receipts]"),
        (DRONE + "routing: {max_hops: 9}",
         "node.yaml: routing.max_hops: no longer a setting: expected 250 or nothing, got 9"),
        (DRONE + "mavlink: {reading_name: ''}",
         "node.yaml: mavlink.reading_name: expected text of 1 to 10 characters, got ''"),
        (LINKS + "mavlink: {system_id: null}",
         "node.yaml: node.id: missing, expected a whole number 0..65534 (or give mavlink.system_id)"),
        ("node: {id: 1}", "node.yaml: links: a drone needs at least one"),
        ("node: {id: 1}\nlinks: 3", "node.yaml: links: expected a list, got 3"),
        ("node: {id: 1}\nlinks: [{peers: [{id: 3}]}]", "node.yaml: links[0].peers[0].address: missing, expected text"),
        ("node: {id: 1}\nlinks: [{peers: [{id: x, address: 'a:1'}]}]",
         "node.yaml: links[0].peers[0].id: expected a whole number >= 0 and <= 65534, got 'x'"),
        ("node: {id: 1}\nlinks: [{peers: [{address: '10.0.0.1'}]}]",
         "node.yaml: links[0].peers[0].address: expected host:port (IPv4 address or name), got '10.0.0.1'"),
        ("node: {id: 1}\nlinks: [{listen: 'x:99999', broadcast: 'b:1'}]",
         "node.yaml: links[0].listen: expected a port 0..65535 after the colon, got 'x:99999'"),
        ("node: {id: 1}\nlinks: [{broadcast: '10.0.0.255:0'}]",
         "node.yaml: links[0].broadcast: expected a port 1..65535 after the colon, got '10.0.0.255:0'"),
        ("node: {id: 1}\nlinks: [{multicast: '10.0.0.1:1'}]",
         "node.yaml: links[0].multicast: expected a multicast group 224.0.0.0 .. 239.255.255.255 and a port, "
         "got '10.0.0.1:1'"),
        ("node: {id: 1}\nlinks: [{listen: '0.0.0.0:14600', multicast: '239.255.82.83:14600'}]",
         "node.yaml: links[0].multicast: expected a port other than that of links[0].listen, "
         "got '239.255.82.83:14600'"),
        (DRONE + "autopilot: {url: 'udpin:0.0.0.0:14600'}",
         "node.yaml: links[0].listen: expected a port other than that of autopilot.url, got '0.0.0.0:14600'"),
        ("node: {id: 7, role: base}\nautopilot: {url: 'udpin:127.0.0.1:14550'}\nground: {url: 'udp://:14550'}",
         "node.yaml: ground.url: expected a port other than that of autopilot.url, got 'udp://:14550'"),
        ("node: {id: 1}\nlinks: [{listen: '0.0.0.0:5', broadcast: '10.0.0.255:5'}, "
         "{listen: '0.0.0.0:5', broadcast: '10.0.1.255:5'}]",
         "node.yaml: links[1].listen: expected a port other than that of links[0].listen, got '0.0.0.0:5'"),
        ("node: {id: 1}\nlinks: [{multicast: '239.0.0.1:1', interface: 'wlan 0'}]",
         "node.yaml: links[0].interface: expected the name of a network interface or its own IPv4 address, "
         "got 'wlan 0'"),
        ("node: {id: 1}\nlinks: [{}]",
         "node.yaml: links[0]: expected at least one of peers, broadcast and multicast"),
        (DRONE + "autopilot: {url: 'serial:///dev/ttyAMA0'}",
         "node.yaml: autopilot.url: expected a device and its speed in bit/s (for example serial:/dev/ttyAMA0:921600), "
         "got 'serial:///dev/ttyAMA0'"),
        (DRONE + f"control: {{socket: {'x' * 200}}}",
         f"node.yaml: control.socket: expected a path of at most 107 bytes, got '{'x' * 200}'"),
        (DRONE + "store: {path: ''}", "node.yaml: store.path: expected a path, got ''"),
        (DRONE + "policy: {name: stigmergy}\ndata: {bytes: 500}", None),
        ("a: 1\nb: [1, 2", "node.yaml: line 2: expected ',' or ']', but got '<stream end>'"),
        ("node: {id: 1}\nnode: {id: 2}", "node.yaml: line 2: key 'node' appears twice"),
        ("node:\n  id: 1\n  id: 1", "node.yaml: line 3: key 'id' appears twice"),
        ("1: 2", "node.yaml: line 1: expected a name as key, got 1"),
        ("a: &x 1\nb: *x", "node.yaml: line 2: aliases (*name) are not supported"),
        ("- 1", "node.yaml: expected keys with values, got [1]"),
        ("x: " + "[" * 5000, "node.yaml: nested too deeply"),
        (b"\xff\xfe\x00", "node.yaml: not UTF-8 text (byte 0)"),
        (b"a: \x00", None),
        ("a: 2026-99-99", "node.yaml: not YAML: month must be in 1..12"),
        ("#" * (1 << 18) + "#", "node.yaml: larger than 262144 bytes"),
        ("a: [" + "1, " * 60_000 + "]", "node.yaml: line 1: more than 10000 values"),
        ("- 1\n" * 60_000, "node.yaml: line 10000: more than 10000 values"),
        ("a: [&x 1" + ", *x" * 60_000 + "]", "node.yaml: line 1: aliases (*name) are not supported"),
        ("a: &a [x, x]\nb: &b [*a, *a]\nc: &c [*b, *b]", "node.yaml: line 2: aliases (*name) are not supported"),
        ("a: &x {b: 1}\nc: {<<: *x}", "node.yaml: line 2: aliases (*name) are not supported"),
        ("a: " + "- " * 100, None),
        ("a: " + "[" * 40 + "]" * 40, "node.yaml: nested too deeply"),
        ("a: " + "x" * 5000, "node.yaml: line 1: a value of more than 4096 characters"),
        ("x" * 5000 + ": 1", None),
        ("a: " + ":".join(["1"] * 2000) + ".5", None),
        ("a: " + "9" * 400, "node.yaml: line 1: a number with too many digits"),
        ("a: 0x" + "f" * 4000, "node.yaml: line 1: a number with too many digits"),
        (DRONE + 'store: {path: "a\\0b.db"}',
         "node.yaml: store.path: expected text without control characters, got 'a\\x00b.db'"),
        (DRONE + 'control: {socket: "a\\nb.sock"}',
         "node.yaml: control.socket: expected text without control characters, got 'a\\nb.sock'"),
        (DRONE + 'store: {path: "\\uD800.db"}',
         "node.yaml: store.path: expected text without control characters, got '\\ud800.db'"),
        (DRONE + 'autopilot: {url: "serial:/dev/tty\\0:57600"}',
         "node.yaml: autopilot.url: expected text without control characters, got 'serial:/dev/tty\\x00:57600'"),
        (DRONE + 'sensor: {type: log, path: "\\e[2J"}',
         "node.yaml: sensor.path: expected text without control characters, got '\\x1b[2J'"),
        (DRONE + 'store: {"pa\\nth": x}',
         "node.yaml: store: expected a name as key, got 'pa\\nth'"),
        ('"\\x9b": 1', "node.yaml: the whole file: expected a name as key, got '\\x9b'"),
    ],
)  # fmt: skip
def test_each_mistake_is_one_line_that_names_file_and_key(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str | bytes, expected: str | None
) -> None:
    said = complaint(tmp_path, monkeypatch, text)
    assert said.startswith("node.yaml: ")
    if expected is not None:
        assert said == expected


SEVERAL = """
node: {id: 70000, rolle: base}
autopilot: {url: ttyAMA0, messages: {GLOBAL_POSITION_INT: 1, NOT_THIS: 1, NOR_THIS: 2}}
links:
  - {listen: 'x:99999', brodcast: '10.0.0.255:14600'}
  - {type: rope}
  - {type: udp, device: /dev/ttyUSB0, broadcast: '10.0.0.255', ttl: 300}
policy: {alpha: ten, beta: .nan}
risk: {low: 5, high: 1}
sensor: {path: a.LOG, baud: 9600}
store: {overflow: drop-oldest}
"""


@pytest.mark.parametrize(
    "text",
    [
        "links: [{listen: '127.0.0.1:14600', multicast: '239.255.82.83:14600'}]",
        "links: [{listen: '10.0.0.1:5', broadcast: '10.0.0.255:5'}, {listen: '10.0.1.1:5', broadcast: '10.0.1.255:5'}]",
        "links: [{listen: '0.0.0.0:0', multicast: '239.0.0.1:5'}, {listen: '0.0.0.0:0', multicast: '239.0.0.1:5'}]",
        "links: [{listen: '0.0.0.0:14600', broadcast: '10.0.0.255:14600'}]\nautopilot: {url: 'udpout:10.0.0.9:14600'}",
    ],
)
def test_ports_that_do_not_meet(tmp_path: Path, text: str) -> None:
    path = tmp_path / "node.yaml"
    path.write_text("node: {id: 7}\n" + text)
    load_config(path)


def test_all_mistakes_are_told_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And none that only follows from another: there is a peer to the first link, and a type to the second."""
    monkeypatch.chdir(tmp_path)
    Path("node.yaml").write_text(SEVERAL)
    with pytest.raises(ConfigError) as caught:
        load_config("node.yaml", ["risk.gain=2", "links.9.ttl=1", "node.step_s=["])
    assert caught.value.lines() == [
        "--set links.9.ttl: links has items 0 to 2, not 9",
        "--set node.step_s: line 1: expected the node content, but found '<stream end>'",
        "node.yaml: policy.beta: expected a finite number, got nan",
        "node.yaml: node.id: expected a whole number >= 0 and <= 65534, got 70000",
        "node.yaml: node.rolle: unknown key (did you mean 'role'?)",
        "node.yaml: links[0].brodcast: unknown key (did you mean 'broadcast'?)",
        "node.yaml: links[1].type: expected one of autopilot, rnode, serial, udp, got 'rope'",
        "node.yaml: links[2].ttl: expected a whole number >= 0 and <= 255, got 300",
        "node.yaml: policy.alpha: expected a number >= 0, got 'ten'",
        "node.yaml: risk.gain: expected a number > 0 and <= 1, got 2",
        "node.yaml: links[0].listen: expected a port 0..65535 after the colon, got 'x:99999'",
        "node.yaml: links[2].device: belongs to type serial or rnode, this link is udp",
        "node.yaml: links[2].broadcast: expected host:port (IPv4 address or name), got '10.0.0.255'",
        "node.yaml: autopilot.url: expected udpin:host:port, udpout:host:port, tcp:host:port or serial:device:baud "
        "(for example udpin:0.0.0.0:14550 or serial:/dev/ttyAMA0:921600), got 'ttyAMA0'",
        "node.yaml: autopilot.messages: NOT_THIS: not a message of the common dialect",
        "node.yaml: autopilot.messages: NOR_THIS: not a message of the common dialect",
        "node.yaml: sensor.baud: has no effect with sensor.type autopilot, got 9600",
        "node.yaml: sensor.path: has no effect with sensor.type autopilot, got 'a.LOG'",
    ]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("node: {id: 1, role: king}", ["node.role: expected one of base, drone, got 'king'"]),
        ("node: {id: x}\n" + LINKS, ["node.id: expected a whole number >= 0 and <= 65534, got 'x'"]),
        ("node: {id: 1}\nlink: []", ["link: unknown key (did you mean 'links'?)"]),
        (DRONE + "policy: {name: best}\ndata: {bytes: 500}",
         [f"policy.name: expected one of {', '.join(sorted(policies()))}, got 'best'"]),
        (DRONE + "policy: {name: rass, alpha: 0, beta: 0}\nstore: {overflow: drop-oldest}",
         ["policy.alpha: alpha and beta must not both be 0",
          "store.overflow: drop-oldest breaks custody, expected custody.mode none with it"]),
        ("node: {id: 1}\nlinks: [{type: autopilot}, {type: autopilot}]",
         ["links[0].type: autopilot needs autopilot.url",
          "links[1].type: only one link can go through the autopilot"]),
        ("node: {id: 1}\nlinks: [{type: autopilot}]\nautopilot: {ulr: 'udpin::14550'}\nmavlink: {autopilot_id: 1}",
         ["autopilot.ulr: unknown key (did you mean 'url'?)"]),
        (DRONE + "sensor: {type: geiger, port: a}",
         [f"sensor.type: expected one of {', '.join(sorted(KINDS))}, got 'geiger'"]),
        (DRONE + "risk: {scale: logarithmic, high: -1}",
         ["risk.low: expected a number > 0 with risk.scale logarithmic, got 0",
          "risk.high: expected a number above risk.low (0), got -1"]),
    ],
)  # fmt: skip
def test_what_only_follows_from_a_mistake_is_not_told(tmp_path: Path, text: str, expected: list[str]) -> None:
    path = tmp_path / "node.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    assert caught.value.lines() == [f"{path}: {line}" for line in expected]


@pytest.mark.parametrize(
    ("text", "command"),
    [
        ("nodes: 9\nradio: {preset: wifi-6m}\nnode: {step_s: 1}", "swarm mine.yaml --steps 0"),
        ("nodes: 9\nmobility: {}\nflight: {}", "sitl mine.yaml"),
    ],
)
def test_a_scenario_is_told_what_reads_it(
    text: str, command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine.yaml").write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_config("mine.yaml")
    assert caught.value.lines() == [
        f"mine.yaml: looks like a scenario of a mock swarm, not a node's configuration: use rass-mav {command}"
    ]


def test_one_key_of_a_scenario_makes_none(tmp_path: Path) -> None:
    path = tmp_path / "node.yaml"
    path.write_text(DRONE + "radio: {}")
    with pytest.raises(ConfigError, match=r"radio: unknown key \(known: node, "):
        load_config(path)


def test_a_file_full_of_mistakes_fills_no_screen(tmp_path: Path) -> None:
    path = tmp_path / "node.yaml"
    path.write_text(DRONE + "".join(f"key{n}: 1\n" for n in range(MOST_LINES + 7)))
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    assert len(caught.value.lines()) == MOST_LINES + 1
    assert caught.value.lines()[-1] == "and 7 more mistakes"


def test_a_missing_file_and_a_directory(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.yaml: no such file or directory$"):
        read_yaml(tmp_path / "none.yaml")
    with pytest.raises(ConfigError, match=r" is a folder, not a file$"):
        read_yaml(tmp_path)


def test_what_is_no_file_is_refused_and_never_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/zero"), Path("/dev/null")):
        with pytest.raises(ConfigError, match=f"{path}: expected a file, got something else$"):
            read_yaml(path)


@pytest.mark.no_cover
def test_a_file_full_of_values_is_not_read_to_its_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What comes behind the bound is not even looked at."""
    composed = 0
    compose = yaml.SafeLoader.compose_node

    def counting(self: yaml.SafeLoader, *where: Any) -> Any:
        nonlocal composed
        composed += 1
        return compose(self, *where)

    monkeypatch.setattr(yaml.SafeLoader, "compose_node", counting)
    for text in ("- 1\n" * 65_000, "{" * 65_000, "a: [" + "{}," * 65_000, "? - " * 60_000):
        composed = 0
        assert complaint(tmp_path, monkeypatch, text)
        assert composed <= MAX_VALUES


@pytest.mark.parametrize("assignment", ['store.path="a\\0b"', "store.pa\nth=x", "node.id=" + "[" * 3000])
def test_set_is_no_way_around(tmp_path: Path, assignment: str) -> None:
    path = tmp_path / "node.yaml"
    path.write_text(DRONE)
    with pytest.raises(ConfigError) as raised:
        load_config(path, [assignment])
    assert "\n" not in str(raised.value)
    assert "\0" not in str(raised.value)


def test_an_empty_file_is_all_defaults(tmp_path: Path) -> None:
    path = tmp_path / "node.yaml"
    path.write_text("# nothing\n")
    assert convert(read_yaml(path), RunConfig, "node.yaml") == RunConfig()


def test_numbers_without_a_dot_are_numbers(tmp_path: Path) -> None:
    path = tmp_path / "node.yaml"
    path.write_text(DRONE + "risk: {low: 1e-3, high: 2E+1}\n")
    risk = load_config(path).risk
    assert (risk.low, risk.high) == (0.001, 20.0)


def test_set_overrides_the_file(tmp_path: Path) -> None:
    path = tmp_path / "node.yaml"
    path.write_text(DRONE)
    config = load_config(
        path,
        [
            "policy.name=hop-count",
            "store.capacity_items=null",
            "links.0.peers.0.id=3",
            "node.step_s=0.5",
            "risk.low=-1",
        ],
    )
    assert config.policy.name == "hop-count"
    assert config.store.capacity_items is None
    assert config.links[0].peers[0].id == 3
    assert config.node.step_s == 0.5
    assert config.risk.low == -1


@pytest.mark.parametrize(
    ("assignment", "expected"),
    [
        ("policy.name", "--set: expected key.path=value, got 'policy.name'"),
        ("=3", "--set: expected key.path=value, got '=3'"),
        ("a..b=3", "--set: expected key.path=value, got 'a..b=3'"),
        ("node.id.x=3", "--set node.id.x: node.id is a value, not a section"),
        ("links.7.listen=x", "--set links.7.listen: links has items 0 to 0, not 7"),
        ("node.id=[", "--set node.id: line 1: expected the node content, but found '<stream end>'"),
    ],
)
def test_set_that_makes_no_sense(assignment: str, expected: str) -> None:
    raw = yaml.safe_load(DRONE)
    with pytest.raises(ConfigError) as caught:
        set_key(raw, assignment)
    assert str(caught.value) == expected


@pytest.mark.parametrize(
    ("text", "own", "unit"),
    [
        ("", False, None),
        ("risk: {unit: counts}", False, "counts"),
        ("sensor: {type: gmc, port: /dev/ttyUSB0}", True, "usvh"),
        ("sensor: {type: gmc, port: /dev/ttyUSB0, unit: cpm}", True, "cpm"),
        ("sensor: {type: gmc, port: /dev/ttyUSB0, unit: cpm}\nrisk: {unit: cpm}", True, "cpm"),
        ("sensor: {type: program}", True, "usvh"),
        ("sensor: {type: program, unit: cps, cpm_per_usvh: 1800}", True, "cps"),
    ],
)
def test_the_unit_of_the_readings(tmp_path: Path, text: str, own: bool, unit: str | None) -> None:
    path = tmp_path / "node.yaml"
    path.write_text(DRONE + text)
    settings = load_config(path).agent_settings()
    assert (settings.sensor_unit is not None, settings.unit) == (own, unit)


def test_no_configuration_leaves_a_mechanism_out(tmp_path: Path) -> None:
    path = tmp_path / "node.yaml"
    path.write_text(DRONE + "without: [receipts]")
    with pytest.raises(ConfigError, match=r"node\.yaml: without: unknown key"):
        load_config(path)


def test_keys_of_the_last_release_are_read_with_a_line_about_each(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "node.yaml"
    path.write_text(DRONE + "custody: {mirror: false, copies: auto, digest: true, retry_steps: 1}")
    config = load_config(path)
    assert config.custody == CustodySettings(replicas=False)
    assert caplog.messages == [
        "custody.mirror is now custody.replicas; the old name is read in this release only",
        "no longer settings: remove custody.digest, custody.copies, custody.retry_steps",
    ]


def test_names_that_follow_from_others(tmp_path: Path) -> None:
    path = tmp_path / "node.yaml"
    path.write_text("mavlink: {system_id: 9}\nlinks: [{broadcast: '10.0.0.255:14600'}]\n")
    config = load_config(path)
    assert config.node_id == 9
    assert config.store_path == tmp_path / "rass-9.db"
    assert config.socket_path == tmp_path / "rass-9.sock"
    assert load_config(path, ["store.path=/var/lib/rass/node.db"]).socket_path == Path("/var/lib/rass/node.sock")


PATHS = """
node: {id: 7, role: base}
store: {path: data/n7.db}
sensor: {type: log, path: a.LOG}
keys: {file: ground.keys}
watch: {folder: photos}
page: {token_file: token, tiles: map.mbtiles}
on_arrival: {command: [./tell, x]}
"""


def test_relative_paths_start_from_the_folder_of_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Wherever the caller is: `ls` must find the store that `run` has."""
    (tmp_path / "conf").mkdir()
    (tmp_path / "conf/node.yaml").write_text(PATHS)
    here = tmp_path / "conf"
    for folder, name in ((tmp_path, "conf/node.yaml"), (Path("/"), str(here / "node.yaml")), (here, "node.yaml")):
        monkeypatch.chdir(folder)
        config = load_config(name)
        assert config.keys is not None
        assert config.watch is not None
        assert config.page is not None
        assert config.on_arrival is not None
        paths = (
            config.store_path, config.socket_path, config.sensor.path, config.keys.file, config.watch.folder,
            config.page.token_file, config.page.tiles, config.on_arrival.command[0],
        )  # fmt: skip
        assert [str(path) for path in paths] == [
            str(here / name)
            for name in ("data/n7.db", "data/n7.sock", "a.LOG", "ground.keys", "photos", "token", "map.mbtiles", "tell")
        ], "in full, from wherever: errors name them"
    (here / "node.yaml").write_text("node: {id: 7, role: base}\non_arrival: {command: [tell]}\n")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rass-7.db").touch()
    config = load_config("conf/node.yaml")
    assert (config.store_path, config.socket_path) == (here / "rass-7.db", here / "rass-7.sock"), "not the one here"
    assert config.on_arrival is not None
    assert config.on_arrival.command == ("tell",), "a command without a folder is found in PATH"


def test_a_socket_in_a_deep_folder_has_the_shorter_of_its_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    deep = tmp_path / ("deep" * 30)
    deep.mkdir()
    (deep / "node.yaml").write_text(DRONE)
    with pytest.raises(ConfigError, match=r"control\.socket: expected a path of at most 107 bytes"):
        load_config(deep / "node.yaml")
    monkeypatch.chdir(deep)
    config = load_config("node.yaml")
    assert (config.store_path, config.socket_path) == (deep / "rass-7.db", Path("rass-7.sock"))


def test_check_says_what_does_not_fit_this_computer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """`run` logs the same."""
    path = tmp_path / "node.yaml"
    path.write_text("node: {id: 7, role: base}\n")

    def warned(*words: str) -> str:
        assert main(["check", str(path), *words]) == 0
        return capsys.readouterr().err.removeprefix(f"{path}: warning: ")

    assert warned() == ""
    missing = f"{tmp_path}/no data"
    assert warned("--set", "store.path=no data/n7.db") == (
        f"store.path: there is no folder {missing}; create it (mkdir -p '{missing}')\n"
    )
    assert warned("--set", "store.path=/proc/n7.db") == "store.path: /proc has no space for a store\n"
    monkeypatch.setattr(time, "time", lambda: 725.0)
    assert warned() == (
        "the clock of this computer shows 1970-01-01 00:12 UTC, which is impossible: dates are wrong until it is set\n"
    )


def test_what_print_shows_is_the_same_configuration(tmp_path: Path) -> None:
    path = tmp_path / "node.yaml"
    path.write_text(DRONE)
    config = filled_in(load_config(path))
    path.write_text(dump_yaml(config))
    assert load_config(path) == config
    assert filled_in(config) == config


@pytest.mark.parametrize("name", ["drone.yaml", "base.yaml"])
def test_the_examples_are_good_and_explain_every_key(name: str) -> None:
    config = load_config(EXAMPLES / name)
    raw = read_yaml(EXAMPLES / name)

    def keys(plain: object, at: str) -> set[str]:
        if isinstance(plain, dict):
            return {f"{at}{key}" for key in plain} | {k for key, v in plain.items() for k in keys(v, f"{at}{key}.")}
        return set()

    assert keys(raw, "") == keys(to_plain(config), "")


SCALARS = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8)
NAMES = st.sampled_from(
    ["node", "id", "role", "policy", "alpha", "links", "peers", "address", "listen", "risk", "low", "high", "store",
     "custody", "replicas", "mirror", "digest", "autopilot", "url", "data", "bytes", "mavlink", "x"]
)  # fmt: skip
TREES = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(NAMES, inner, max_size=4), max_leaves=12
)


@settings(max_examples=examples(25))
@given(st.dictionaries(NAMES, TREES, max_size=5))
def test_any_tree_converts_or_is_refused_a_line_for_each_mistake(raw: dict[str, object]) -> None:
    try:
        config = convert(raw, RunConfig, "node.yaml")
    except ConfigError as error:
        assert all(line.startswith("node.yaml: ") and "\n" not in line for line in error.mistakes)  # noqa: PT017
        assert len(set(error.mistakes)) == len(error.mistakes)  # noqa: PT017
    else:
        assert convert(to_plain(config), RunConfig, "again") == config


@given(st.binary(max_size=200))
def test_any_bytes_are_read_or_refused(data: bytes) -> None:
    with tempfile.NamedTemporaryFile() as file:
        file.write(data)
        file.flush()
        try:
            assert isinstance(read_yaml(file.name), dict)
        except ConfigError as error:
            assert str(error).startswith(f"{file.name}: ")  # noqa: PT017


def test_sections_cannot_be_changed() -> None:
    with pytest.raises(AttributeError):
        RunConfig().node.id = 3  # type: ignore[misc]
    assert RunConfig().links == ()

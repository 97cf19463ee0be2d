"""Policies, sensors and links stand once: in the module that is one, or in their room's registry."""

from __future__ import annotations

import ast
import json
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from importlib import import_module
from pathlib import Path

import pytest

from rass_mav.app.config import RunConfig, load_config
from rass_mav.cli import main
from rass_mav.errors import ConfigError
from rass_mav.lab.commands.experiment import EXPERIMENTS, Listed
from rass_mav.link.kinds import KINDS as LINKS
from rass_mav.link.kinds import LinkKind
from rass_mav.policy.settings import kinds as policies
from rass_mav.sensor.base import SensorReading
from rass_mav.sensor.kinds import KINDS as SENSORS
from rass_mav.sensor.kinds import SensorKind
from rass_mav.station.parameters import INDEX, PARAMETERS, changed
from tests.ground.mission_stores import measured, stored

PACKAGE = Path(__file__).parents[1] / "rass_mav"
FILES = sorted(PACKAGE.rglob("*.py"))

# -- where names stand -------------------------------------------------------------------------------------------------


def texts(tree: ast.Module) -> Iterator[str]:
    """The strings of a module, without those that only people read: docstrings."""
    said = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in said:
            yield node.value


def lists(tree: ast.Module) -> Iterator[set[str]]:
    """The strings that stand beside each other: in a tuple, a list, a set, a Literal, or as the keys of a dict."""
    for node in ast.walk(tree):
        items = node.keys if isinstance(node, ast.Dict) else getattr(node, "elts", [])
        yield {item.value for item in items if isinstance(item, ast.Constant) and isinstance(item.value, str)}


def questions(tree: ast.Module) -> Iterator[str]:
    """The strings that `.type` or `.name` of something is compared with."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Compare):
            sides = [node.left, *node.comparators]
            if any(isinstance(side, ast.Attribute) and side.attr in ("type", "name") for side in sides):
                yield from (text for side in sides for text in texts(ast.Module([ast.Assign([], side)], [])))


def outside(*rooms: str, naming: Iterable[str]) -> Iterator[tuple[str, ast.Module]]:
    """The modules outside these rooms in which one of the names stands; to parse all takes seconds."""
    names = tuple(naming)
    for path in FILES:
        where = path.relative_to(PACKAGE)
        if any(where.is_relative_to(room) for room in rooms):
            continue
        source = path.read_text(encoding="utf-8")
        if any(name in source for name in names):
            yield str(where), ast.parse(source)


def test_nobody_names_a_policy_but_its_module() -> None:
    """Experiments may: they compare certain policies, as the paper does."""
    # `rass` is also the name of the whole, so it counts only where it stands alone.
    names = "|".join(re.escape(name) for name in policies() if name != "rass")
    naming = re.compile(rf"rass|.*(?<![\w-])({names})(?![\w-]).*", re.S)
    there = outside("policy", "lab/experiment", "lab/baselines", naming=(*policies().keys() - {"rass"}, '"rass"'))
    found = [(where, text) for where, tree in there for text in texts(tree) if naming.fullmatch(text)]
    assert found == [
        ("commands/service.py", "rass")  # the system's user
    ]


@pytest.mark.parametrize(("room", "names"), [("sensor", SENSORS), ("link", LINKS)])
def test_nobody_lists_sensors_or_links_or_asks_which_one_it_is(room: str, names: dict[str, object]) -> None:
    for where, tree in outside(room, naming=[f'"{name}"' for name in names]):
        assert not [listed for listed in lists(tree) if len(listed & names.keys()) > 1], where
        assert not [asked for asked in questions(tree) if asked in names], where


def test_nobody_names_a_counter_but_its_room() -> None:
    """Where its name means nothing else."""
    names = SENSORS.keys() - {"autopilot", "log", "program"}
    for where, tree in outside("sensor", naming=names):
        assert not [text for text in texts(tree) if names & set(re.findall(r"[\w-]+", text))], where


def test_the_search_finds_what_it_looks_for() -> None:
    tree = ast.parse(
        '"""udp"""\nx = ("udp", "serial")\ny = Literal["udp", "log"]\nz = {"udp": 1}\nlink.type != "udp"\n'
    )
    assert list(texts(tree)).count("udp") == 4
    assert [listed for listed in lists(tree) if listed] == [{"udp", "serial"}, {"udp"}, {"udp", "log"}]
    assert list(questions(tree)) == ["udp"]


# -- one more ----------------------------------------------------------------------------------------------------------

Add = Callable[[str, str, str], None]


@pytest.fixture
def add(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Add]:
    """Puts a module into a room: `add("policy", "mine", "...")`."""
    added = []

    def put(room: str, name: str, source: str) -> None:
        package = import_module(f"rass_mav.{room}")
        (tmp_path / f"{name}.py").write_text(source, encoding="utf-8")
        monkeypatch.setattr(package, "__path__", [*package.__path__, str(tmp_path)])
        added.append(f"rass_mav.{room}.{name}")
        policies.cache_clear()

    yield put
    policies.cache_clear()
    for name in added:
        sys.modules.pop(name, None)


def config(tmp_path: Path, text: str) -> RunConfig:
    path = tmp_path / "node.yaml"
    path.write_text(text, encoding="utf-8")
    return load_config(path)


DRONE = "node: {id: 1}\nlinks: [{multicast: '239.0.0.1:14601'}]\n"
POLICY = """
from rass_mav.policy.fitness import FitnessPolicy
from rass_mav.policy.settings import PolicyKind

POLICIES = (PolicyKind("cautious", 77, lambda settings: FitnessPolicy(settings.name, alpha=1.0, beta=50.0)),)
"""


def test_a_new_policy_is_one_module(add: Add, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    swarm = ["swarm", "--policy", "cautious", "--nodes", "9", "--steps", "40", "--json"]
    assert main(swarm) == 2
    assert json.loads(capsys.readouterr().out)["error"] == [
        f"demo.yaml: policy.name: expected one of {', '.join(sorted(policies()))}, got 'cautious'"
    ]
    add("policy", "cautious", POLICY)
    assert main(swarm) == 0
    summary = json.loads(capsys.readouterr().out)
    assert (summary["policy"], summary["lost"]["vanished"]) == ("cautious", 0)
    assert summary["delivered"] > 0
    # The ground sets it by its number, and files name it.
    settings = config(tmp_path, DRONE + "policy: {name: cautious}").agent_settings()
    assert PARAMETERS[INDEX["RASS_POLICY"]].read(settings) == 77
    assert changed(settings, PARAMETERS[INDEX["RASS_POLICY"]], 0.0).policy.name == "rass"


SENSOR = """
from rass_mav.sensor.base import Sensor, SensorReading, SensorState

class Dice(Sensor):
    def start(self, wake): pass
    def receive(self): return [SensorReading(4.0, self.now())]
    def state(self): return SensorState(True, 1, 0, 0, 0, 1, "")
    def close(self): pass

def open_dice(settings, now):
    dice = Dice(settings.port)
    dice.now = now
    return dice
"""


def test_a_new_sensor_is_one_module_and_one_row(add: Add, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    add("sensor", "dice", SENSOR)
    monkeypatch.setitem(SENSORS, "dice", SensorKind("rass_mav.sensor.dice:open_dice", ("port",), "a table"))
    loaded = config(tmp_path, DRONE + "sensor: {type: dice, port: green}")
    assert loaded.agent_settings().sensor_unit
    sensor = loaded.sensor.open(lambda: 3.0)
    assert sensor is not None
    assert (sensor.name, sensor.receive()) == ("green", [SensorReading(4.0, 3.0)])
    for keys, problem in (
        ("type: dice", r"sensor\.port: missing, expected a table with sensor\.type dice"),
        ("type: dice, port: a, baud: 9600", r"sensor\.baud: has no effect with sensor\.type dice, got 9600"),
        ("type: nice", r"sensor\.type: expected one of airdos, autopilot, bgeigie, dice, "),
    ):
        with pytest.raises(ConfigError, match=problem):
            config(tmp_path, f"{DRONE}sensor: {{{keys}}}")


LINK = """
from rass_mav.errors import ConfigError
from tests.link.loopback import LoopbackHub, LoopbackLink

HUB = LoopbackHub()

class TinCan(LoopbackLink):
    @staticmethod
    def check(section, key):
        if section.listen == "nobody":
            raise ConfigError(f"{key}.listen: expected somebody")

    @classmethod
    def of(cls, section, vehicle):
        return HUB.endpoint(section.listen)
"""


def test_a_new_link_is_one_module_and_one_row(add: Add, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    add("link", "tin_can", LINK)
    monkeypatch.setitem(LINKS, "tin-can", LinkKind("rass_mav.link.tin_can:TinCan", forwarded=True))
    (section,) = config(tmp_path, "node: {id: 1}\nlinks: [{type: tin-can, listen: kitchen}]").links
    link = section.open(None)
    assert (link.name, link.one_hop) == ("kitchen", False)
    assert link.budget is not None
    for keys, problem in (
        ("type: tin-can, listen: nobody", r"links\[0\]\.listen: expected somebody"),
        ("type: tin-can, broadcast: 'a:1'", r"links\[0\]\.broadcast: belongs to type udp, this link is tin-can"),
        ("type: rope", r"links\[0\]\.type: expected one of autopilot, rnode, serial, tin-can, udp, got 'rope'"),
    ):
        with pytest.raises(ConfigError, match=problem):
            config(tmp_path, f"node: {{id: 1}}\nlinks: [{{{keys}}}]")


FORMAT = """
from collections import Counter
from rass_mav.ground.formats import Exported, Format

def write(entries, out, source):
    lines = [entry.name for entry in entries]
    out.write_text("".join(line + chr(10) for line in lines))
    return Exported(len(lines), Counter(), [out])

FORMAT = Format(".ids", "all data", write)
"""


def test_a_new_export_format_is_one_module(add: Add, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store = str(stored(tmp_path / "base.db", [measured(0), measured(1)]))
    out = tmp_path / "mission.ids"
    assert main(["export", store, "-o", str(out)]) == 2
    assert "or one of the extensions .csv, .ers, .geojson, " in capsys.readouterr().err
    add("ground.formats", "ids", FORMAT)
    assert main(["export", store, "-o", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["format"] == "ids"
    assert out.read_text().split() == ["7-0123abcd-0", "7-0123abcd-1"]


EXPERIMENT = """
from rass_mav.lab.experiment.columns import STANDARD
from rass_mav.lab.experiment.declaration import Experiment, Factor, Level

def experiment():
    weathers = {"dry": Level("dry"), "rain": Level("rain", {"radio.loss": 0.5})}
    return Experiment("Weather", [Factor("sky", "Sky", weathers, "--sky")], STANDARD, "demo", "{sky}")
"""


def test_a_new_experiment_is_one_module_and_one_row(
    add: Add, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    add("lab.experiment", "weather", EXPERIMENT)
    monkeypatch.setitem(EXPERIMENTS, "weather", Listed("what rain costs", "", {"--sky": "which weathers"}))
    command = ["experiment", "weather", "--out", str(tmp_path / "out"), "--runs", "1", "--steps", "9", "--jobs", "1"]
    assert main([*command, "--set", "nodes=9", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["files"] == ["runs.csv", "table.csv", "table.md"]
    lines = (tmp_path / "out" / "table.csv").read_text().splitlines()
    assert [line.split(",")[0] for line in lines] == ["sky", "dry", "rain"]
    assert main([*command, "--sky", "snow"]) == 2
    assert capsys.readouterr().err == "--sky: expected some of dry, rain, got 'snow'\n"

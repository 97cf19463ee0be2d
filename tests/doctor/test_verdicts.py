"""What is made of a node's status: each verdict that no port or neighbour brings about at will.

The status is a real one, of a trial; what the test is about is changed in it.
"""

from __future__ import annotations

import asyncio
import copy
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rass_mav.app.config import RunConfig, load_config
from rass_mav.config.keys import KeysSection
from rass_mav.doctor import neighbours, node, vehicle
from rass_mav.doctor.finding import Finding
from rass_mav.doctor.trial import try_out
from rass_mav.doctor.watch import Ear, Evidence
from rass_mav.sensor.settings import SensorSettings
from rass_mav.wire.codec import VERSION
from tests.app.app_nodes import free_ports

Change = Callable[[Any], None]
AUTOPILOT = {
    "system_id": 3, "type": 3, "version": [4, 6, 3], "signed": False, "heartbeat_age_s": 0.2, "armed": False,
    "reboots": 0, "no_fix_age_s": None,
}  # fmt: skip
NEIGHBOUR = {
    "node_id": 4, "system_id": 4, "base": False, "hops": 1, "risk": 0.0, "cost": 0.1, "free_items": 9,
    "same_policy": True, "keys": False, "age_s": 1,
}  # fmt: skip


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> tuple[RunConfig, Evidence]:
    """A drone's configuration, and two looks at it."""
    folder: Path = tmp_path_factory.mktemp("verdicts")
    vehicle_port, listen, peer = free_ports(3)
    (folder / "n7.yaml").write_text(
        f"node: {{id: 7}}\nautopilot: {{url: 'udpin:127.0.0.1:{vehicle_port}'}}\nstore: {{path: {folder}/n7.db}}\n"
        f"links: [{{listen: '127.0.0.1:{listen}', peers: [{{address: '127.0.0.1:{peer}'}}]}}]\n"
    )
    config = load_config(folder / "n7.yaml")
    seen = asyncio.run(try_out(config, 0.5))
    return config, seen


def evidence(scene: tuple[RunConfig, Evidence], change: Change, *, running: bool = True) -> Evidence:
    """Three looks, a second after another; the last ones are changed."""
    first = copy.deepcopy(dict(scene[1].samples[-1]))
    first["uptime_s"] = 10.0
    first["autopilot"] = dict(AUTOPILOT)
    samples: list[Mapping[str, Any]] = [first]
    for number in (1, 2):
        sample = copy.deepcopy(first)
        sample["uptime_s"] = 10.0 + number
        change(sample)
        samples.append(sample)
    return Evidence(running, samples, opened=[0])


def put(path: str, value: Any) -> Change:
    """Sets `a.b.0.c` in a status."""

    def change(status: dict[str, Any]) -> None:
        *way, last = path.split(".")
        place: Any = status
        for step in way:
            place = place[int(step) if step.isdecimal() else step]
        place[last] = value

    return change


def with_keys(config: RunConfig) -> RunConfig:
    return replace(config, keys=KeysSection(file="drone-7.keys"))


def nothing(status: dict[str, Any]) -> None:
    """Leaves it as it is."""


@pytest.mark.parametrize(
    ("change", "level", "said"),
    [
        (nothing, "pass", "running: node 7 (drone)"),
        (put("commits.failed", 2), "fail", "cannot write to its disk"),
        (put("skipped_steps", 5), "warn", "skips steps"),
        (put("links", []), "fail", "with 0 links, but 1 are configured"),
        (put("node_id", 8), "fail", "but the configuration is for node 7"),
    ],
)
def test_a_running_node(scene: tuple[RunConfig, Evidence], change: Change, level: str, said: str) -> None:
    found = node.health(scene[0], evidence(scene, change))
    assert (found.level, said in found.text) == (level, True), found


def test_commits_that_failed_long_ago(scene: tuple[RunConfig, Evidence]) -> None:
    seen = evidence(scene, nothing)
    for sample in seen.samples:
        put("commits.failed", 3)(sample)
    found = node.health(scene[0], seen)
    assert (found.level, "3 commits failed earlier" in found.text) == ("warn", True)


@pytest.mark.parametrize(
    ("change", "level", "said"),
    [
        (nothing, "pass", "ArduPilot 4.6.3, system 3, disarmed"),
        (put("autopilot.version", None), "pass", "ArduPilot, system 3, disarmed"),
        (put("autopilot.signed", True), "pass", "heartbeats/s, signed"),
        (lambda s: s["autopilot"].update(signed=True, version=None), "fail", "MAVLink signing is on"),
        (put("autopilot.reboots", 2), "warn", "has restarted 2 times"),
        (put("autopilot.heartbeat_age_s", 30.0), "fail", "nothing heard"),
        (put("autopilot", None), "fail", "nothing heard"),
        (put("autopilot.type", 12), "pass", "PX4"),
        (put("autopilot.type", 5), "pass", "autopilot of type 5"),
        (put("vehicle.trouble", "No such file or directory"), "fail", "no such file or directory"),
    ],
)
def test_an_autopilot(scene: tuple[RunConfig, Evidence], change: Change, level: str, said: str) -> None:
    found = vehicle.autopilot(scene[0], evidence(scene, change))
    assert (found.level, said in found.text) == (level, True), found


def signed(config: RunConfig) -> RunConfig:
    """With an autopilot that has MAVLink signing."""
    return replace(config, autopilot=replace(config.autopilot, signing=True))


@pytest.mark.parametrize(
    ("refused", "text", "remedy"),
    [
        ({"unsigned": 9, "forged": 0, "old": 0}, "heard, but without signatures", "rass-mav params signing"),
        ({"unsigned": 9, "mavlink_1": 9}, "it sends MAVLink 1, which has no signatures", "set SERIALn_PROTOCOL 2"),
        ({"unsigned": 0, "forged": 9, "old": 0}, "heard, but its signatures are wrong", "USB port"),
        ({"unsigned": 0, "forged": 0, "old": 9}, "older than earlier ones", "restart the autopilot"),
        ({"unsigned": 0, "forged": 0, "old": 0}, "nothing heard", "TX goes to RX"),
    ],
)
def test_an_autopilot_whose_frames_are_all_refused(
    scene: tuple[RunConfig, Evidence], refused: dict[str, int], text: str, remedy: str
) -> None:
    def change(status: dict[str, Any]) -> None:
        status["autopilot"] = None
        status["vehicle"]["signing"] = {"unsigned": 0, "mavlink_1": 0, "forged": 0, "old": 0, **refused}

    found = vehicle.autopilot(signed(scene[0]), evidence(scene, change))
    assert (found.level, text in found.text, remedy in found.remedy) == ("fail", True, True), found


def test_an_autopilot_that_signs_and_answers_nothing(scene: tuple[RunConfig, Evidence]) -> None:
    seen = evidence(scene, lambda status: status["autopilot"].update(signed=True, version=None))
    found = vehicle.autopilot(signed(scene[0]), seen)
    assert (found.level, "its signatures are valid, but it does not answer" in found.text) == ("fail", True)
    assert found.remedy.startswith("restart the autopilot")


@pytest.mark.parametrize(
    ("heard", "malformed", "said", "remedy"),
    [
        (9, 0, "no autopilot's heartbeat", "connect an autopilot"),
        (9, 4, "not MAVLink", "5 (GPS)"),
        (0, 0, "nothing heard", "-1 (none)"),
    ],
)
def test_what_comes_from_a_silent_autopilots_port(
    scene: tuple[RunConfig, Evidence], heard: int, malformed: int, said: str, remedy: str
) -> None:
    def change(status: dict[str, Any]) -> None:
        status["autopilot"] = None
        status["vehicle"]["received"] = heard
        status["vehicle_malformed"] = malformed

    found = vehicle.autopilot(scene[0], evidence(scene, change))
    assert (said in found.text, remedy in found.remedy) == (True, True), found
    if heard:
        # In a trial each frame was counted.
        seen = evidence(scene, change, running=False)
        seen.ear = Ear(frames=0 if malformed else 9)
        assert said in vehicle.autopilot(scene[0], seen).text


def test_a_position_that_comes_too_seldom(scene: tuple[RunConfig, Evidence]) -> None:
    def at(*times: float) -> Finding | None:
        seen = evidence(scene, nothing)
        for sample, arrived in zip(seen.samples, times, strict=True):
            place = {"latitude": 1.0, "longitude": 2.0, "altitude": 3.0, "age_s": sample["uptime_s"] - arrived}
            put("position", place)(sample)
        return vehicle.position(scene[0], seen)

    often, once, never = at(9.95, 10.9, 11.9), at(10.5, 10.5, 10.5), at(5.0, 5.0, 5.0)
    assert often is not None
    assert once is not None
    assert never is not None
    assert [often.level, once.level, never.level] == ["pass", "warn", "warn"]
    assert (once.text, never.text) == ("only one received during the check", "none received")


def test_an_autopilot_without_positions_asked_for_is_a_warning(scene: tuple[RunConfig, Evidence]) -> None:
    found = vehicle.position(scene[0], evidence(scene, nothing))
    assert found is not None
    assert (found.level, found.text) == ("warn", "none received")


def test_a_reading_that_comes_too_seldom(scene: tuple[RunConfig, Evidence]) -> None:
    def reading(*ages: float) -> Finding:
        seen = evidence(scene, nothing)
        for sample, age in zip(seen.samples, ages, strict=True):
            put("reading", {"value": 2.5, "age_s": age})(sample)
        return vehicle.reading(scene[0], seen)

    assert reading(0.05, 0.05, 0.05).level == "pass"
    assert reading(1.0, 2.0, 3.0).level == "warn"
    assert reading(29.0, 30.0, 31.0).level == "fail"


def test_readings_under_another_name_are_named(scene: tuple[RunConfig, Evidence]) -> None:
    def found(*rows: tuple[int, int, str]) -> Finding:
        ignored = [{"system_id": system, "component_id": component, "name": name} for system, component, name in rows]
        return vehicle.reading(scene[0], evidence(scene, put("ignored_readings", ignored)))

    own = found((3, 191, "RASS_RISK"), (4, 1, "RAD"))
    text = "no NAMED_VALUE_FLOAT RAD from the autopilot, so the worst risk is assumed"
    assert (own.level, own.text) == ("fail", text)
    other = found((3, 158, "DOSE"), (3, 1, "TEMP"))
    assert other.text.endswith("assumed; received instead: DOSE of component 158, TEMP of component 1")
    assert other.remedy is not None
    assert other.remedy.endswith(
        "if one of these is the reading, set mavlink.reading_name and mavlink.reading_component"
    )


def test_programs_hand_in_readings_while_the_node_runs(scene: tuple[RunConfig, Evidence]) -> None:
    config = replace(scene[0], sensor=SensorSettings(type="program"))
    assert vehicle.reading(config, evidence(scene, nothing, running=False)).level == "skip"
    silent = vehicle.reading(config, evidence(scene, nothing))
    assert (silent.level, silent.text) == ("fail", "no program submits readings, so the worst risk is assumed")
    seen = evidence(scene, nothing)
    for sample in seen.samples:
        put("reading", {"value": 2.5, "age_s": 0.05})(sample)
    assert vehicle.reading(config, seen).level == "pass"


@pytest.mark.parametrize(
    ("change", "level", "said"),
    [
        (put("neighbours", []), "warn", "no node heard"),
        (put("neighbours", [NEIGHBOUR]), "pass", "4"),
        (put("neighbours", [{**NEIGHBOUR, "base": True}]), "pass", "4 (base)"),
        (put("neighbours", [{**NEIGHBOUR, "same_policy": False}]), "warn", "nodes 4 use another policy"),
        (put("neighbours", [{**NEIGHBOUR, "hops": None}]), "warn", "none with a route to a base"),
    ],
)
def test_neighbours(scene: tuple[RunConfig, Evidence], change: Change, level: str, said: str) -> None:
    found = neighbours.neighbours(scene[0], evidence(scene, change))
    assert found is not None
    assert (found.level, said in found.text) == (level, True), found


def other(node_id: int, version: int, age_s: float = 1.0) -> dict[str, Any]:
    return {"node_id": node_id, "version": version, "age_s": age_s}


@pytest.mark.parametrize(
    ("others", "level", "said", "remedy"),
    [
        ([], "pass", f"only version {VERSION}", ""),
        ([other(4, 1)], "warn", f"node 4 uses version 1, this one {VERSION}", "on node 4 "),
        ([other(4, 5)], "warn", "node 4 uses version 5", "on node 7 "),
        ([other(4, 1), other(5, 5), other(9, 5)], "warn", "node 9 uses version 5", "on node 4, 7 "),
        ([other(4, 1, 121.0)], "pass", f"only version {VERSION}", ""),
    ],
)
def test_who_has_to_be_updated(
    scene: tuple[RunConfig, Evidence], others: list[Any], level: str, said: str, remedy: str
) -> None:
    found = neighbours.versions(scene[0], evidence(scene, put("other_versions", others)))
    assert (found.level, said in found.text, remedy in found.remedy) == (level, True, True), found
    assert bool(found.remedy) == bool(others and level == "warn")


@pytest.mark.parametrize(
    ("change", "level", "said"),
    [
        (nothing, "pass", "open"),
        (put("links.0.trouble", "No such device"), "fail", "no such device"),
        (put("links.0.trouble", "wlanA is down"), "fail", "wlanA is down"),
        (put("links.0.dropped_out", 50), "warn", "0 were sent and 50 could not be"),
    ],
)
def test_a_link(scene: tuple[RunConfig, Evidence], change: Change, level: str, said: str) -> None:
    found = neighbours.link(scene[0], 0, evidence(scene, change))
    assert (found.level, said in found.text) == (level, True), found


def test_a_link_that_dropped_much_long_ago_and_one_that_has_sent_much_before(
    scene: tuple[RunConfig, Evidence],
) -> None:
    def counted(sent: int, dropped: int) -> dict[str, Any]:
        sample = copy.deepcopy(dict(scene[1].last))
        sample["links"][0].update(sent=sent, dropped_out=dropped)
        return sample

    recovered = Evidence(True, [counted(10, 9000), counted(20, 9000)], opened=[0])
    assert neighbours.link(scene[0], 0, recovered).level == "pass"
    lost_now = Evidence(True, [counted(9000, 0), counted(9001, 10)], opened=[0])
    found = neighbours.link(scene[0], 0, lost_now)
    assert (found.level, "1 were sent and 10 could not be" in found.text) == ("warn", True)


@pytest.mark.parametrize(
    ("change", "level"),
    [(nothing, "pass"), (put("copies.echoes", 9), "fail"), (put("copies.heard_twice", 9), "warn")],
)
def test_frames_that_come_twice(scene: tuple[RunConfig, Evidence], change: Change, level: str) -> None:
    assert neighbours.loops(evidence(scene, change)).level == level


def test_which_file_of_parameters_fits(scene: tuple[RunConfig, Evidence]) -> None:
    seen = evidence(scene, put("autopilot.type", 12))
    found = vehicle.parameters(scene[0], seen, "drone.yaml")
    assert found is not None
    assert "with the node stopped, run rass-mav params check px4.params --live drone.yaml" in found.text
    found = vehicle.parameters(scene[0], evidence(scene, nothing), "drone.yaml")
    assert found is not None
    assert "ardupilot-4.6.parm" in found.text
    assert vehicle.parameters(scene[0], evidence(scene, put("autopilot.version", None)), "drone.yaml") is None


def told(scene: tuple[RunConfig, Evidence], change: Change, parameters: dict[str, float]) -> Evidence:
    """A trial that read these parameters."""
    seen = evidence(scene, change, running=False)
    seen.ear = Ear(frames=9, parameters=parameters)
    return seen


def firmware(type: int, *version: int) -> Change:
    def change(status: dict[str, Any]) -> None:
        status["autopilot"].update(type=type, version=list(version) or None)

    return change


MAVLINK_PORTS = {"SERIAL0_PROTOCOL": 2, "SERIAL1_PROTOCOL": 2, "SERIAL2_PROTOCOL": 2, "SERIAL3_PROTOCOL": 5}
#: What closes a port: firmware, parameters; how it is named, and what opens it.
CLOSED: list[tuple[Change, dict[str, float], str, str]] = [
    (firmware(3, 4, 6, 3), {"SERIAL2_OPTIONS": 1024}, "SERIAL2 (SERIAL2_OPTIONS 1024)", "set SERIAL2_OPTIONS 0,"),
    (firmware(3, 4, 6, 3), {"SERIAL1_OPTIONS": 1025}, "SERIAL1 (SERIAL1_OPTIONS 1025)", "set SERIAL1_OPTIONS 1,"),
    (firmware(3, 4, 7, 0), {"MAV3_OPTIONS": 3}, "SERIAL2 (MAV3_OPTIONS 3)", "set MAV3_OPTIONS 1,"),
    (firmware(12, 1, 15, 0), {"MAV_1_CONFIG": 102, "MAV_1_FORWARD": 0}, "TELEM2 (MAV_1_FORWARD 0)", "MAV_1_FORWARD 1,"),
]
#: What does not: another protocol, another version's bit, an instance that is off.
OPEN: list[tuple[Change, dict[str, float]]] = [
    (firmware(3, 4, 6, 3), {"SERIAL2_OPTIONS": 0}),
    (firmware(3, 4, 6, 3), {"SERIAL3_OPTIONS": 1024}),
    (firmware(3, 4, 7, 0), {"SERIAL2_OPTIONS": 1024}),
    (firmware(12, 1, 15, 0), {"MAV_1_CONFIG": 0, "MAV_1_FORWARD": 0}),
]


@pytest.fixture(scope="module")
def behind(scene: tuple[RunConfig, Evidence], tmp_path_factory: pytest.TempPathFactory) -> RunConfig:
    """The same drone, whose swarm is reached through the autopilot."""
    path: Path = tmp_path_factory.mktemp("behind") / "n7.yaml"
    path.write_text(
        f"node: {{id: 7}}\nautopilot: {{url: '{scene[0].autopilot.url}'}}\nmavlink: {{autopilot_id: 3}}\n"
        "links: [{type: autopilot}]\n"
    )
    return load_config(path)


@pytest.mark.parametrize(("change", "parameters", "port", "remedy"), CLOSED)
def test_forwarding_that_is_off(
    scene: tuple[RunConfig, Evidence], behind: RunConfig, change: Change, parameters: dict[str, float], port: str,
    remedy: str,
) -> None:  # fmt: skip
    seen = told(scene, change, MAVLINK_PORTS | parameters)
    found = vehicle.forwarding(behind, seen)
    assert found is not None
    assert (found.level, f"off on {port}" in found.text, remedy in found.remedy) == ("fail", True, True), found
    # One fault, one remedy.
    lonely = neighbours.neighbours(behind, seen)
    assert lonely is not None
    assert (lonely.level, lonely.text) == ("skip", "not checked: the autopilot forwards nothing")
    # Another port than those between the node and the swarm.
    seen.samples[-1]["neighbours"].append(NEIGHBOUR)
    heard = vehicle.forwarding(behind, seen)
    assert heard is not None
    assert heard.level == "pass"
    # With a radio of its own the swarm does not need it.
    beside = vehicle.forwarding(scene[0], told(scene, change, MAVLINK_PORTS | parameters))
    assert beside is not None
    assert (beside.level, port in beside.text) == ("pass", True)


@pytest.mark.parametrize(("change", "parameters"), OPEN)
def test_forwarding_that_is_on(
    scene: tuple[RunConfig, Evidence], behind: RunConfig, change: Change, parameters: dict[str, float]
) -> None:
    found = vehicle.forwarding(behind, told(scene, change, MAVLINK_PORTS | parameters))
    assert found is not None
    assert (found.level, found.text) == ("pass", "on for every MAVLink port of the autopilot")


def test_the_parameters_of_a_running_node_are_not_read(scene: tuple[RunConfig, Evidence], behind: RunConfig) -> None:
    found = vehicle.forwarding(behind, evidence(scene, nothing))
    assert found is not None
    assert (found.level, "stop the node" in found.text) == ("skip", True)


@pytest.mark.parametrize(
    ("change", "parameters", "why", "remedy"),
    [
        (firmware(12, 1, 15, 0), {}, "", "connect the counter to this computer and set sensor.type"),
        (firmware(3, 4, 6, 3), {"SCR_ENABLE": 0}, "runs no scripts", "SCR_ENABLE 1 and reboot"),
        (firmware(3, 4, 6, 3), {"SCR_ENABLE": 1}, "but not rass_rad.lua", "APM/scripts"),
        (firmware(3, 4, 6, 3), {"SCR_ENABLE": 1, "RADS_SOURCE": 0}, "RADS_SOURCE is 0", "set RADS_SOURCE"),
        (
            firmware(3, 4, 6, 3),
            {"SCR_ENABLE": 1, "RADS_SOURCE": 1},
            "no port has SERIALn_PROTOCOL 28",
            "SERIALn_PROTOCOL 28",
        ),
        (
            firmware(3, 4, 6, 3),
            {"SCR_ENABLE": 1, "RADS_SOURCE": 1, "SERIAL4_PROTOCOL": 28},
            "sends nothing until it hears the counter",
            "RADS_BAUD",
        ),
        (firmware(3, 4, 6, 3), {"SCR_ENABLE": 1, "RADS_SOURCE": 2}, "pulses on a pin", "RADS_PIN"),
        (firmware(3, 4, 6, 3), {"SCR_ENABLE": 1, "RADS_SOURCE": 3}, "when there is a position", "wait"),
        (firmware(3, 4, 6, 3), {"SCR_ENABLE": 1, "RADS_SOURCE": 7}, "does not support", "1, 2 or 3"),
    ],
)
def test_why_the_autopilot_sends_no_readings(
    scene: tuple[RunConfig, Evidence], change: Change, parameters: dict[str, float], why: str, remedy: str
) -> None:
    found = vehicle.reading(scene[0], told(scene, change, parameters))
    assert (found.level, why in found.text, remedy in found.remedy) == ("fail", True, True), found
    assert ("script" in found.remedy) <= (why != ""), "PX4 has none"


def test_an_autopilot_that_wants_signatures_is_the_only_fault(
    scene: tuple[RunConfig, Evidence], behind: RunConfig
) -> None:
    seen = evidence(scene, lambda status: status["autopilot"].update(signed=True, version=None))
    found = vehicle.autopilot(behind, seen)
    assert (found.level, "bit 0 of its MAVn_OPTIONS" in found.remedy) == ("fail", True)
    others = [
        vehicle.position(behind, seen), vehicle.reading(behind, seen), neighbours.neighbours(behind, seen),
    ]  # fmt: skip
    assert [finding and finding.level for finding in others] == 3 * ["skip"]
    assert vehicle.forwarding(behind, seen) is vehicle.parameters(behind, seen, "drone.yaml") is None
    px4 = evidence(scene, lambda status: status["autopilot"].update(signed=True, version=None, type=12))
    assert "turn signing off" in vehicle.autopilot(behind, px4).remedy


@pytest.mark.parametrize(
    ("change", "remedy"),
    [
        (firmware(3, 4, 6, 3), "SR2_POSITION on"), (firmware(3, 4, 7, 0), "MAV3_POSITION"),
        (firmware(3), "SR2_POSITION or MAV3_POSITION"), (firmware(12), "MAV_1_MODE 2"),
        (firmware(0), "autopilot.messages"),
    ],
)  # fmt: skip
def test_what_positions_need_depends_on_the_firmware(
    scene: tuple[RunConfig, Evidence], change: Change, remedy: str
) -> None:
    found = vehicle.position(scene[0], evidence(scene, change))
    assert found is not None
    assert remedy in found.remedy


def test_a_system_id_that_waits_for_a_reboot(scene: tuple[RunConfig, Evidence]) -> None:
    found = vehicle.autopilot(scene[0], told(scene, nothing, {"SYSID_THISMAV": 8}))
    assert (found.level, "SYSID_THISMAV is 8, but not in effect yet" in found.text) == ("warn", True)
    assert vehicle.autopilot(scene[0], told(scene, nothing, {"SYSID_THISMAV": 3})).level == "pass"


def test_system_ids_that_several_use(scene: tuple[RunConfig, Evidence]) -> None:
    assert neighbours.system_ids(evidence(scene, nothing)).level == "pass"
    shared = [{"system_id": 3, "node_ids": [4, 7]}, {"system_id": 9, "node_ids": [11, 12]}]
    found = neighbours.system_ids(evidence(scene, put("shared_system_ids", shared)))
    assert found.level == "warn"
    assert found.text.startswith("nodes 4, 7 all use system id 3; nodes 11, 12 all use system id 9")
    assert "its own SYSID_THISMAV (" in found.remedy


def trusting(link: dict[str, int], *twins: dict[str, float]) -> Change:
    """A node with keys, these counts of its link, and these others with its ids."""

    def change(sample: dict[str, Any]) -> None:
        sample["streams"] = {"known": 2, "unverified": 0, "twins": list(twins)}
        sample["links"][0].update(link)

    return change


@pytest.mark.parametrize(
    ("counts", "level", "said"),
    [
        ({"unsigned": 0, "forged": 0}, "pass", "2 senders with this mission's keys"),
        ({"unsigned": 3, "forged": 0}, "warn", "ignored 3 unsigned frames"),
        ({"unsigned": 0, "forged": 4}, "warn", "and 4 signed with other keys"),
    ],
)
def test_signatures(scene: tuple[RunConfig, Evidence], counts: dict[str, int], level: str, said: str) -> None:
    seen = evidence(scene, trusting(counts))
    seen.samples[0]["links"][0].update({"unsigned": 0, "forged": 0})
    found = neighbours.signatures(with_keys(scene[0]), seen)
    assert found is not None
    assert (found.level, said in found.text) == (level, True)


def test_a_node_without_keys_learns_that_its_neighbours_have_some(scene: tuple[RunConfig, Evidence]) -> None:
    assert neighbours.signatures(scene[0], evidence(scene, put("neighbours", [NEIGHBOUR]))) is None
    around = [{**NEIGHBOUR, "keys": True}, {**NEIGHBOUR, "node_id": 1, "base": True, "keys": True}]
    found = neighbours.signatures(scene[0], evidence(scene, put("neighbours", around)))
    assert found is not None
    assert (found.level, "nodes with keys (4, 1)" in found.text) == ("warn", True)


def test_a_node_that_runs_with_other_keys_than_its_file_names_is_to_be_restarted(
    scene: tuple[RunConfig, Evidence],
) -> None:
    for config, change in ((with_keys(scene[0]), nothing), (scene[0], trusting({"unsigned": 0, "forged": 0}))):
        found = neighbours.signatures(config, evidence(scene, change))
        assert found is not None
        assert (found.level, found.remedy) == ("fail", "restart the node")


def key_updates(*out: int, revoked: bool = False) -> Change:
    def change(sample: dict[str, Any]) -> None:
        trusting({"unsigned": 0, "forged": 4})(sample)
        sample["key_updates"] = {"revoked": revoked, "others_revoked": [{"node_id": id, "serial": 1} for id in out]}

    return change


def test_nobody_is_told_to_give_keys_to_a_node_that_is_revoked(scene: tuple[RunConfig, Evidence]) -> None:
    seen = evidence(scene, key_updates(7, 9))
    seen.samples[0]["links"][0].update({"unsigned": 0, "forged": 0})
    found = neighbours.signatures(with_keys(scene[0]), seen)
    assert found is not None
    assert found.level == "warn"
    assert found.remedy == (
        "drones 7, 9 are revoked or replaced: frames signed with their old keys are ignored, as intended. If other "
        "nodes of this mission sent them, give those nodes the mission's keys (documentation: how-to/keys)"
    )


def test_a_drone_that_is_revoked_is_the_fault_itself(scene: tuple[RunConfig, Evidence]) -> None:
    seen = evidence(scene, key_updates(revoked=True))
    seen.samples[0]["links"][0].update({"unsigned": 0, "forged": 0})
    found = neighbours.signatures(with_keys(scene[0]), seen)
    assert found is not None
    assert (found.level, found.text) == ("fail", "the keys of this drone are revoked")
    assert "keys drone" in found.remedy


def test_another_node_with_this_nodes_ids_is_a_fault_where_frames_are_signed(
    scene: tuple[RunConfig, Evidence],
) -> None:
    found = neighbours.system_ids(evidence(scene, trusting({}, {"node_id": 9, "age_s": 1.0})))
    assert (found.level, found.text[:31]) == ("fail", "node 9 has this node's system i")
    assert "its own SYSID_THISMAV (" in found.remedy

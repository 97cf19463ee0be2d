"""Scenarios from files: all that is wrong with one is told at once."""

from __future__ import annotations

from pathlib import Path

import pytest
from yaml import safe_load

from rass_mav.errors import ConfigError
from rass_mav.lab.swarm.scenario import load_scenario
from rass_mav.policy.settings import kinds as policies

from .worlds import scenario

SEVERAL = """
nodes: 3
bases: 4
topolgy: line
radio: {loss: 2}
mobility: {pitch: 1}
radiation: {tolerance: [0.5, 0.1], cylinder_m: 1}
failures: {base_off: [[5, 3]], recharge_steps: 7}
policy: {name: surival}
hostile: [{kind: liar, near: 7}]
"""


def complaints(path: Path, *assignments: str) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        load_scenario(str(path), {}, assignments)
    return caught.value.lines()


def test_all_mistakes_of_a_scenario_are_told_at_once(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(SEVERAL)
    found = complaints(path, "steps", "radio.range_m=0")
    assert [line for line in found if "kind" not in line] == [
        "--set: expected key.path=value, got 'steps'",
        "mine.yaml: topolgy: unknown key (did you mean 'topology'?)",
        "mine.yaml: radio.loss: expected a number >= 0 and <= 1, got 2",
        "mine.yaml: radio.range_m: expected a number > 0, got 0",
        "mine.yaml: mobility.pitch: unknown key (did you mean 'pitch_m'?)",
        "mine.yaml: radiation.tolerance: expected two rising numbers, got [0.5, 0.1]",
        "mine.yaml: radiation.cylinder_m: expected 0 unless the sources are given and do not move",
        "mine.yaml: failures.recharge_steps: expected null unless failures.battery_steps is given",
        "mine.yaml: failures.base_off: expected [from, to] one after the other, each from below its to, got [[5, 3]]",
        f"mine.yaml: policy.name: expected one of {', '.join(sorted(policies()))}, got 'surival'",
    ]
    # Which attackers there are is their registry's business.
    assert [line.partition(": expected one of")[0] for line in found if "kind" in line] == [
        "mine.yaml: hostile[0].kind"
    ]


def test_what_dose_rates_and_surveys_need(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("{mobility: {area_m: [100], strip_m: 0}, radiation: {tube: none, page_dose: 0}}")
    assert complaints(path) == [
        "mine.yaml: mobility.area_m: expected a list of 2 values, got [100]",
        "mine.yaml: mobility.strip_m: expected a number > 0, got 0",
        "mine.yaml: radiation.tube: expected one of j305, lnd-7317, m4011, safecast, sbm-20, got 'none'",
        "mine.yaml: radiation.page_dose: expected a number > 0, got 0",
    ]
    path.write_text("{mobility: {speed_m_s: [9, 3]}, radiation: {law: dose, rule: threshold, strength: [2, 1]}}")
    assert complaints(path) == [
        "mine.yaml: mobility.speed_m_s: expected two numbers in ascending order, got [9.0, 3.0]",
        "mine.yaml: radiation.strength: expected two numbers in ascending order, got [2.0, 1.0]",
        "mine.yaml: radiation.rule: expected probability with radiation.law dose, got threshold",
    ]
    path.write_text("{failures: {die_rate: 0.1}, radiation: {law: dose}}")
    assert complaints(path) == [
        "mine.yaml: failures.die_rate: expected 0 with radiation.law dose; failures.die_dose is for doses"
    ]
    path.write_text("failures: {die_dose: 10}")
    assert complaints(path) == ["mine.yaml: radiation: expected law dose with failures.die_dose, got paper"]


def test_what_only_follows_from_a_mistake_in_another_section_is_not_told(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("{radio: {preset: wifi-1m, reorder: 0.2}, traffic: {load: 0.5}}")
    assert complaints(path) == ["mine.yaml: radio.reorder: expected 0 with radio.air csma"]
    path.write_text("{radiation: {law: dose, noise: -1}, failures: {die_dose: 200}}")
    assert complaints(path) == ["mine.yaml: radiation.noise: expected a number >= 0, got -1"]


def test_positions_up_to_the_edge_of_the_arena_are_in_it_and_without_a_given_arena_all_are() -> None:
    places = {"nodes": 2, "topology": "positions", "mobility": {"positions": [[0, 0], [-6, 5]]}}
    assert scenario(**places).arena < 12
    assert scenario(**places, arena_m=12).mobility.positions == [(0, 0), (-6, 5)]


def test_what_the_sections_of_a_scenario_say_of_each_other(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("{nodes: 3, bases: 4, topology: positions, disk: {}, transport: udp, policy: {alpha: -1}}")
    assert complaints(path) == [
        "mine.yaml: policy.alpha: expected a number >= 0, got -1",
        "mine.yaml: bases: expected fewer than nodes (3), got 4",
        "mine.yaml: mobility.positions: expected one [x, y] for each of 3 nodes, got 0",
        "mine.yaml: disk: expected null unless the transport is loopback; processes have the machine's disk",
        "mine.yaml: radiation.corruption: expected false with a disk; disk.flip_rate flips bits on the disk",
    ]


def test_what_the_lab_leaves_out_is_a_list_of_names(tmp_path: Path) -> None:
    assert load_scenario("demo", assignments=["without=[overhearing, contacts]"]).without == ("overhearing", "contacts")
    with pytest.raises(ConfigError, match=r"^demo.yaml: without\[1\]: expected one of contacts, "):
        load_scenario("demo", assignments=["without=[receipts, magic]"])


def test_keys_of_the_last_release_are_read_with_a_line_about_each(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A key of the command line goes before one of the file, whichever of them is old."""
    path = tmp_path / "mine.yaml"
    path.write_text(
        "custody: {mirror: true, mirror_until: passed-on, receipts: false, retries: fixed}\nrouting: {contacts: false}"
    )
    scenario = load_scenario(str(path), {"custody.receipts": True}, ["custody.mirror=false", "custody.overhear=false"])
    assert scenario.custody.replicas is False
    assert set(scenario.without) == {"lasting-replicas", "measured-retries", "contacts", "overhearing"}
    assert "custody.mirror is now custody.replicas; the old name is read in this release only" in caplog.messages
    assert "custody.overhear is now without: [overhearing]; the old key is read in this release only" in caplog.messages
    assert load_scenario("paper-grid", assignments=["custody.receipts=true"]).without == (
        "measured-retries", "overhearing", "queue-toll", "contacts",
    )  # fmt: skip


@pytest.mark.parametrize(
    ("key", "said"),
    [
        ("custody.receipts=2", "custody.receipts: expected true or false, got 2"),
        ("custody.retries=often", "custody.retries: expected 'measured' or 'fixed', got 'often'"),
        ("custody.max_tries=3", "custody.max_tries: no longer a setting: expected 8 or nothing, got 3"),
    ],
)
def test_what_an_old_key_cannot_say_is_an_error(key: str, said: str) -> None:
    with pytest.raises(ConfigError, match=f"^demo.yaml: {said}$"):
        load_scenario("demo", assignments=[key])


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("{nodes: 3, bases: 3}", r"^test: bases: expected fewer than nodes \(3\), got 3$"),
        (
            "{nodes: 2, topology: positions, mobility: {positions: [[0, 0], [-6, 5]]}, arena_m: 10}",
            r"^test: arena_m: expected at least 12 with these mobility\.positions, got 10$",
        ),
        ("radio: {air: csma}", r"radio\.bitrate: expected a number > 0"),
        ("radio: {preset: lora, latency_steps: 1}", r"radio\.latency_steps: expected 0 with radio\.air csma"),
        ("radio: {shadowing_db: 3}", r"radio\.shadowing_db: expected 0 unless radio\.path_loss is given"),
        ("radio: {preset: sik-64k, gap_s: 1.0}", r"radio\.gap_s: expected less than radio\.slot_s"),
        ("radio: {preset: sik-64k, capture: first}", r"radio\.capture: expected none with radio\.air tdma"),
        ("radio: {preset: sik-64k, mac: unicast}", r"radio\.mac: expected broadcast unless"),
        ("radio: {preset: lora, mac: unicast}", r"radio\.mac: expected broadcast unless"),
        ("radio: {preset: wifi-9m}", r"radio\.preset"),
        ("{transport: udp, radio: {preset: wifi-6m}}", r"radio\.air: expected none"),
        ("failures: {die_fraction: 1.5}", r"failures\.die_fraction: expected a number >= 0 and <= 1, got 1\.5$"),
        ("failures: {wipe_rate: -0.1}", r"failures\.wipe_rate: expected a number >= 0 and <= 1, got -0\.1$"),
        ("failures: {reboot_steps: -1}", r"failures\.reboot_steps: expected a whole number >= 0, got -1$"),
        ("failures: {battery_steps: [9, 5]}", r"failures\.battery_steps: expected .*, got \[9, 5\]$"),
        ("failures: {battery_steps: [0, 5]}", r"failures\.battery_steps"),
        ("failures: {battery_steps: 7}", r"failures\.battery_steps: expected a list of 2 values, got 7$"),
        ("failures: {recharge_steps: 5}", r"failures\.recharge_steps: expected null unless"),
        ("failures: {base_wiped: true}", r"failures\.base_wiped: expected false unless"),
        ("failures: {blast: 0}", r"failures\.blast: expected a whole number >= 1, got 0$"),
        ("failures: {base_off: [[5, 5]]}", r"failures\.base_off: expected .*, got \[\[5, 5\]\]$"),
        ("failures: {base_off: [[5, 9], [8, 12]]}", r"failures\.base_off: expected .*, got \[\[5, 9\], \[8, 12\]\]$"),
        ("failures: {reboots: 1}", r"failures\.reboots: unknown key"),
        ("{traffic: {load: 0.5}, transport: udp}", "traffic: expected its defaults unless"),
        ("{traffic: {load: 0.5}, disk: {}, radiation: {corruption: false}}", "traffic: expected its defaults unless"),
        ("traffic: {load: 0.5}", r"radio: expected a preset or an air that takes time with traffic\.load$"),
        ("traffic: {picture_redundancy: [4, 6]}", "picture_part_bytes: expected a number"),
        ("traffic: {picture_part_bytes: 80, picture_redundancy: [6, 4]}", r"picture_redundancy: expected \[K, N\]"),
        ("disk: {}", r"radiation\.corruption: expected false with a disk"),
        ("{disk: {}, transport: udp}", "disk: expected null unless the transport is loopback"),
        ("disk: {full: [[5, 5]]}", r"disk\.full: expected \[from, to\] one after the other"),
        ("disk: {read_only: [[5, 9], [8, 10]]}", r"disk\.read_only: expected"),
        ("disk: {cut_rate: 2}", r"disk\.cut_rate"),
        ("hostile: [{kind: friend}]", "hostile"),
        ("hostile: [{kind: sinkhole, near: 100}]", "hostile"),
        ("hostile: [{kind: sinkhole, end: 0}]", "hostile"),
        ("hostile: [{near: 3}]", "hostile"),
        ("hostile: [{kind: sinkhole, captured: true}]", "hostile"),
        ("{nodes: 1000, keys: true}", "keys: expected false with more than 255 nodes"),
    ],
)
def test_what_makes_no_sense_is_refused(text: str, complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint):
        scenario(**safe_load(text))

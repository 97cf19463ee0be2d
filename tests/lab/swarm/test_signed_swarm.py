"""Whole swarms with signed links: strangers cost nothing, and nothing that holds in an open swarm is lost."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import pytest

from rass_mav.lab.fleet.processes import run
from rass_mav.lab.hostile.kinds import KINDS
from rass_mav.lab.swarm.invariants import check
from rass_mav.lab.swarm.scenario import Scenario, load_scenario
from rass_mav.lab.swarm.world import World
from rass_mav.trust.sessions import Refused
from tests.keyed import keyed
from tests.some import some


def swarm(name: str, *keys: str) -> World:
    return World(load_scenario(name, {}, ["keys=true", *keys]))


def refused(world: World) -> Refused:
    """Of all nodes."""
    counts = [keyed(agent).sessions.refused for agent in world.agents]
    assert len(counts) == len(world.agents)
    return Refused(*map(sum, zip(*counts, strict=True)))


def ignored(world: World) -> int:
    """Frames that were not signed, or by somebody else."""
    checks = [agent.peers.reader.check for agent in world.agents]
    return sum(check.unsigned + check.forged for check in checks if check is not None)


#: Without the link key all that they say is refused, whatever it is. So the suite has one swarm with one of each way to
#: speak: own frames, those of others again or changed, other streams, other names, and very many.
TOGETHER = (
    "sinkhole",
    "replayer",
    "bit-flipper",
    "timestamp-overtaker",
    "impostor",
    "receipt-forger",
    "crowd",
    "flooder",
)


@pytest.mark.no_cover
@pytest.mark.parametrize(
    ("kinds", "made"),
    [
        pytest.param(TOGETHER, 60, id="together"),
        *(pytest.param((kind,), 130, id=kind, marks=pytest.mark.soak) for kind in KINDS),
    ],
)
def test_strangers_cost_not_one_datum(kinds: Sequence[str], made: int) -> None:
    """`made`: data are created until this step."""
    # The first in the middle, the others around it.
    attackers = ",".join(
        f"{{kind: {kind}, near: {near}, begin: 20, end: {made - 10}}}"
        for kind, near in zip(kinds, (12, 11, 6, 7, 8, 13, 18, 17), strict=False)
    )
    world = swarm("hostile", f"hostile=[{attackers}]", f"data.until_step={made}")
    world.run(made + 50)
    summary = world.statistics.summary()
    assert summary["created"] == 2.4 * made
    assert summary["delivered"] == summary["created"]
    assert summary["altered"] == 0
    assert summary["hostile"]["false_delivered"] == 0
    assert not any(summary["hostile"]["alarms"].values())
    assert ignored(world) + refused(world).repeated > 100 * (len(kinds) - 1), "they were there"


def not_believed(world: World) -> Counter[str]:
    """Of all nodes."""
    counts: Counter[str] = Counter()
    for agent in world.agents:
        counts.update(keyed(agent).tags.report())
    return counts


@pytest.mark.no_cover
def test_what_holds_in_an_open_swarm_holds_with_keys() -> None:
    """Under radiation, with two bases, and with frames that are lost, doubled and overtaken. One run, looked at from
    all sides: it takes some seconds."""
    world = swarm("demo", "nodes=30", "bases=2", "radio.loss=0.1", "radio.duplicate=0.1", "radio.reorder=0.1")
    world.run(40, after=check)
    before = not_believed(world)
    world.run(60, after=check)
    assert world.statistics.summary()["delivered"] > 0
    routes = [agent.node.routing.route for agent in world.agents[2:]]
    assert {route.base for route in routes if route is not None} == {0, 1}
    # A frame that came twice is taken once.
    assert refused(world).repeated > 0
    # Honest nodes believe each other, but for the time in which they do not know each other; and their bases.
    assert before.total() < 120
    assert not_believed(world) == before
    attested = [some(keyed(agent).attestations).report() for agent in world.agents]
    assert not any(report["bad"] or report["forged"] for report in attested)


@pytest.mark.no_cover
def test_power_cuts_lock_nobody_out() -> None:
    """Disks on which commits take time, and lives that end in the middle of them."""
    scenario = load_scenario("power-cuts", {}, ["keys=true", "disk.cut_rate=0.02", "failures.reboot_steps=2"])
    # Of each node: link id and timestamp of its frames.
    used: dict[int, list[bytes]] = {}
    world = World(scenario, record=lambda frame, step: used.setdefault(frame[5], []).append(frame[-13:-6]))
    world.run(150)
    summary = world.statistics.summary()
    assert summary["power"]["cuts"] > 30
    assert summary["delivered"] > 0.8 * summary["created"]
    assert all(len(stamps) == len(set(stamps)) for stamps in used.values())


@pytest.mark.no_cover
def test_radios_with_queues_do_not_reorder_beyond_the_window() -> None:
    for name in ("field-sik-64k", "field-lora"):
        world = swarm(name, "nodes=16")
        world.run(40)
        assert refused(world).late == 0, name


@pytest.mark.no_cover
def test_a_swarm_of_processes_with_keys_delivers() -> None:
    scenario: Scenario = load_scenario(
        "udp-line", {"steps": 40}, ["keys=true", "nodes=4", "node.step_s=0.1", "failures.kill_every_s=2"]
    )
    summary = run(scenario)
    assert summary["created"] > 0
    assert summary["delivered"] == summary["created"]
    assert summary["frames"]["malformed"] == 0

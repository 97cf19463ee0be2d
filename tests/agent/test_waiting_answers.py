"""Answers that wait, where frames contend for the air."""

from __future__ import annotations

import math
import random
from typing import Any

import pytest

from rass_mav.agent.agent import Agent
from rass_mav.agent.commits import CommitGate
from rass_mav.agent.outgoing import MAX_WAITING, Outgoing
from rass_mav.config.loading import convert
from rass_mav.core.datum import DatumId, make_datum
from rass_mav.core.exchange import SPREAD_S
from rass_mav.core.messages import Accept, Committed, Data, Handover, Offer
from rass_mav.lab.swarm.invariants import check
from rass_mav.lab.swarm.scenario import Scenario
from rass_mav.lab.swarm.world import World
from rass_mav.station.node import build_node
from tests.agent.build import fit_beacon, heard, make, said
from tests.core.durable import DurableStore
from tests.some import some


def contending(forward: str = "immediate") -> Agent:
    agent = make(3, forward=forward)
    agent.answers.spread_s = SPREAD_S
    heard(agent, fit_beacon(agent, 2, 0), 0.0)
    agent.step(0.0)
    return agent


def data(sender: int, sequence: int) -> Data:
    return Data(sender, 3, (Handover(7 + sequence, make_datum(DatumId(sender, 5, sequence), 0, 0.0, b"x")),))


def leaving(agent: Agent, now: float) -> list[Any]:
    return said(agent.tend(now)[0])


def test_an_answer_waits_for_a_random_time() -> None:
    agent = contending("step")
    assert agent.tend(0.1) == ([], math.inf)
    assert heard(agent, data(4, 1), 0.1) == []
    due = agent.answers.due
    assert 0.1 < due < 0.1 + SPREAD_S
    assert agent.tend(0.1) == ([], due)
    [answer] = leaving(agent, due)
    assert (type(answer), answer.target) == (Committed, 4)
    assert agent.tend(due) == ([], math.inf)


def test_nodes_that_hear_the_same_frame_do_not_wait_for_the_same_time() -> None:
    due = set()
    for node_id in range(3, 8):
        agent = make(node_id, forward="step")
        agent.answers.spread_s = SPREAD_S
        heard(agent, Data(2, node_id, data(2, 1).handovers), 0.1)
        due.add(agent.answers.due)
    assert len(due) == 5


def test_what_comes_while_answers_wait_leaves_with_them() -> None:
    agent = contending()
    heard(agent, data(4, 1), 0.1)
    due = agent.answers.due
    heard(agent, data(5, 1), 0.1)
    assert agent.answers.due == due, "a stream of frames cannot put the answers off"
    # Both who gave it data hear it hand them on: no answer is needed.
    [frame] = leaving(agent, due)
    assert (type(frame), frame.target, len(frame.handovers)) == (Data, 2, 2)


def test_what_was_taken_and_does_not_move_on_in_the_same_moment_is_answered() -> None:
    agent = contending("step")
    heard(agent, data(4, 1), 0.1)
    heard(agent, data(5, 1), 0.1)
    answers = leaving(agent, agent.answers.due)
    assert {(type(answer), answer.target) for answer in answers} == {(Committed, 4), (Committed, 5)}


def test_a_beacon_that_needs_no_answer_lets_nothing_wait() -> None:
    agent = contending()
    heard(agent, fit_beacon(agent, 2, 1), 0.1)
    assert agent.answers.due == math.inf


def test_the_frames_of_a_transfer_do_not_wait() -> None:
    agent = contending()
    offer = Offer(2, 3, 9, DatumId(4, 5, 6), 0, 0.0, 0, 0, 500, 100)
    assert [type(message) for message in said(heard(agent, offer, 0.1))] == [Accept]


def test_answers_do_not_pile_up() -> None:
    agent = contending("step")
    left: list[Outgoing] = []
    for sequence in range(MAX_WAITING + 1):
        left += heard(agent, data(4, sequence), 0.1)
    assert sum(len(answer.committed) + len(answer.refused) for answer in said(left)) == MAX_WAITING + 1
    assert agent.answers.due == math.inf


def test_an_answer_that_has_waited_still_waits_for_the_disk() -> None:
    store = DurableStore(1)
    agent = build_node(make(3).settings, store, random.Random(3), now=0.0, newborn=True)
    agent.answers.spread_s = SPREAD_S
    gate = CommitGate(store)
    heard(agent, data(4, 1), 0.1)
    frames = agent.tend(0.1 + SPREAD_S)[0]
    assert gate.say(frames) == []
    batch = some(gate.begin())
    store.write(batch)
    assert list(gate.written()) == frames


def test_answers_end_with_the_node_that_gave_them() -> None:
    agent = contending("step")
    heard(agent, data(4, 1), 0.1)
    agent.store.roll_back()
    agent.begin_again(agent.settings, 0.1)
    assert leaving(agent, 1.0) == []


@pytest.mark.no_cover
def test_waiting_answers_collide_less() -> None:
    keys = {
        "nodes": 36, "steps": 30, "topology": "random-walk", "radio": {"preset": "wifi-6m"}, "data": {"until_step": 20},
    }  # fmt: skip

    def run(seed: int, spread_s: float) -> tuple[float, float]:
        """The share of frames that collided, and data sent per datum."""
        world = World(convert({**keys, "seed": seed}, Scenario, "test"))
        for agent in world.agents:
            agent.answers.spread_s = spread_s
        world.run(30, after=check)
        summary = world.statistics.summary()
        return summary["air"]["collided"], summary["transmissions_per_datum"]

    at_once, later = ([run(seed, spread_s) for seed in range(1, 5)] for spread_s in (0.0, SPREAD_S))
    assert sum(collided for collided, _ in later) < 0.6 * sum(collided for collided, _ in at_once)
    assert sum(sent for _, sent in later) < sum(sent for _, sent in at_once)

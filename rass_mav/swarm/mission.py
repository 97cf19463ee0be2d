"""The keys of a mock swarm's mission: the same for the same seed. They protect nothing but the runs themselves."""

from __future__ import annotations

import hashlib
import random
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from rass_mav.agent.tags import NoTags
from rass_mav.core.store import Store
from rass_mav.keys.settings import KeysSection, check_package
from rass_mav.swarm.scenario import Scenario

if TYPE_CHECKING:
    from rass_mav.agent.letters import Letters
    from rass_mav.agent.seals import DataKeys
    from rass_mav.keys.identity import Ground
    from rass_mav.keys.keyring import Keyring
    from rass_mav.keys.word import GroundWord


def ground_of(scenario: Scenario) -> Ground:
    """The keys of the ground. Raises `KeysError` if PyNaCl is missing."""
    check_package()
    # With PyNaCl, which a swarm without keys does not need.
    from rass_mav.keys.identity import Ground
    from rass_mav.keys.secret import Secret

    secret = Secret(hashlib.sha256(f"{scenario.seed}:mission".encode()).digest())
    return Ground(secret, serials=dict.fromkeys(range(scenario.bases, scenario.nodes), 1))


class SwarmKeys(NamedTuple):
    """The keys of all nodes."""

    letters: Sequence[Letters]
    """For each node id, what it has for its links."""
    tags: Callable[[int], Callable[[Store, random.Random, float], NoTags]]
    """For each node id, what proves its words (`Agent`)."""
    seals: Sequence[DataKeys]
    """For each node id, what its keys do to data."""
    words: Sequence[GroundWord]
    """For each node id, what it has of the ground's keys, and then what anybody has."""


def swarm_keys(scenario: Scenario) -> SwarmKeys | None:
    """None: the scenario has no keys. Raises `KeysError` if PyNaCl is missing."""
    if not scenario.keys:
        return None
    ground = ground_of(scenario)
    from rass_mav.agent.letters import Letters
    from rass_mav.agent.pairs import PairTags
    from rass_mav.agent.seals import DataKeys
    from rass_mav.keys.word import GroundWord

    def tags(node_id: int) -> Callable[[Store, random.Random, float], NoTags]:
        serial = 0 if node_id < scenario.bases else ground.serials.get(node_id, 1)
        own = letters[node_id if node_id < scenario.nodes else 0]
        return partial(PairTags, ground.node(node_id, serial), own.is_out)

    keyrings = [keyring_of(ground, node_id) for node_id in range(scenario.nodes)]
    letters = [
        Letters(keyring, random.Random(f"{scenario.seed}:letters:{node_id}"), scenario.node.step_s)
        for node_id, keyring in enumerate(keyrings)
    ]
    anybody = keyrings[-1]._replace(ground=None)
    return SwarmKeys(
        letters,
        tags,
        [DataKeys(keyring) for keyring in keyrings],
        [GroundWord(keyring) for keyring in (*keyrings, anybody)],
    )


def keyring_of(ground: Ground, node_id: int) -> Keyring:
    """A drone's keys, or those of a base, which has no serial."""
    from rass_mav.keys.keyring import Keyring

    serial = ground.serials.get(node_id)
    return Keyring(ground.node(node_id), ground) if serial is None else Keyring(ground.node(node_id, serial), None)


def write_files(scenario: Scenario, directory: Path) -> list[KeysSection | None]:
    """Write each node's file of keys; returns the sections for their configurations, by node id.

    Raises `KeysError` if PyNaCl is missing, and OSError.
    """
    if not scenario.keys:
        return [None] * scenario.nodes
    ground = ground_of(scenario)
    from rass_mav.keys.files import GROUND_FILE, drone_file, drone_text, ground_text, write_new

    write_new(directory / GROUND_FILE, ground_text(ground))
    paths = [directory / GROUND_FILE] * scenario.bases
    for node_id, serial in ground.serials.items():
        paths.append(directory / drone_file(node_id))
        write_new(paths[-1], drone_text(ground.node(node_id, serial)))
    return [KeysSection(file=str(path)) for path in paths]

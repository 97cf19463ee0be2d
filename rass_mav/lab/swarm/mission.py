"""The keys of a mock swarm's mission: the same for the same seed. They protect nothing but the runs themselves."""

from __future__ import annotations

import hashlib
import random
from pathlib import Path
from typing import TYPE_CHECKING

from rass_mav.config.keys import KeysSection, check_package
from rass_mav.lab.swarm.scenario import Scenario

if TYPE_CHECKING:
    from rass_mav.trust.keys.identity import Ground
    from rass_mav.trust.keys.keyring import Keyring
    from rass_mav.trust.trust import Trust


def ground_of(scenario: Scenario) -> Ground:
    """The keys of the ground. Raises `KeysError` if PyNaCl is missing."""
    check_package()
    # With PyNaCl, which a swarm without keys does not need.
    from rass_mav.lab.swarm.verified import SwarmGround
    from rass_mav.trust.keys.secret import Secret

    secret = Secret(hashlib.sha256(f"{scenario.seed}:mission".encode()).digest())
    captured = [id for id, section in enumerate(scenario.hostile, scenario.nodes) if section.captured]
    return SwarmGround(secret, serials=dict.fromkeys([*range(scenario.bases, scenario.nodes), *captured], 1))


def swarm_trusts(scenario: Scenario) -> dict[int, Trust]:
    """By id, what keys do for each node and each captured attacker. Empty: the scenario has no keys.

    Raises `KeysError` if PyNaCl is missing.
    """
    if not scenario.keys:
        return {}
    ground = ground_of(scenario)
    from rass_mav.trust.trust import trust_of

    return {
        id: trust_of(keyring_of(ground, id), random.Random(f"{scenario.seed}:letters:{id}"))
        for id in (*range(scenario.bases), *ground.serials)
    }


def keyring_of(ground: Ground, node_id: int) -> Keyring:
    """A drone's keys, or those of a base, which has no serial."""
    from rass_mav.trust.keys.keyring import Keyring

    serial = ground.serials.get(node_id)
    return Keyring(ground.node(node_id), ground) if serial is None else Keyring(ground.node(node_id, serial), None)


def write_files(scenario: Scenario, directory: Path) -> list[KeysSection | None]:
    """Write each node's key file; returns the sections for their configurations, by node id.

    Raises `KeysError` if PyNaCl is missing, and OSError.
    """
    if not scenario.keys:
        return [None] * scenario.nodes
    ground = ground_of(scenario)
    from rass_mav.trust.keys.files import GROUND_FILE, drone_file, drone_text, ground_text, write_new

    write_new(directory / GROUND_FILE, ground_text(ground))
    paths = [directory / GROUND_FILE] * scenario.bases
    for node_id, serial in ground.serials.items():
        paths.append(directory / drone_file(node_id))
        write_new(paths[-1], drone_text(ground.node(node_id, serial)))
    return [KeysSection(file=str(path)) for path in paths]

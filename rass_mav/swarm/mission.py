"""The keys of a mock swarm's mission: the same for the same seed. They protect nothing but the runs themselves."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING

from rass_mav.keys.settings import KeysSection, check_package
from rass_mav.mavlink.signing import SigningKeys
from rass_mav.swarm.scenario import Scenario

if TYPE_CHECKING:
    from rass_mav.keys.identity import Ground
    from rass_mav.keys.word import GroundWord


def ground_of(scenario: Scenario) -> Ground:
    """The keys of the ground. Raises `KeysError` if PyNaCl is missing."""
    check_package()
    # With PyNaCl, which a swarm without keys does not need.
    from rass_mav.keys.identity import Ground
    from rass_mav.keys.secret import Secret

    secret = Secret(hashlib.sha256(f"{scenario.seed}:mission".encode()).digest())
    return Ground(secret, serials=dict.fromkeys(range(scenario.bases, scenario.nodes), 1))


def signing_keys(scenario: Scenario) -> SigningKeys | None:
    """Those of the links; None: the scenario has no keys. Raises `KeysError` if PyNaCl is missing."""
    if not scenario.keys:
        return None
    return SigningKeys([link.key.reveal() for link in ground_of(scenario).node(0).links])


def ground_words(scenario: Scenario) -> list[GroundWord] | None:
    """What each node has of the ground's keys, and then what anybody has; None: the scenario has no keys. Raises
    `KeysError` if PyNaCl is missing."""
    if not scenario.keys:
        return None
    ground = ground_of(scenario)
    from rass_mav.keys.keyring import Keyring
    from rass_mav.keys.word import GroundWord

    keys = ground.node(0)
    return [GroundWord(Keyring(keys, ground))] * scenario.bases + [GroundWord(Keyring(keys, None))] * (
        scenario.nodes - scenario.bases + 1
    )


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

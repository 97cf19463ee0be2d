"""The keys of a running node, checked against what the node is."""

from __future__ import annotations

from typing import NamedTuple

from rass_mav.errors import WrongKeysError

from .files import GROUND_FILE, drone_file, read_keys
from .identity import Ground, NodeKeys


class Keyring(NamedTuple):
    """What a running node holds."""

    own: NodeKeys
    """Those of the node itself."""
    ground: Ground | None
    """At a base: those of the ground. None: a drone."""


def load_keyring(path: str, node_id: int, *, base: bool) -> Keyring:
    """The keys of a node from its file. Raises `KeysError` if the node must not start with them,
    `WrongKeysError` if they are those of others."""
    keys = read_keys(path)
    if isinstance(keys, Ground):
        if not base:
            raise WrongKeysError(
                f"{path}: holds the ground's keys, which must never be on a drone",
                f"remove it from this computer, and use {drone_file(node_id)} (rass-mav keys drone {node_id})",
            )
        if node_id in keys.serials:
            raise WrongKeysError(f"{path}: node {node_id} is a drone of this mission", "give the base another node.id")
        return Keyring(keys.node(node_id), keys)
    held = keys.certificate.node_id
    if base:
        raise WrongKeysError(
            f"{path}: holds the keys of drone {held}, not the ground's", f"use the mission's {GROUND_FILE}"
        )
    if held != node_id:
        raise WrongKeysError(
            f"{path}: holds the keys of drone {held}, but this is node {node_id}",
            f"use {drone_file(node_id)} (rass-mav keys drone {node_id})",
        )
    return Keyring(keys, None)

"""The section `keys` of a configuration, and how it is shown whether a node has keys."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Annotated, TypedDict

from rass_mav.config.sections import Meta, Section
from rass_mav.errors import KeysError, installing


class KeysSection(Section):
    """The node's keys."""

    file: Annotated[str, Meta(min_length=1)]
    """Key file: the drone's own, or at a base `ground.keys`."""
    accept_open: bool = False
    """Only at a base: whether open data count as arrived, while drones without keys still fly."""


class AboutKeys(TypedDict):
    """What everybody may know of a node's keys, as `status` has it."""

    mission: str
    """The mission's name, 8 hexadecimal digits."""
    node_id: int
    serial: int
    """0: a base."""
    link_key: int
    """Its number."""


def in_words(keys: AboutKeys | None) -> str:
    """One line for people. None: the node has no keys."""
    if keys is None:
        return "open: no keys, anyone can send on the link"
    who = f"drone {keys['node_id']}, serial {keys['serial']}" if keys["serial"] else f"base {keys['node_id']}"
    return (
        f"keys: mission {keys['mission']}, {who}, link key {keys['link_key']}; frames are signed, and data are sealed"
    )


def check_package() -> None:
    """Raise `KeysError` if PyNaCl is missing, without which nothing else of this package can be imported."""
    if find_spec("nacl") is None:
        raise KeysError("keys: need the Python package PyNaCl", installing("keys"))

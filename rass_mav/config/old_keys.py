"""Keys of the last release that have another name now, or none: they are still read in this one."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from typing import Any, NamedTuple

from rass_mav.config.sections import Mistakes
from rass_mav.config.typed import shown

log = logging.getLogger(__name__)


class Switch(NamedTuple):
    """A key that once switched a mechanism."""

    on: Any
    off: Any
    mechanism: str
    """Its name in `without`."""


#: The new names, in the same section.
RENAMED = {"custody.mirror": "replicas"}
SWITCHES = {
    "custody.receipts": Switch(True, False, "receipts"),
    "custody.mirror_until": Switch("receipt", "passed-on", "lasting-replicas"),
    "custody.distant": Switch(True, False, "distant-replicas"),
    "custody.overhear": Switch(True, False, "overhearing"),
    "custody.retries": Switch("measured", "fixed", "measured-retries"),
    "routing.contacts": Switch(True, False, "contacts"),
    "routing.queue_toll": Switch(True, False, "queue-toll"),
}
#: Numbers that all nodes share.
CONSTANT = {"custody.retry_steps": 1, "custody.max_tries": 8, "routing.max_hops": 250}
#: What it switched does not exist.
GONE = ("custody.digest", "custody.copies")


def read_old_keys(raw: dict[str, Any], mistakes: Mistakes, *, lab: bool) -> None:
    """Replace the old keys in a configuration by what they mean now. Logs what it finds.

    What cannot be said any more goes to `mistakes`. `lab`: the configuration may leave mechanisms out by `without`.
    """
    useless = []
    for key, section, old in list(_found(raw)):
        value = section.pop(old)
        if key in RENAMED:
            log.warning("%s is now custody.%s; the old name is read in this release only", key, RENAMED[key])
            section[RENAMED[key]] = value
        elif key in SWITCHES and lab:
            _switch(raw, key, value, mistakes)
        elif key in GONE or value == (SWITCHES[key].on if key in SWITCHES else CONSTANT[key]):
            useless.append(key)
        elif key in SWITCHES:
            name = SWITCHES[key].mechanism
            mistakes.add(
                key, f"no longer a setting: all nodes have it. Only a mock swarm can leave it out: without: [{name}]"
            )
        else:
            mistakes.add(key, f"no longer a setting: expected {CONSTANT[key]} or nothing, got {shown(value)}")
    if useless:
        log.warning("no longer settings: remove %s", ", ".join(useless))


def _found(raw: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any], str]]:
    for key in (*RENAMED, *SWITCHES, *GONE, *CONSTANT):
        name, _, old = key.partition(".")
        section = raw.get(name)
        if isinstance(section, dict) and old in section:
            yield key, section, old


def _switch(raw: dict[str, Any], key: str, value: Any, mistakes: Mistakes) -> None:
    switch, without = SWITCHES[key], raw.get("without") or []
    if value not in (switch.on, switch.off) or type(value) is int:
        mistakes.add(key, f"expected {shown(switch.on)} or {shown(switch.off)}, got {shown(value)}")
    elif isinstance(without, list):
        names = [name for name in without if name != switch.mechanism]
        raw["without"] = names if value == switch.on else [*names, switch.mechanism]
        log.warning("%s is now without: [%s]; the old key is read in this release only", key, switch.mechanism)
